"""Real faces, end to end: heads from few photographs, with and without the prior, on views that were kept away.

    python tools/real_faces.py walk-around FOLDER --output real/person
    python tools/real_faces.py studio FOLDER --output real/studio --squares 9x6 --square-size 0.010

`walk-around` takes the pictures of one person by one moving camera: `images/`, a COLMAP model in `sparse/0`, and
perhaps masks in `matte/`, which only measure ours. Heads are fitted to 2, 3, 5 and 7 of the pictures, spread over the
directions that they were taken from, with the shipped cameras: from the prior, and from nothing (`--prior none`) at
equal steps. The same prior is also fitted with cameras of `preface-align photos`; the shipped ones are brought to that
head by a similarity of the face's keypoints, so that both are measured on the same views. The views to measure on are
those that none of the heads has seen.

`studio` takes `calibration/<camera>/` and `subjects/<identity>/<camera>/`, as `preface-align studio` reads them; each
person is fitted to all cameras but one, each in turn.

Every command is printed before it runs, and what is finished is not done again. Writes `table.md` and `table.json`.
"""

import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from preface.artifacts import load_json, provenance, write_bytes
from preface.capture.rig import read_rig
from preface.cli.folders import make_folder, require_writable
from preface.cli.output import exit_status, resumable
from preface.cli.typed_flags import refusing, told_in_a_line
from preface.geometry import Rigid, Similarity, fit_similarity
from preface.model.fitting.configuration import Quality, defaults
from preface.model.pretrained import flag_word
from preface.shards import Dataset
from preface.shards.building import build_manifest
from preface.shards.heads import head_of
from preface.shards.writer import ShardWriter

PROGRAM = "real_faces"
PERSON = "person"
FIGURES = ("psnr", "ssim", "lpips", "psnr_face", "ssim_face", "lpips_face")


class CommandError(RuntimeError):
    """A command that has failed, and has said why."""


@dataclass(frozen=True)
class RealFaces:
    """Fit heads to real photographs and measure them on others.

    FOLDER of a walk-around: images/NAME.jpg (or another format) of one person by one moving camera, a COLMAP model of
    them in sparse/0/, and perhaps masks, which only measure ours, in matte/.

    FOLDER of a studio: calibration/CAMERA/ with frames of a chessboard, and subjects/IDENTITY/CAMERA.jpg.

    What is finished is not done again. OUTPUT/table.md and table.json have the figures.
    """

    layout: tyro.conf.Positional[Literal["walk-around", "studio"]]
    """How FOLDER is laid out, see above."""
    folder: tyro.conf.Positional[Path]
    """The photographs."""
    output: Path
    """Where everything is written."""
    prior: Literal["pretrained"] | Path = "pretrained"
    """Folder of the prior, with template.json; `pretrained` is the one that comes with preface."""
    quality: Quality = "draft"
    """Of the fits."""
    resolution: str = "144x216"
    """WIDTHxHEIGHT of the views, cut out around the head."""
    counts: tuple[int, ...] = (2, 3, 5, 7)
    """Numbers of pictures to fit to, of a walk-around."""
    one_command: tuple[int, ...] = (3,)
    """Numbers of pictures, of a walk-around and among --counts, to fit to with nothing else known, too: cameras and
    masks are found by preface-fit."""
    squares: str = "9x6"
    """Of the studio's chessboard, inner corners."""
    square_size: float = 0.010
    """Of the studio's chessboard, metres."""


