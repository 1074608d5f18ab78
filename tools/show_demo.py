"""The page of the demo: ``python tools/show_demo.py DIR`` writes ``DIR/report.html`` and its twin.

DIR is what ``tools/demo.sh`` fills. The page shows what came of it: the photographs of a person that the prior has
never seen, the head that was fitted to them from views that were kept away, beside the same fit without a prior, the
orbit, the figures; and every command with the time it took, so that it doubles as a tutorial.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from preface.artifacts import ArtifactError, load_json, provenance, sha256
from preface.capture.images import read_image
from preface.cli.output import exit_status
from preface.cli.typed_flags import refusing, told_in_a_line
from preface.model.pretrained import pretrained_folder
from preface.model.training.prior_files import MODEL_FILE, read_prior
from preface.reports import KeyFigure, Link, Report, Section, contact_sheet
from preface.reports.pictures import Picture, as_picture
from preface.shards import Dataset

PROGRAM = "show_demo"
HEAD, BASELINE = "head", "head-without-prior"  # folders of the two fits, and their names in the evaluation
STAGES_FILE = "stages.tsv"
INPUT_HEIGHT = 288
STRIP = 6  # frames of the orbit that are shown beside the video
VIDEO_SIZE = (288, 432)  # CSS pixels
# Per figure: its name on the page, its unit, and whether more of it is better.
FIGURES = {
    "psnr_face": ("PSNR of the face", "dB", True),
    "ssim_face": ("SSIM of the face", "", True),
    "lpips_face": ("LPIPS of the face, VGG", "", False),
    "psnr": ("PSNR of the whole frame", "dB", True),
}


@dataclass(frozen=True)
class ShowDemo:
    """Write the page that shows what the demo made."""

    folder: tyro.conf.Positional[Path]
    """What tools/demo.sh filled."""


@dataclass(frozen=True)
class Stage:
    """A command of the demo, and the seconds that it took, over all runs."""

    name: str
    seconds: float
    command: str


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 0 when the page is written, 1 when something is missing."""
    with told_in_a_line(PROGRAM):
        config = tyro.cli(ShowDemo, prog=PROGRAM, args=arguments)

    def run() -> list[str]:
        return [str(build_report(config.folder).write(config.folder / "report.html"))]

    return exit_status(run, refusing(PROGRAM), config.folder)


def build_report(folder: Path) -> Report:
    """The whole page."""
    fit = read_prior(folder / HEAD).fit
    if fit is None:
        raise ArtifactError(folder / HEAD, "fit", "is not a head", "Run tools/demo.sh")
    names = (HEAD, BASELINE)
    metrics = {name: load_json(folder / "evaluation" / name / "metrics.json") for name in names}
    inputs = {f"{name}/metrics.json": folder / "evaluation" / name / "metrics.json" for name in names}
    report = Report("A head from two photographs", provenance({}, inputs))
    _show_result(report.section("Result"), fit, metrics, prior_words(folder, fit))
    _show_inputs(report.section("What was given"), folder, fit)
    for name, heading in ((HEAD, "Views that were kept away"), (BASELINE, "The same fit without a prior")):
        _show_sheet(report.section(heading), folder / "evaluation" / name, name)
    _show_orbit(report.section("All around"), folder / "renders")
    _show_stages(report.section("How it was made"), folder)
    return report


def prior_words(folder: Path, fit: Mapping[str, Any]) -> str:
    """Which prior a head was fitted from, as a sentence.

    Raises:
        ArtifactError: neither the one that was trained here nor the one that comes with preface.
    """
    if (folder / "prior" / MODEL_FILE).exists():
        path, whence = folder / "prior", "was trained here"
    else:
        path, whence = pretrained_folder(), "is the one that comes with preface, trained"
    prior = read_prior(path)
    if sha256(prior.path) != fit["prior"]:
        problem = f"is not that of {prior.path}"
        raise ArtifactError(
            folder / HEAD, "fit.prior", problem, "Delete the folder, and run tools/demo.sh again"
        )
    return (
        f"The prior {whence} on {len(prior.identities)} people who do not exist, for {prior.steps:,} steps."
    )


def _show_result(
    section: Section, fit: Mapping[str, Any], metrics: Mapping[str, Mapping[str, Any]], prior: str
) -> None:
    count, views = len(fit["views"]), len(metrics[HEAD]["views"])
    section.text(
        f"""{fit["identity"]} is nobody that the prior was trained on. Its head was fitted to {count} photographs
        ({", ".join(fit["views"])}) and is measured here on {views} others, beside a model of the same architecture
        that was trained on the same photographs for as many steps, but from random weights. {prior} Both models are
        small; more people, more steps and more pixels are what the commands below are for."""
    )
    means = {name: metrics[name]["mean"] for name in metrics}
    shown = {key: value for key, value in FIGURES.items() if all(key in mean for mean in means.values())}
    section.key_figures(
        [
            KeyFigure(f"{words}, with the prior", means[HEAD][key], unit)
            for key, (words, unit, _) in shown.items()
        ]
    )
    rows = []
    for key, (words, unit, more) in shown.items():
        gain = (means[HEAD][key] - means[BASELINE][key]) * (1 if more else -1)
        rows.append(
            {
                "figure": f"{words}{f', {unit}' if unit else ''}",
                "with the prior": means[HEAD][key],
                "without": means[BASELINE][key],
                "better by": gain,
            }
        )
    section.table(rows, f"Means over {views} views that neither has seen")


