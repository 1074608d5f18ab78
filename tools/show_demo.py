"""The page of the demo: ``python tools/show_demo.py DIR`` writes ``DIR/report.html`` and its twin.

DIR is what ``tools/demo.sh`` fills. The page shows what came of it: the photographs of a person that no prior has seen,
the heads that were fitted to them, side by side from views that were kept away, their surfaces beside the truth, their
orbits, the figures; and every command with what came of it and the time it took, so that it doubles as a tutorial.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from bench.head_truth_pictures import DEPTH_ERROR_SHOWN, NORMALS_ERROR_SHOWN
from demo_page.heads import BASELINE, BOX, HEAD, NONE, OWN, Head, heads_of, prior_of, same_views, words_about
from demo_page.pictures import geometry_sheet, inputs_sheet, orbit_frames, orbit_sheet, views_sheet
from demo_page.stages import Stage, read_stages, result_of
from preface.artifacts import ArtifactError, load_json, provenance
from preface.cli.output import exit_status
from preface.cli.render_frames import CAMERAS_FILE, VIDEO_FILE
from preface.cli.typed_flags import refusing, told_in_a_line
from preface.reports import KeyFigure, Link, Report, Section

PROGRAM = "show_demo"
STAGES_FILE = "stages.tsv"
VIDEO_SIZE = (288, 432)  # CSS pixels
# Per figure of an evaluation: its column on the page, and its unit.
FIGURES = {
    "psnr_face": ("face PSNR", "dB"),
    "ssim_face": ("face SSIM", ""),
    "lpips_face": ("face LPIPS", "VGG"),
    "psnr": ("frame PSNR", "dB"),
    "silhouette_iou": ("silhouette", "IoU"),
}
SURFACE = {
    "depth_median_mm": ("depth off", "mm"),
    "density_normals_median_deg": ("normals off", "°"),
}
REPORTS = {
    "The studio, its people and the truth about them": "studio.html",
    "Cameras": "rig.report.html",
    "Cameras of take 0": "rigs/take00.report.html",
    "Cameras of take 1": "rigs/take01.report.html",
    "Alignment": "alignment/report.html",
    "Alignment to the prior in the box": "alignment-pretrained/report.html",
    "Masks": "shards/masks.html",
    "Data card of the shards": "shards/README.md",
    "The prior while it was trained": "prior/validation",
    "The fit while it ran": "head/previews",
    "The fit from the prior in the box while it ran": "head-pretrained/previews",
    "Evaluation, with every figure": "evaluation/report.html",
    "Evaluation of the head from the prior in the box": "evaluation-pretrained/report.html",
    "Frames of the orbit": "renders",
    "Frames of the orbit, the prior in the box": "renders-pretrained",
}


@dataclass(frozen=True)
class ShowDemo:
    """Write the page that shows what the demo made."""

    folder: tyro.conf.Positional[Path]
    """What tools/demo.sh filled."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 0 when the page is written, 1 when something is missing."""
    with told_in_a_line(PROGRAM):
        config = tyro.cli(ShowDemo, prog=PROGRAM, args=arguments)

    def run() -> list[str]:
        return [str(build_report(config.folder).write(config.folder / "report.html"))]

    return exit_status(run, refusing(PROGRAM), config.folder)


def build_report(folder: Path) -> Report:
    """The whole page.

    Raises:
        ArtifactError: the demo has not come to its end in this folder.
    """
    heads = heads_of(folder)
    inputs = {f"{head.name}/metrics.json": head.evaluation / "metrics.json" for head in heads}
    report = Report("A head from two photographs", provenance({}, inputs))
    views = same_views(heads)
    _show_result(report.section("Result"), heads, views)
    _show_inputs(report.section("What was given"), heads[0])
    _show_views(report.section("Views that were kept away"), heads, views)
    if all(head.geometry for head in heads):
        _show_geometry(report.section("The surface, beside the truth"), heads)
    _show_orbits(report.section("From side to side"), [head for head in heads if head.name != BASELINE])
    _show_stages(report.section("How it was made"), folder)
    return report


def _show_result(section: Section, heads: Sequence[Head], views: Sequence[str]) -> None:
    fit = heads[0].fit
    section.text(
        f"""{fit["identity"]} is nobody that a prior was trained on. {len(heads)} heads of this person were fitted to
        the same {len(fit["views"])} photographs ({", ".join(fit["views"])}), and are measured here on {len(views)}
        others."""
    )
    section.key_figures(_headlines(heads))
    rows = [_row(head) for head in heads]
    units = {words: unit for words, unit in (*FIGURES.values(), *SURFACE.values()) if words in rows[0]}
    section.table(
        rows, f"Means over {len(views)} views that no head has seen{_measured_surface(heads)}", units=units
    )
    section.text(explanation(heads))


def _headlines(heads: Sequence[Head]) -> list[KeyFigure]:
    """The PSNR of each face, and what the fit gains by the prior that has its own architecture."""
    faces = {head.name: head.metrics["mean"].get("psnr_face") for head in heads}
    if None in faces.values():
        return [KeyFigure("Views measured", len(heads[0].metrics["views"]))]
    own = next(head for head in heads if head.name == HEAD)
    shown = [KeyFigure(f"PSNR of the face, from {h.start}", f"{faces[h.name]:.1f}", "dB") for h in heads]
    gain = faces[HEAD] - faces[BASELINE]
    return [*shown, KeyFigure(f"Gained by {own.start}", f"{gain:+.1f}".replace("-", "−"), "dB")]


