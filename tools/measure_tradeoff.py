"""Speed for accuracy, measured: how well and how fast heads are rendered and fitted, over what can be chosen.

    python tools/measure_tradeoff.py render SHARDS MODEL [MODEL ...] --output tradeoff [--people id0001 id0002]
    python tools/measure_tradeoff.py fit SHARDS --prior prior/ --people id0060 --views cam02 cam08 --output tradeoff-fit

`render` varies samples, precision, levels of the encoding and each shortcut of `preface-render` one at a time, then
choices of them together, on identities of the first MODEL (a head or a prior) at views that it has not seen; further
models, which may differ in width, are measured beside it. Per point: PSNR, SSIM and LPIPS (VGG) to the photographs,
PSNR, opacity and depth against the fullest render (128 128 64 samples or twice its own), PSNR against the model as
trained, CPU time per ray and to prepare a head, peak memory above that of the loaded model, and operations of matrix
products per ray.

`fit` varies steps, rays per step and resolution of `preface-fit`, one at a time; with `--vary quality`, it measures the
qualities end to end.

OUTPUT/<render or fit>.json has the figures, and the same command goes on where it was interrupted; .png shows the
fronts, .md the table. Qualities are chosen from the front by the rules in `tradeoff.front`. Let nothing else run.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, write_bytes
from preface.cli.folders import make_folder
from preface.cli.output import exit_status, resumable, say, whole_number
from preface.cli.usage import Parser
from preface.model.pretrained import prior_flag
from preface.model.training.prior_files import read_prior
from preface.shards import Dataset
from tradeoff import fitting, report
from tradeoff.front import IMAGES, chosen
from tradeoff.measuring import Task, measure_apart, views_of
from tradeoff.points import fullest, render_points


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    render = commands.add_parser("render", help="how heads are rendered")
    render.add_argument("shards", type=Path)
    render.add_argument(
        "models",
        type=prior_flag,
        nargs="+",
        help="folders of priors or heads, or `pretrained`; the first is chosen for",
    )
    render.add_argument("--people", nargs="+", help="identities (default: the first three of the model)")
    render.add_argument("--views", type=whole_number(1), default=1, help="of each, not seen by the model")
    render.add_argument(
        "--images", type=whole_number(1), default=IMAGES, help="of a head, that share its preparation"
    )
    render.add_argument("--small", action="store_true", help="a third of the points")
    render.add_argument("--output", type=Path, required=True)
    render.set_defaults(run=sweep_render)
    fitting.add_flags(commands.add_parser("fit", help="how heads are fitted"))
    options = parser.parse_args(arguments)
    return resumable(
        lambda: exit_status(lambda: options.run(options), parser, parser.prog, lambda: (OSError,))
    )


def sweep_render(options: argparse.Namespace) -> list[str]:
    """Measure the points that are missing, then write the table and the plots."""
    priors, dataset = [read_prior(path) for path in options.models], Dataset(options.shards)
    people = options.people or list(priors[0].identities[:3])
    for prior in priors:
        if missing := [who for who in people if who not in prior.identities]:
            raise ArtifactError(
                prior.path, "identities", f"there is no '{missing[0]}'", "Choose others by --people"
            )
    views = views_of(priors[0], dataset, people, options.views)
    points = [fullest(number, prior) for number, prior in enumerate(priors)]
    points += render_points(priors, small=options.small)
    rays = dataset.manifest.width * dataset.manifest.height
    state = _state(options.output / "render.json", {"views": [list(v) for v in views], "rays": rays})
    for number, point in enumerate(points):
        key = json.dumps([point.group, point.settings()], sort_keys=True)
        if key in state["points"]:
            continue
        task = Task(point, options.models[point.model], options.shards, views, options.output / "full")
        found = measure_apart(task)
        state["points"][key] = {
            "name": point.name, "group": point.group, "settings": point.settings(), "rays": rays, **found
        }  # fmt: skip
        _write(options.output / "render.json", state)
        say(
            f"{number + 1} of {len(points)}: {point.name}: {found['psnr']:.2f} dB, to the fullest "
            f"{found['psnr_to_full']:.2f} dB, {found['cpu_us_per_ray']:.0f} us per ray"
        )
    measured = list(state["points"].values())
    qualities = chosen(measured, options.images)
    state["qualities"] = qualities
    text = report.table(measured, options.images, qualities)
    told = "\n".join(f"- {quality}: {name or 'no point will do'}" for quality, name in qualities.items())
    write_bytes(options.output / "render.png", report.plot(measured, options.images, qualities))
    write_bytes(options.output / "render.md", f"{text}\n\n{told}\n".encode())
    return [text, told, str(_write(options.output / "render.json", state))]


def _state(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """What was measured before, if it was of the same views.

    Raises:
        ArtifactError: it was of others.
    """
    make_folder(path.parent)
    if not path.exists():
        return {**settings, "points": {}}
    before: dict[str, Any] = json.loads(path.read_bytes())
    for name, value in settings.items():
        if before.get(name) != value:
            raise ArtifactError(
                path, name, "is of another sweep", "Choose another --output, or remove the file"
            )
    return before


def _write(path: Path, state: dict[str, Any]) -> Path:
    return write_bytes(path, (json.dumps(state, indent=2) + "\n").encode())


if __name__ == "__main__":
    sys.exit(main())