def _show_inputs(section: Section, folder: Path, fit: Mapping[str, Any]) -> None:
    with Dataset(folder / "shards") as dataset:
        person = dataset.names.index(fit["identity"])
        cameras = dataset.manifest.identities[person].cameras
        tiles: list[tuple[Picture | None, str]] = []
        for name in fit["views"]:
            pixels = dataset.pixels(person, cameras.index(name)).astype(np.float32) / 255
            tiles.append((as_picture(pixels[..., :3] * pixels[..., 3:]), name))
        width, height = dataset.manifest.width, dataset.manifest.height
    tile = (round(INPUT_HEIGHT * width / height), INPUT_HEIGHT)
    section.image(
        contact_sheet(tiles, len(tiles), tile),
        f"The photographs at the {width}x{height} pixels that were fitted to, on black by their masks.",
        f"{len(tiles)} photographs of {fit['identity']}",
        "jpeg",
    )


def _show_sheet(section: Section, folder: Path, name: str) -> None:
    section.image(
        read_image(folder / "sheet.png"),
        "By row, one camera: photograph, render, error (black is none, yellow a quarter of full scale), depth, "
        "normals (red to the subject's left, green up, blue out of the face), opacity.",
        f"Photographs beside renders of {name} with error, depth, normals and opacity",
        "jpeg",
    )


def _show_orbit(section: Section, folder: Path) -> None:
    frames = sorted(file.stem for file in folder.glob("????.png"))
    if not frames:
        raise ArtifactError(folder, "frames", "there are none", "Run tools/demo.sh")
    try:
        video = (folder / "orbit.webm").read_bytes()
    except OSError as error:
        raise ArtifactError.from_os(folder / "orbit.webm", "reading", error) from error
    section.video(video, VIDEO_SIZE, f"{len(frames)} frames of an orbit.", "The head turns from side to side")
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, min(STRIP, len(frames))).round().astype(int)]
    tiles: list[tuple[Picture | None, str]] = []
    for kind in ("", ".depth", ".normals"):
        for frame in chosen:
            tiles.append((as_picture(read_image(folder / f"{frame}{kind}.png")), f"{frame}{kind}"))
    height, width = tiles[0][0].shape[:2] if tiles[0][0] is not None else (1, 1)
    size = (round(INPUT_HEIGHT * width / height), INPUT_HEIGHT)
    section.image(
        contact_sheet(tiles, len(chosen), size),
        "Some of its frames: colour, depth, normals.",
        "Rows of colours, depths and normals around the head",
        "jpeg",
    )


def _show_stages(section: Section, folder: Path) -> None:
    stages = read_stages(folder / STAGES_FILE)
    total = sum(stage.seconds for stage in stages)
    rows = [{"stage": stage.name, "time": stage.seconds, "command": stage.command} for stage in stages]
    section.table(
        rows,
        f"Every command in order, {total / 60:.1f} minutes in all; a stage that was interrupted counts all its runs",
        units={"time": "s"},
    )
    section.text("Each stage has a report or pictures of its own:")
    reports = {
        "The studio, its people and the truth about them": "studio.html",
        "Cameras": "rig.report.html",
        "Cameras of take 0": "rigs/take00.report.html",
        "Cameras of take 1": "rigs/take01.report.html",
        "Alignment": "alignment/report.html",
        "Masks": "shards/masks.html",
        "Data card of the shards": "shards/README.md",
        "The prior while it was trained": "prior/validation",
        "The fit while it ran": f"{HEAD}/previews",
        "Evaluation, with every figure": "evaluation/report.html",
        "Frames of the orbit": "renders",
    }
    there = [Link(words, path) for words, path in reports.items() if (folder / path).exists()]
    section.links(there)


def read_stages(path: Path) -> Sequence[Stage]:
    """Read what demo.sh wrote down, lines of NAME, SECONDS and COMMAND; a stage that ran twice is one.

    Raises:
        ArtifactError: there is no such file, or a line is not of this form.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise ArtifactError.from_os(path, "reading", error) from error
    found: dict[str, Stage] = {}
    for number, line in enumerate(lines, 1):
        name, _, rest = line.partition("\t")
        seconds, _, command = rest.partition("\t")
        try:
            before = found[name].seconds if name in found else 0.0
            found[name] = Stage(name, before + float(seconds), command)
        except ValueError as error:
            problem = f"'{seconds}' is not a number of seconds"
            raise ArtifactError(path, f"line {number}", problem, "Delete the line") from error
    return list(found.values())


if __name__ == "__main__":
    sys.exit(main())
