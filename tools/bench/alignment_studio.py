"""How right an alignment of the synthetic studio is: keypoints against the surface, with true and calibrated rigs.

    python tools/bench/alignment_studio.py STUDIO [--rigs FOLDER] [--again STUDIO2 [--again-rigs FOLDER2]] \\
        [--work FOLDER] [--json figures.json]

STUDIO is made by `tools/synthetic_studio`; FOLDER holds what `preface-calibrate board STUDIO/capture --output
FOLDER` wrote. STUDIO2 is the same studio with another `--sensor.exposure-seed`: what differs between the two
alignments is the effect of the sensors' noise alone (and, with FOLDER2, of the noise in the calibration).

`preface-align` is run for every pair of photographs and rigs, with landmarks found once per studio (a folder
WORK/first-true that is there already is used again), and what it wrote is read.
Keypoints of calibrated rigs are carried into the studio's frame as `alignment_truth.Truth.true_from_rig` says.
"""

import argparse
import json
import sys
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.alignment_truth import Truth, error_rows, printed
from preface.align.aligned import median_keypoints, spread
from preface.align.alignment_files import read_index
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.landmarks import ViewLandmarks
from preface.align.person_file import Alignment, read_alignment
from preface.capture.rig import Rig
from preface.cli.align import main as preface_align
from preface.cli.align_inputs import rigs_of_takes
from preface.cli.usage import Parser

EYES = [CANONICAL_KEYPOINTS.index(name) for name in ("right_eye_outer", "left_eye_outer")]


@dataclass(frozen=True)
class Run:
    """An alignment of a studio with some rigs, as it lies on the disk."""

    name: str
    truth: Truth
    rigs: Path
    folder: Path

    def make(self, landmarks: Path | None, bias: str) -> None:
        """Run the command; found landmarks in the folder are used again."""
        arguments = ["studio", str(self.truth.studio / "capture"), "--rig", str(self.rigs)]
        arguments += ["--output", str(self.folder), "--landmark-bias", bias]
        if landmarks is not None:
            arguments += ["--landmarks", str(landmarks)]
        if preface_align(arguments) != 0:
            raise SystemExit(f"{self.name}: preface-align failed")

    @cached_property
    def rig_of(self) -> dict[str, Rig]:
        """Take to its rig."""
        takes = list(dict.fromkeys(self.truth.takes.values()))
        return {take: entry.rig for take, entry in rigs_of_takes([self.rigs], takes)[0].items()}

    @cached_property
    def alignments(self) -> dict[str, Alignment]:
        """Identity to its alignment."""
        entries = read_index(self.folder).aligned
        return {entry.identity: read_alignment(self.folder / entry.file) for entry in entries}

    @cached_property
    def keypoints(self) -> dict[str, np.ndarray]:
        """Identity to keypoints [5, 3] in the studio's frame, metres; NaN where missing."""
        frames = {take: self.truth.true_from_rig(take, rig) for take, rig in self.rig_of.items()}
        found = {}
        for identity, alignment in self.alignments.items():
            points = alignment.subject.keypoints.positions.copy()
            known = np.isfinite(points).all(axis=-1)
            points[known] = frames[self.truth.takes[identity]].apply(points[known])
            found[identity] = points
        return found


