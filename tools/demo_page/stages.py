"""The stages of the demo: what `tools/demo.sh` noted down of each, and what came of it, in figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from demo_page.heads import BASELINE, BOX, FROM_THE_BOX, HEAD, SUFFIX, Head, heads_of, prior_of
from demo_page.pictures import orbit_frames
from preface.artifacts import ArtifactError, load_json
from preface.capture.manifest import read_capture
from preface.capture.rig import Rig, read_rig
from preface.cli.rig_files import rig_files
from preface.geometry import fit_similarity
from preface.shards import Dataset


@dataclass(frozen=True)
class Stage:
    """A command of the demo, and the seconds that its last run took."""

    name: str
    seconds: float
    command: str


def read_stages(path: Path) -> Sequence[Stage]:
    """Read what demo.sh wrote down, lines of NAME, SECONDS and COMMAND; of a stage that ran twice the last counts.

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
            found[name] = Stage(name, float(seconds), command)
        except ValueError as error:
            problem = f"'{seconds}' is not a number of seconds"
            raise ArtifactError(path, f"line {number}", problem, "Delete the line") from error
    return list(found.values())


def result_of(stage: str, folder: Path) -> str:
    """What came of a stage, in figures that are read from its artefacts; empty where there are none to tell.

    Raises:
        ArtifactError: an artefact is missing or damaged.
    """
    tell = _RESULTS.get(stage)
    return "" if tell is None else tell(folder)


def camera_error(rig: Rig, truth: Rig) -> float:
    """How far a rig's cameras stand from the true ones, RMS of their places, mm.

    A calibration chooses its frame, so that the rig is turned and moved, but not scaled, to where the places agree
    best.
    """
    names = [name for name in rig.cameras if name in truth.cameras]
    found, true = (
        np.array([of.cameras[name].camera_from_rig.inverse.translation for name in names])
        for of in (rig, truth)
    )
    onto = fit_similarity(found, true, fixed_scale=1.0).target_from_source
    return float(1e3 * np.sqrt(((onto.apply(found) - true) ** 2).sum(-1).mean()))


def _studio(folder: Path) -> str:
    manifest = read_capture(folder / "capture").manifest
    photographs, board = (
        len(list((folder / "capture").glob(f"{kind}/**/*.png"))) for kind in ("subjects", "calibration")
    )
    people = f"{len(manifest.subjects)} {'person' if len(manifest.subjects) == 1 else 'people'}"
    return f"{people}, {len(manifest.cameras)} cameras, {photographs} photographs, {board} of the board"


def _calibration(folder: Path) -> str:
    rigs = [read_rig(path) for path in rig_files(folder)]
    truths = {rig.take: folder / "truth" / "takes" / rig.take for rig in rigs}
    rigs = [rig for rig in rigs if truths[rig.take].is_dir()]  # those of renders are of no take
    if not rigs:
        raise ArtifactError(folder, "rigs", "none is of a take of the studio", "Run tools/demo.sh again")
    errors = [camera_error(rig, read_rig(truths[rig.take])) for rig in rigs]
    kept_away = [rig.held_out_reprojection_error.rms for rig in rigs if rig.held_out_reprojection_error]
    corners = f"corners kept away {max(kept_away):.3f} px off, " if kept_away else ""
    return f"{corners}cameras {max(errors):.2f} mm from the truth (RMS{', the worse take' if len(rigs) > 1 else ''})"


def _alignment(folder: Path) -> str:
    index = load_json(folder / "alignment.json")
    entries = index["aligned"]
    of_all = len(entries) + len(index["excluded"])
    residuals = [r for e in entries for r in load_json(folder / e["file"])["residuals"].values()]
    off = 1e3 * float(np.sqrt(np.mean(np.square(residuals))))
    return f"{len(entries)} of {of_all} aligned, keypoints {off:.1f} mm from the template (RMS)"


def _shards(folder: Path) -> str:
    with Dataset(folder) as dataset:
        manifest, views = (
            dataset.manifest,
            int((dataset.tables["view_valid"][: len(dataset.names)] == 1).sum()),
        )
    size = sum(file.stat().st_size for file in folder.glob("*.safetensors")) / 1e6
    return f"{views} views of {manifest.width}x{manifest.height} pixels, {size:.0f} MB"


def _prior(folder: Path) -> str:
    prior = prior_of(_named(folder, HEAD))
    trained = f"{len(prior.identities)} people, {prior.steps:,} steps"
    reached = prior.validation.get("psnr_foreground")
    return trained if reached is None else f"{trained}; {reached:.1f} dB on their heads, in views kept away"


def _head(name: str) -> Callable[[Path], str]:
    def tell(folder: Path) -> str:
        head = _named(folder, name)
        face = head.metrics["mean"].get("psnr_face")
        return f"{head.steps} steps" + (
            "" if face is None else f"; {face:.1f} dB on the face, in views kept away"
        )

    return tell


def _evaluation(name: str) -> Callable[[Path], str]:
    def tell(folder: Path) -> str:
        return f"{len(_named(folder, name).metrics['views'])} views kept away"

    return tell


def _geometry(name: str) -> Callable[[Path], str]:
    def tell(folder: Path) -> str:
        found = _named(folder, name).geometry
        if found is None:
            raise ArtifactError(folder / "geometry", "file", "is missing", "Run tools/demo.sh again")
        mean, views = found["mean"], len(found["views"])
        depth, normals = mean["depth_median_mm"], mean["density_normals_median_deg"]
        return f"depth off by {depth:.1f} mm, normals by {normals:.0f}° (medians, {views} views)"

    return tell


def _named(folder: Path, name: str) -> Head:
    return next(head for head in heads_of(folder) if head.name == name)


# By the names that demo.sh gives its stages.
OF_THE_BOX = f", {BOX}"
_RESULTS: dict[str, Callable[[Path], str]] = {
    "synthetic studio": _studio,
    "calibration": _calibration,
    "alignment": lambda folder: _alignment(folder / "alignment"),
    "shards": lambda folder: _shards(folder / "shards"),
    "prior": _prior,
    "fit": _head(HEAD),
    "fit without a prior": _head(BASELINE),
    "orbit": lambda folder: f"{len(orbit_frames(folder / 'renders'))} frames",
    "evaluation": _evaluation(HEAD),
    "geometry": _geometry(HEAD),
    f"alignment{OF_THE_BOX}": lambda folder: _alignment(folder / f"alignment{SUFFIX}"),
    f"shards{OF_THE_BOX}": lambda folder: _shards(folder / f"shards{SUFFIX}"),
    f"fit{OF_THE_BOX}": _head(FROM_THE_BOX),
    f"orbit{OF_THE_BOX}": lambda folder: f"{len(orbit_frames(folder / f'renders{SUFFIX}'))} frames",
    f"evaluation{OF_THE_BOX}": _evaluation(FROM_THE_BOX),
    f"geometry{OF_THE_BOX}": _geometry(FROM_THE_BOX),
}