def _row(head: Head) -> dict[str, Any]:
    """A head's means, with those of its surface where they were measured."""
    people = None if head.start == NONE else len(prior_of(head).identities)
    mean = head.metrics["mean"]
    row = {"fitted from": head.start, "people": people}
    row |= {words: mean[name] for name, (words, _) in FIGURES.items() if name in mean}
    surface = head.geometry["mean"] if head.geometry else {}
    return row | {words: surface[name] for name, (words, _) in SURFACE.items() if name in surface}


def _measured_surface(heads: Sequence[Head]) -> str:
    found = heads[0].geometry
    return f"; depth and normals: medians, over {', '.join(found['views'])} alone" if found else ""


def explanation(heads: Sequence[Head]) -> str:
    """What the heads were fitted from, and why they differ, in paragraphs."""
    own = next(head for head in heads if head.name == HEAD)
    prior = prior_of(own)
    told = [words_about(prior_of(head), head.start) for head in heads if head.start != NONE]
    told.append(
        f"""No prior: the architecture of {own.start}, fitted to the same photographs for as many steps ({own.steps}),
        but from random weights."""
    )
    if own.start == OWN:
        told.append(
            f"""Why the head from {OWN} is blurred: {len(prior.identities)} people span few of the ways in which faces
            differ, so that the code which comes nearest to somebody new is a mixture of them, and {prior.steps:,} steps
            of a tiny network leave even these people blurred. The {own.fit["finetuning"]["steps"]} steps of finetuning
            of the quality {own.fit["quality"]} are too few to bring out what two photographs show."""
        )
    if len({head.start for head in heads}) > 2:
        told.append(
            f"""Beside it, {BOX} shows what more people, more steps and a larger network give, at the price of a fit. It
            has a canonical frame of its own, so that the square of the face that is measured is a little another."""
        )
    return "\n\n".join(told)


def _show_inputs(section: Section, head: Head) -> None:
    sheet, (width, height) = inputs_sheet(head)
    section.image(
        sheet,
        f"The photographs at the {width}x{height} pixels that were fitted to, on black by their masks.",
        f"{len(head.fit['views'])} photographs of {head.fit['identity']}",
        "jpeg",
    )


def _show_views(section: Section, heads: Sequence[Head], views: Sequence[str]) -> None:
    section.image(
        views_sheet(heads, views),
        "By row, one camera: the photograph, with its angle at the head to the nearest that was fitted to; the heads, "
        "with the PSNR of the face; their errors.",
        f"Photographs beside renders of {len(heads)} heads, and their errors",
        "jpeg",
    )


def _show_geometry(section: Section, heads: Sequence[Head]) -> None:
    section.text(
        """The studio knows the surface behind each pixel. Depth is measured along the camera's axis and normals are
        derivatives of the density, which show its noise; both are compared where both have a surface. What calibration
        and alignment got wrong counts, too. Hair is strands here, whose depth jumps from pixel to pixel, and much of
        the error stands there."""
    )
    for kind, most in (("depth", f"{DEPTH_ERROR_SHOWN:.0f} mm"), ("normals", f"{NORMALS_ERROR_SHOWN:.0f}°")):
        section.image(
            geometry_sheet(heads, kind),
            f"By row, one camera that no head has seen: the true {kind}, the heads' with the median error, and the "
            f"errors up to {most}.",
            f"True {kind} beside those of {len(heads)} heads, and their errors",
            "jpeg",
        )


def _show_orbits(section: Section, heads: Sequence[Head]) -> None:
    for head in heads:
        frames = len(orbit_frames(head.renders))
        path = head.renders / VIDEO_FILE
        try:
            video = path.read_bytes()
        except OSError as error:
            raise ArtifactError.from_os(path, "reading", error) from error
        flags = load_json(head.renders / CAMERAS_FILE)["provenance"]["config"]
        azimuth, elevation = (float(flags[name]) for name in ("azimuth", "elevation"))
        section.video(
            video,
            VIDEO_SIZE,
            f"The head from {head.start}, {frames} frames: from side to side, {azimuth:.0f} degrees either way, and "
            f"{elevation:.0f} up and down.",
            f"The head from {head.start} turns from side to side",
        )
        section.image(
            orbit_sheet(head.renders),
            "Some of these frames: colour, depth, normals; below, what the colours mean.",
            f"Rows of colours, depths and normals of the head from {head.start}",
            "jpeg",
        )


def _show_stages(section: Section, folder: Path) -> None:
    stages = read_stages(folder / STAGES_FILE)
    total = sum(stage.seconds for stage in stages)
    section.table(
        [
            {"stage": s.name, "time": round(s.seconds), "what came of it": result_of(s.name, folder)}
            for s in stages
        ],
        f"Every stage in order, {total / 60:.1f} minutes in all; of one that ran more than once, its last run",
        units={"time": "s"},
    )
    section.table(_commands(stages), "And its command, from the checkout, with .venv activated")
    section.text("Each stage has a report or pictures of its own:")
    section.links([Link(words, path) for words, path in REPORTS.items() if (folder / path).exists()])


def _commands(stages: Sequence[Stage]) -> list[dict[str, Any]]:
    return [{"stage": stage.name, "command": stage.command} for stage in stages]


if __name__ == "__main__":
    sys.exit(main())
