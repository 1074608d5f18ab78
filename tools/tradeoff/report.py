"""What was measured, as a table and as plots of the fronts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from preface.reports.plots import encode_figure, new_figure
from tradeoff.front import Measured, cost, front

FIGURES = {"psnr_to_full": "PSNR to the fullest render, dB", "psnr": "PSNR to photographs, dB"}


def table(points: Sequence[Measured], images: int, qualities: Mapping[str, str | None]) -> str:
    """Markdown; the speed is against the model as trained, at the same number of images per head."""
    usual = next((cost(p, images) for p in points if p["group"] == "reference"), 1.0)
    on = {name for figure in FIGURES for name in front(_own(points), images, figure)}
    of = {name: quality for quality, name in qualities.items()}
    lines = [
        "| what | PSNR | SSIM | LPIPS | to fullest (lowest) | to the model as trained | alpha off "
        "| depth off, median / 95% mm | CPU us per ray | prepare s | times as fast | MFLOP per ray | MiB | front |",
        "|" + "---|" * 14,
    ]
    for p in sorted(points, key=lambda p: (p["settings"]["model"], p["group"], cost(p, images))):
        mark = of.get(p["name"], "yes" if p["name"] in on else "")
        lines.append(
            f"| {p['name']} | {p['psnr']:.3f} | {p.get('ssim', 0):.4f} | {p.get('lpips', 0):.4f} "
            f"| {p['psnr_to_full']:.2f} ({p['lowest_psnr_to_full']:.2f}) | {_to_trained(p)} | {p['alpha_off']:.4f} "
            f"| {p['depth_off_median_mm']:.2f} / {p['depth_off_p95_mm']:.2f} | {p['cpu_us_per_ray']:.1f} "
            f"| {p['prepare_cpu_s']:.2f} | {usual / cost(p, images):.2f} | {p['mflop_per_ray']:.2f} "
            f"| {p['peak_mib']:.0f} | {mark} |"
        )
    return "\n".join(lines)


def _to_trained(point: Measured) -> str:
    """PSNR to the render of the model as trained, which the fullest has none to."""
    name = "psnr_to_trained"
    return f"{point[name]:.2f} ({point[f'lowest_{name}']:.2f})" if name in point else "–"


def plot(points: Sequence[Measured], images: int, qualities: Mapping[str, str | None]) -> bytes:
    """Both figures over CPU seconds of an image, the front as a line, PNG."""
    figure = new_figure(11.0, 4.6, columns=2)
    ours = _own(points)
    for axes, (name, words) in zip(figure.axes, FIGURES.items(), strict=True):
        for group in sorted({str(p["group"]) for p in points}):
            some = [p for p in points if p["group"] == group and (group != "fullest" or name == "psnr")]
            axes.plot([cost(p, images) for p in some], [p[name] for p in some], "o", ms=4, label=group)
        line = [p for n in front(ours, images, name) for p in ours if p["name"] == n]
        axes.plot([cost(p, images) for p in line], [p[name] for p in line], "-", color="0.4", lw=1, zorder=0)
        for quality, chosen in qualities.items():
            for p in (p for p in ours if p["name"] == chosen):
                axes.annotate(quality, (cost(p, images), p[name]), xytext=(4, 6), textcoords="offset points")
        axes.set_xscale("log")
        axes.set_xlabel(f"CPU seconds per image, {images} images of a head")
        axes.set_ylabel(words)
    figure.axes[1].legend(fontsize=7, ncols=2)
    return encode_figure(figure, "png")


def _own(points: Sequence[Measured]) -> list[Measured]:
    """Of the first model, and not what all are compared with."""
    return [p for p in points if p["settings"]["model"] == 0 and p["group"] != "fullest"]