def main() -> None:
    """Align, compare, print."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studio", type=Path)
    parser.add_argument("--rigs", type=Path, help="calibrated rigs of the studio")
    parser.add_argument("--again", type=Path, help="the same studio in another exposure")
    parser.add_argument("--again-rigs", type=Path, help="its calibrated rigs")
    parser.add_argument("--work", type=Path, help="where alignments go (default: STUDIO/alignment_bench)")
    parser.add_argument("--landmark-bias", choices=("auto", "on", "off"), default="auto")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    work = arguments.work or arguments.studio / "alignment_bench"
    bias = arguments.landmark_bias
    first = _runs("first", arguments.studio, arguments.rigs, work, bias)
    again = _runs("again", arguments.again, arguments.again_rigs, work, bias) if arguments.again else []
    figures: dict[str, Any] = {run.name: _judged(run) for run in (*first, *again)}
    detector = _detector(first[0])
    print("\nlandmarks of all views against the truth, median, % of the eye distance")
    print(printed(detector))
    figures["landmarks of all views, %"] = detector
    others = {run.name.split("-")[1]: run for run in again}
    for run in first:
        other = others.get(run.name.split("-")[1])
        if other is not None:
            figures[f"{run.name} against {other.name}"] = _compared(run, other)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


def _runs(name: str, studio: Path, rigs: Path | None, work: Path, bias: str) -> list[Run]:
    truth = Truth(studio)
    runs = [Run(f"{name}-true", truth, studio / "truth" / "takes", work / f"{name}-true")]
    if rigs is not None:
        runs.append(Run(f"{name}-calibrated", truth, rigs, work / f"{name}-calibrated"))
    work.mkdir(parents=True, exist_ok=True)
    for index, run in enumerate(runs):
        run.make(runs[0].folder / "landmarks" if index else None, bias)
    return runs


def _judged(run: Run) -> dict[str, Any]:
    """Figures of one alignment against the truth."""
    index = read_index(run.folder)
    errors = np.array([run.keypoints[name] - run.truth.keypoints[name] for name in run.keypoints])
    views = np.array([len(alignment.subject.cameras) for alignment in run.alignments.values()])
    claimed, each = _errors_of_used_views(run)
    true = np.array([_worst(of_view) for of_view in each])
    rows = error_rows(errors)
    figures = {
        "people": len(run.alignments),
        "excluded": {entry.identity: entry.reason for entry in index.excluded},
        "views used, mean": float(views.mean()),
        "views used, least": int(views.min()),
        "used views": len(claimed),
        "used views that leave keypoints out": _leaving_out(run),
        "worst accepted keypoint against the other views, % of eye distance": float(np.nanmax(claimed)),
        "worst accepted keypoint against the truth, % of eye distance": float(np.nanmax(true)),
        "used views with an accepted keypoint more than 3 % off the truth": int((true > 3).sum()),
        "accepted keypoints": np.isfinite(each).sum(axis=0).tolist(),
        "of these, more than 3 % off the truth": (each > 3).sum(axis=0).tolist(),
        "accepted keypoints against the truth, median of the views' worst, %": float(np.nanmedian(true)),
        "spread before (five keypoints), mm": _spread(run, canonical=False),
        "spread after (five keypoints), mm": _spread(run, canonical=True),
    }
    print(f"\n{run.name} ({run.rigs})")
    for name, value in figures.items():
        print(f"  {name}: {value}")
    print("keypoint error, mm")
    print(printed(rows))
    return {**figures, "keypoint error, mm": rows}


def _detector(run: Run) -> list[dict[str, Any]]:
    """Landmarks of all views against the truth's projections, by camera: median, % of the eye distance.

    Also the views that were not used; how far the nose tip lies towards the image's left says which way it slides.
    """
    errors: dict[str, list[np.ndarray]] = {}
    for identity, alignment in run.alignments.items():
        for camera, landmarks in alignment.found.items():
            if isinstance(landmarks, ViewLandmarks):
                errors.setdefault(camera, []).append(_offsets(run, identity, camera, landmarks))
    rows = []
    for camera, of_camera in sorted(errors.items()):
        offsets = np.array(of_camera)
        forward = run.truth.rigs[next(iter(run.truth.rigs))].cameras[camera].camera_from_rig.rotation[2]
        row: dict[str, Any] = {
            "camera": camera,
            "views": len(of_camera),
            "azimuth": float(np.degrees(np.arctan2(-forward[0], -forward[2]))),
            "elevation": float(np.degrees(np.arcsin(-forward[1]))),
        }
        for index, name in enumerate(CANONICAL_KEYPOINTS):
            row[name] = float(np.nanmedian(np.linalg.norm(offsets[:, index], axis=-1)))
        nose = offsets[:, CANONICAL_KEYPOINTS.index("nose_tip")]
        row |= {"nose right": float(np.nanmedian(nose[:, 0])), "nose down": float(np.nanmedian(nose[:, 1]))}
        rows.append(row)
    return rows


def _offsets(run: Run, identity: str, camera: str, landmarks: ViewLandmarks) -> np.ndarray:
    """Landmarks minus projections of the true keypoints [5, 2], at their depths, % of the eye distance."""
    true, rig = run.truth.keypoints[identity], run.truth.rigs[run.truth.takes[identity]]
    standing = rig.cameras[camera]
    in_camera = standing.camera_from_rig.apply(true)
    pixels, _ = standing.camera.project(in_camera)
    metres = (landmarks.keypoints - pixels) * (in_camera[:, 2] / standing.camera.intrinsics[0])[:, None]
    return 100 * metres / float(np.linalg.norm(true[EYES[1]] - true[EYES[0]]))


def _leaving_out(run: Run) -> int:
    verdicts = [v for alignment in run.alignments.values() for v in alignment.subject.views.values()]
    return sum(verdict.used and bool(verdict.left_out) for verdict in verdicts)


def _errors_of_used_views(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the accepted keypoints of U used views, % of the eye distance.

    Returns:
        the worst of each view by what the other views say [U]; all by the truth [U, 5], NaN where left out.

    The truth's is the distance between landmark and projection of the true keypoint, at the keypoint's depth.
    """
    claimed, found = [], []
    for identity, alignment in run.alignments.items():
        for camera in alignment.subject.cameras:
            verdict, landmarks = alignment.subject.views[camera], alignment.found[camera]
            assert isinstance(landmarks, ViewLandmarks)
            accepted = np.array([name not in verdict.left_out for name in CANONICAL_KEYPOINTS])
            if verdict.correction is not None:
                pixels = landmarks.pixels.copy()
                for name, shift in zip(CANONICAL_KEYPOINTS, verdict.correction, strict=True):
                    pixels[list(landmarks.layout.keypoints[name])] += shift
                landmarks = replace(landmarks, pixels=pixels)
            offsets = np.linalg.norm(_offsets(run, identity, camera, landmarks), axis=-1)
            found.append(np.where(accepted, offsets, np.nan))
            claimed.append(_worst(100 * verdict.disagreement[accepted]))
    return np.array(claimed), np.array(found)


def _worst(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.max()) if known.size else float("nan")


def _spread(run: Run, canonical: bool) -> list[float]:
    """RMS distance of the five keypoints from their median, in the rigs' frames or in the canonical one."""
    points = []
    for alignment in run.alignments.values():
        found = alignment.subject.keypoints.positions.copy()
        known = np.isfinite(found).all(axis=-1)
        if canonical:
            found[known] = alignment.placement.canonical_from_rig.apply(found[known])
        points.append(found)
    deviations = spread(np.array(points), median_keypoints(np.array(points)))
    return [round(1e3 * float(value), 3) for value in deviations]


def _compared(first: Run, second: Run) -> dict[str, Any]:
    """How far two exposures agree."""
    both = [name for name in first.keypoints if name in second.keypoints]
    differences = np.array([first.keypoints[name] - second.keypoints[name] for name in both])
    rows = error_rows(differences)
    print(f"\n{first.name} against {second.name}: differences in mm, {len(both)} people")
    print(printed(rows))
    return {"people": len(both), "difference, mm": rows}


if __name__ == "__main__":
    main()
