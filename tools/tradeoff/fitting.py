"""How heads are fitted: steps, rays per step and resolution, one varied at a time from a quality's defaults.

Or the qualities themselves. All heads are rendered by the quality that `preface-render` has by default: what a user
gets end to end.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from preface.artifacts import write_bytes
from preface.cli.output import say
from preface.model.fitting.configuration import (
    QUALITIES,
    FinetuningConfig,
    FitConfig,
    InversionConfig,
    finetuning_steps,
)
from preface.model.pretrained import prior_flag
from preface.model.rendering.shortcuts import DEFAULT_QUALITY
from preface.shards import Dataset

STEPS = (50, 150, 500, 1500, 5000)  # of finetuning
INVERSION_STEPS = (0, 50, 200, 600, 1500)
RAYS = (128, 512, 2048, 8192)
VARIED = ("steps", "inversion", "rays", "resolution")
FIGURES = ("psnr", "ssim", "lpips", "psnr_face")
TAKEN = ("cpu_s", "view_cpu_s", "peak_mib")


@dataclass(frozen=True)
class Fit:
    """A fit to measure.

    Attributes:
        name, group: of the point.
        config: of the fit.
        evaluated: shards whose views, but for those fitted to, it is held against.
    """

    name: str
    group: str
    config: FitConfig
    evaluated: Path


def add_flags(parser: argparse.ArgumentParser) -> None:
    """The flags of the sub-command, and what it runs."""
    parser.add_argument("shards", type=Path, help="views to fit and, the others, to measure at")
    parser.add_argument("--prior", type=prior_flag, required=True, help="its folder, or `pretrained`")
    parser.add_argument("--people", nargs="+", required=True, help="identities of the shards")
    parser.add_argument("--views", nargs="+", required=True, help="cameras that are fitted to")
    parser.add_argument(
        "--resolutions", type=Path, nargs="*", default=[], help="shards of the same views in other sizes"
    )
    parser.add_argument("--quality", choices=list(QUALITIES), default="balanced", help="what is not varied")
    parser.add_argument(
        "--vary",
        nargs="+",
        choices=[*VARIED, "quality"],
        default=list(VARIED),
        help="what is varied; `quality`: each as it is",
    )
    parser.add_argument("--most-steps", type=int, default=STEPS[-1], help="leave out longer fits")
    parser.add_argument("--output", type=Path, required=True)
    parser.set_defaults(run=sweep)


def fits(options: argparse.Namespace, person: str) -> Iterator[Fit]:
    """All fits of a person."""
    inversion, finetuning, run = QUALITIES[options.quality]
    start = FitConfig(
        options.shards, Path(), options.prior, person, tuple(options.views), options.quality,
        inversion=inversion, finetuning=finetuning, run=run,
    )  # fmt: skip

    def one(name: str, group: str, shards: Path, first: InversionConfig, then: FinetuningConfig) -> Fit:
        folder = options.output / "heads" / f"{person}-{name.replace(' ', '-')}"
        config = replace(start, shards=shards, output=folder, inversion=first, finetuning=then)
        return Fit(name, group, config, options.shards)

    vary = set(options.vary)
    if vary != {"quality"}:
        yield one(options.quality, "as it is", options.shards, inversion, finetuning)
    for steps in (n for n in STEPS if n <= options.most_steps and "steps" in vary):
        yield one(f"steps {steps}", "steps", options.shards, inversion, replace(finetuning, steps=steps))
    for steps in (n for n in INVERSION_STEPS if n <= options.most_steps and "inversion" in vary):
        yield one(
            f"inversion {steps}", "inversion", options.shards, replace(inversion, steps=steps), finetuning
        )
    for rays in RAYS if "rays" in vary else ():
        yield one(f"rays {rays}", "rays", options.shards, inversion, replace(finetuning, rays=rays))
    for shards in options.resolutions if "resolution" in vary else ():
        manifest = Dataset(shards).manifest
        name = f"resolution {manifest.width}x{manifest.height}"
        yield one(name, "resolution", shards, inversion, finetuning)
    if "quality" in vary:
        yield from _qualities(options, start)


def _qualities(options: argparse.Namespace, start: FitConfig) -> Iterator[Fit]:
    """Each quality as it is, but for those with too many steps."""
    manifest = Dataset(options.shards).manifest
    for name, (inversion, finetuning, run) in QUALITIES.items():
        if finetuning_steps(finetuning, manifest.width, manifest.height) <= options.most_steps:
            output = Path(options.output) / "heads" / f"{start.identity}-quality-{name}"
            config = replace(start, output=output, inversion=inversion, finetuning=finetuning, run=run)
            config = replace(config, quality=name)  # type: ignore[arg-type]
            yield Fit(f"quality {name}", "quality", config, options.shards)


def measure(fit: Fit) -> dict[str, Any]:
    """Fit and evaluate, in this process: means of figures over views not fitted to, CPU seconds, memory.

    `view_cpu_s` is what a view takes to render, its share of preparing the head and its PSNR and SSIM included.
    """
    import torch

    from preface.model.evaluation.evaluate import evaluate_head
    from preface.model.evaluation.figures import judge
    from preface.model.evaluation.metrics_file import mean_of
    from preface.model.evaluation.options import EvaluationOptions
    from preface.model.fitting.run import fit_head
    from preface.model.training.prior_files import read_prior

    began = time.process_time()
    ended = fit_head(fit.config, say)
    seconds = time.process_time() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    assert fit.config.identity is not None
    dataset = Dataset(fit.evaluated)
    options = EvaluationOptions("none", quality=DEFAULT_QUALITY, normals=False)
    began = time.process_time()
    found = evaluate_head(read_prior(ended.path), dataset, fit.config.identity, None, options)
    per_view = (time.process_time() - began) / len(found.views)
    vgg = judge({"lpips": "vgg"}, torch.device("cpu"))
    pairs = [vgg.pair(view.rgb, view.truth).values for view in found.views]
    mean = found.mean | mean_of(pairs)
    figures = {name: mean[name] for name in FIGURES if name in mean}
    return {**figures, "cpu_s": seconds, "view_cpu_s": per_view, "peak_mib": peak}


def sweep(options: argparse.Namespace) -> list[str]:
    """Measure the fits that are missing, then write the table and the plot."""
    path = options.output / "fit.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    state: dict[str, Any] = json.loads(path.read_bytes()) if path.exists() else {"points": {}}
    every = [fit for person in options.people for fit in fits(options, person)]
    for number, fit in enumerate(every):
        key = json.dumps(
            [str(fit.config.shards), str(fit.config.prior), fit.config.to_dict(), DEFAULT_QUALITY],
            sort_keys=True,
        )
        if key not in state["points"]:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                found = pool.submit(measure, fit).result()
            state["points"][key] = {
                "name": fit.name,
                "group": fit.group,
                "person": fit.config.identity,
                **found,
            }
            write_bytes(path, (json.dumps(state, indent=2) + "\n").encode())
            say(f"{number + 1} of {len(every)}: {fit.config.identity} {fit.name}: {found['psnr']:.2f} dB")
    rows = means(list(state["points"].values()))
    text = table(rows)
    write_bytes(options.output / "fit.md", f"{text}\n".encode())
    write_bytes(options.output / "fit.png", plot(rows))
    return [text, str(path)]


def means(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over people, and the figures by which nothing that took less CPU time is as good."""
    rows = []
    for name in dict.fromkeys(p["name"] for p in points):
        some = [p for p in points if p["name"] == name]
        figures = {key: sum(p[key] for p in some) / len(some) for key in (*FIGURES, *TAKEN) if key in some[0]}
        rows.append({"name": name, "group": some[0]["group"], "people": len(some), **figures})
    for row in rows:
        cheaper = [other for other in rows if other["cpu_s"] < row["cpu_s"]]
        row["front"] = [
            name for name in FIGURES if name in row and all(_better(name, row, o) for o in cheaper)
        ]
    return rows