@dataclass(frozen=True)
class Row:
    """A head that was measured: to how many views of whom it was fitted, how, and its metrics.json."""

    person: str
    views: int
    how: str
    metrics: Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all stages; 0 when the table is written, 1 when a command failed or something is missing."""
    with told_in_a_line(PROGRAM):
        config = tyro.cli(RealFaces, prog=PROGRAM, args=arguments)
    reasons = (CommandError, OSError)
    return resumable(
        lambda: exit_status(lambda: [str(_table(config))], refusing(PROGRAM), config.folder, lambda: reasons)
    )


def _table(config: RealFaces) -> Path:
    """Run what is not done yet, and write the table."""
    require_writable(make_folder(config.output))
    rows = _walk_around(config) if config.layout == "walk-around" else _studio(config)
    table = [_figures(row) for row in rows]
    write_bytes(config.output / "table.json", (json.dumps(table, indent=1) + "\n").encode())
    return write_bytes(config.output / "table.md", _markdown(table).encode())


# ------------------------------------------------------------------------------------- walk-around


def _walk_around(config: RealFaces) -> list[Row]:
    """One person: shipped cameras, our keypoints and masks; then nothing but the pictures."""
    work = config.output
    rig = work / "rig.json"
    if not rig.exists():
        model = config.folder / "sparse" / "0"
        _run("preface-calibrate", "import", model, "--scale", "arbitrary", "--output", rig)
    pictures = {file.stem: file for file in sorted((config.folder / "images").iterdir())}
    subject = work / "capture" / "subjects" / PERSON
    _copy(pictures, subject)
    shards = _shards(config, subject.parents[1], rig)
    order = _by_direction(shards)
    most = _spread(order, max(config.counts))
    away = [name for name in order if name not in most]
    rows = []
    for count in config.counts:
        views = _spread(most, count)
        for how, prior in (("prior", config.prior), ("none", "none")):
            head = _fit(config, shards, prior, PERSON, views, work / f"heads/{count}-{how}")
            rows.append(Row(config.folder.name, count, how, _measured(head, shards, away)))
        if count in config.one_command:
            rows.append(_from_pictures(config, shards, {name: pictures[name] for name in views}, away))
    return rows


def _from_pictures(config: RealFaces, shards: Path, pictures: Mapping[str, Path], away: Sequence[str]) -> Row:
    """Fit to pictures of which nothing is known, and measure on the shipped cameras, brought onto ours."""
    count = len(pictures)
    folder, head = config.output / f"pictures/{count}/{PERSON}", config.output / f"heads/{count}-pictures"
    _copy(pictures, folder)
    _run("preface-fit", folder, "--prior", config.prior, "--quality", config.quality, "--output", head)
    with Dataset(shards) as shipped, Dataset(head / "photos" / "shards") as found:
        ours_from_shipped = _between(*(dataset.tables["keypoints"][0] for dataset in (shipped, found)))
        moved = _moved(shipped, ours_from_shipped, config.output / f"moved/{count}")
    return Row(config.folder.name, count, "prior, one command", _measured(head, moved, away))


def _copy(files: Mapping[str, Path], folder: Path) -> None:
    make_folder(folder)
    for name, file in files.items():
        shutil.copy(file, folder / f"{name}{file.suffix}")


def _poses(dataset: Dataset) -> dict[str, np.ndarray]:
    """Camera to canonical_from_camera [3, 4] of the first identity."""
    cameras, poses = dataset.manifest.identities[0].cameras, dataset.tables["canonical_from_camera"][0]
    return {str(name): pose for name, pose in zip(cameras, poses, strict=True) if name is not None}


def _by_direction(shards: Path) -> list[str]:
    """Cameras from the subject's right to its left."""
    with Dataset(shards) as dataset:
        poses = _poses(dataset)
    return sorted(poses, key=lambda name: float(np.arctan2(poses[name][0, 3], poses[name][2, 3])))


def _spread(names: Sequence[str], count: int) -> list[str]:
    """`count` of the names, the first and the last among them."""
    return [names[i] for i in np.linspace(0, len(names) - 1, count).round().astype(int)]


def _between(shipped: np.ndarray, found: np.ndarray) -> Similarity:
    """The similarity that carries one face's keypoints [5, 3] onto another's; NaN where one is not known.

    By the face and not by the cameras: where focal length or principal point are known differently, cameras that see
    the same are elsewhere and turned otherwise, all of them alike, and no motion of them all brings them together.
    """
    known = np.isfinite(shipped).all(axis=1) & np.isfinite(found).all(axis=1)
    return fit_similarity(shipped[known], found[known]).target_from_source


def _moved(dataset: Dataset, motion: Similarity, folder: Path) -> Path:
    """The first identity's views with cameras that were moved, as shards."""
    make_folder(folder)
    size = dataset.manifest.width, dataset.manifest.height
    head = head_of(dataset, 0, range(dataset.manifest.views))
    poses = [motion.apply_to_pose(Rigid(m[:, :3], m[:, 3])) for m in head.views.world_from_camera]
    placed = replace(head.views, world_from_camera=np.stack([pose.matrix[:3] for pose in poses]))
    with ShardWriter(folder, 0, size, "raster", "moved") as shard:
        shard.add(replace(head, views=placed, keypoints=motion.apply(head.keypoints)))
    made = provenance({"moved": True}, {"manifest.json": dataset.manifest.path})
    build_manifest(folder, 1, {"train": [head.identity]}, {}, made)
    return folder