def _better(name: str, one: dict[str, Any], other: dict[str, Any]) -> bool:
    less = name.startswith("lpips")
    return bool(one[name] < other[name] if less else one[name] > other[name])


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| fit | people | PSNR | SSIM | LPIPS | PSNR face | CPU s | CPU s per view | MiB | front |",
        "|" + "---|" * 10,
    ]
    for row in sorted(rows, key=lambda r: (r["group"], r["cpu_s"])):
        figures = " | ".join(f"{row.get(name, float('nan')):.4g}" for name in FIGURES)
        front = ", ".join(row["front"])
        lines.append(
            f"| {row['name']} | {row['people']} | {figures} | {row['cpu_s']:.0f} | {row['view_cpu_s']:.2f} "
            f"| {row['peak_mib']:.0f} | {front} |"
        )
    return "\n".join(lines)


def plot(rows: list[dict[str, Any]]) -> bytes:
    """PSNR at views not fitted to over CPU seconds, PNG."""
    from preface.reports.plots import encode_figure, new_figure

    figure = new_figure(6.4, 4.6)
    (axes,) = figure.axes
    for group in dict.fromkeys(row["group"] for row in rows):
        some = sorted((row for row in rows if row["group"] == group), key=lambda r: r["cpu_s"])
        axes.plot([r["cpu_s"] for r in some], [r["psnr"] for r in some], "o-", ms=4, lw=0.8, label=group)
    axes.set_xscale("log")
    axes.set_xlabel("CPU seconds per head")
    axes.set_ylabel("PSNR at views not fitted to, dB")
    axes.legend(fontsize=8)
    return encode_figure(figure, "png")