# ------------------------------------------------------------------------------------------ studio


def _studio(config: RealFaces) -> list[Row]:
    """Every person from all cameras but one, which measures."""
    rig = config.output / "rig.json"
    board = ["--board", "chessboard", "--squares", config.squares, "--square-size", str(config.square_size)]
    if not rig.exists():
        _run("preface-calibrate", "board", config.folder, *board, "--output", rig)
    shards = _shards(config, config.folder, rig)
    cameras = list(read_rig(rig).cameras)
    with Dataset(shards) as dataset:
        people = dataset.names
    rows = []
    for person in people:
        for away in cameras:
            views = [camera for camera in cameras if camera != away]
            for how, prior in (("prior", config.prior), ("none", "none")):
                head = _fit(
                    config,
                    shards,
                    prior,
                    person,
                    views,
                    config.output / f"heads/{person}-without-{away}-{how}",
                )
                rows.append(Row(f"{person}, {away}", len(views), how, _measured(head, shards, [away])))
    return rows


# ------------------------------------------------------------------------------------------ stages


def _shards(config: RealFaces, source: Path, rig: Path) -> Path:
    """Align everybody onto the prior's template, and build shards with masks of our own."""
    alignment, shards = config.output / "alignment", config.output / "shards"
    onto = ["--rig", rig, "--template", config.prior]
    if not (alignment / "alignment.json").exists():
        _run("preface-align", "studio", source, *onto, "--output", alignment)
    where = ["--rig", rig, "--alignment", alignment, "--output", shards]
    how = ["--resolution", config.resolution, "--framing", "box", "--foreground", "selfie"]
    _run("preface-build-shards", source, *where, *how)
    return shards


def _fit(
    config: RealFaces, shards: Path, prior: str | Path, person: str, views: Sequence[str], head: Path
) -> Path:
    """Fit a head; without a prior, one with the prior's architecture, and inversion's steps are finetuning's."""
    start: list[object] = ["--prior", prior]
    inversion, finetuning, _ = defaults(config.quality)
    if prior != config.prior:
        start += ["--like", config.prior]
        if finetuning.steps != "auto":
            start += ["--finetuning.steps", inversion.steps + finetuning.steps]
    who = ["--identity", person, "--views", *views]
    _run("preface-fit", shards, *start, "--quality", config.quality, *who, "--output", head)
    return head


def _measured(head: Path, shards: Path, views: Sequence[str]) -> Path:
    """The metrics.json of a head on some views."""
    output = head.parent / f"{head.name}-measured"
    metrics = output / head.name / "metrics.json"
    if metrics.exists() and metrics.stat().st_mtime > (head / "model.json").stat().st_mtime:
        return metrics
    where = ["--shards", shards, "--views", *views, "--output", output]
    # Of figures alone, as heads are rendered by default: within 0.03 dB of the full evaluation in 0.4 of its time.
    _run("preface-evaluate", head, *where, "--quality", "balanced", "--no-normals", "--lpips", "vgg")
    return metrics


def _run(command: str, *arguments: object) -> None:
    """Print a command and run it.

    Raises:
        CommandError: it did not end with 0.
    """
    words = [command, *map(flag_word, arguments)]
    print(f"\n$ {shlex.join(words)}", flush=True)
    ended = subprocess.run([str(Path(sys.executable).with_name(command)), *words[1:]], check=False)
    if ended.returncode:
        raise CommandError(f"{command} ended with {ended.returncode}")


# ------------------------------------------------------------------------------------------- table


def _figures(row: Row) -> dict[str, Any]:
    mean = load_json(row.metrics)["mean"]
    figures = {name: mean[name] for name in FIGURES if name in mean}
    return {"person": row.person, "views": row.views, "fitted from": row.how, **figures}


def _markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    names = list(rows[0])
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    for row in rows:
        cells = (f"{row[n]:.4g}" if isinstance(row[n], float) else str(row[n]) for n in names)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
