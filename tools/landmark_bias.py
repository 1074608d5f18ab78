"""Measure where FaceMesh puts landmarks wrong by the direction of the view, and write `preface.align`'s correction.

STUDIO is made by `tools/synthetic_studio`; LANDMARKS is the folder `landmarks` of an alignment of it, as
`preface-align studio STUDIO/capture --rig STUDIO/truth/takes --output ALIGNMENT` leaves it. Each landmark of each view
is compared with the true point of the surface at that point's depth, in the frame of the person's face; people and
their mirror images count alike. What is printed is held out: people in turn, and cameras in turn, which is harder, as
each camera stands alone in its direction.

    python tools/landmark_bias.py STUDIO --landmarks ALIGNMENT/landmarks [--people 48] [--output FILE]
"""

import argparse
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from bench.alignment_truth import Truth, printed
from preface.align.keypoints import CANONICAL_KEYPOINTS, FACEMESH478
from preface.align.landmark_bias import (
    FILE,
    LandmarkBias,
    axes_across,
    monomials,
    squares,
)
from preface.align.landmark_files import read_landmark_folder
from preface.align.landmarks import ViewLandmarks
from preface.align.photos.face import face_prior, keypoint_weights
from preface.artifacts import load_json
from preface.capture.rig import RigCamera
from preface.cli.usage import Parser
from preface.geometry import fit_similarity

OUTPUT = Path(__file__).parents[1] / "preface" / "align" / FILE
NAME = f"facemesh-mediapipe-{version('mediapipe')}"
FOLDS = 8
GROSS = 0.25  # eye distances: a detection that is no face at all (profiles) teaches nothing
ROBUST = 1.5  # medians beyond which an error counts less (Huber), and four of them at most in the variance
REWEIGHTINGS = 10
IRISES = {468: range(469, 473), 473: range(474, 478)}  # the rim errs as the centre does


@dataclass(frozen=True, eq=False)
class Samples:
    """S views: identity and camera of each, directions [S, 3] in the face's frame, offsets [S, N, 2]."""

    identities: np.ndarray
    cameras: np.ndarray
    directions: np.ndarray
    offsets: np.ndarray

    def where(self, chosen: np.ndarray) -> "Samples":
        """Some of them."""
        return Samples(
            self.identities[chosen], self.cameras[chosen], self.directions[chosen], self.offsets[chosen]
        )

    def with_mirrored(self) -> "Samples":
        """These and the mirrored ones: x changes its sign, left and right their places."""
        twins = self.offsets[:, FACEMESH478.mirror] * (-1.0, 1.0)
        return Samples(
            np.tile(self.identities, 2),
            np.tile(self.cameras, 2),
            np.concatenate([self.directions, self.directions * (-1.0, 1.0, 1.0)]),
            np.concatenate([self.offsets, twins]),
        )


def main() -> None:
    """Gather, hold out, fit, write."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studio", type=Path)
    parser.add_argument("--landmarks", type=Path, required=True)
    parser.add_argument("--people", type=int, help="only the first so many (default: all)")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    samples = gather(Truth(arguments.studio), arguments.landmarks, arguments.people)
    people = np.unique(samples.identities)
    folds = np.array([np.searchsorted(people, name) % FOLDS for name in samples.identities])
    print(f"{len(samples.identities)} views of {len(people)} people; errors in % of the eye distance")
    print(printed([_row("as found", samples.offsets), _row("held-out people", _held_out(samples, folds))]))
    print(printed([_row("held-out cameras", _held_out(samples, samples.cameras))]))
    bias = fit(samples)
    left = samples.offsets - bias.across(samples.directions)
    print(printed([_row("not held out", left)]))
    np.savez_compressed(
        arguments.output,
        name=np.array(bias.name),
        points=bias.points.astype(np.float32),
        coefficients=bias.coefficients.astype(np.float32),
        variances=bias.variances.astype(np.float32),
        reach=bias.reach.astype(np.float32),
    )
    print(arguments.output)


def gather(truth: Truth, folder: Path, people: int | None) -> Samples:
    """Offsets of all landmarks that were found, of the first so many people."""
    identities = list(truth.takes)[:people]
    sizes = {
        (name, camera): (standing.camera.width, standing.camera.height)
        for name in identities
        for camera, standing in truth.rigs[truth.takes[name]].cameras.items()
    }
    found = read_landmark_folder(folder, sizes)
    rows = []
    for (name, camera), view in found.items():
        if not isinstance(view, ViewLandmarks):
            continue
        points = _surface(truth, name)
        direction, offsets = _compare(points, truth.rigs[truth.takes[name]].cameras[camera], view)
        if np.nanmedian(np.linalg.norm(offsets, axis=-1)) < GROSS:
            rows.append((name, camera, direction, offsets))
    names, cameras, directions, offsets = zip(*rows, strict=True)
    return Samples(np.array(names), np.array(cameras), np.array(directions), np.array(offsets))


def _surface(truth: Truth, identity: str) -> np.ndarray:
    """True points [478, 3], studio frame; NaN for the rims of the irises."""
    head = load_json(truth.studio / "truth" / "identities" / identity / "head.json")
    points = np.full((FACEMESH478.size, 3), np.nan)
    for index, place in head["landmarks"].items():
        points[int(index)] = place
    return points


def _compare(points: np.ndarray, standing: RigCamera, view: ViewLandmarks) -> tuple[np.ndarray, np.ndarray]:
    """Direction [3] to the camera and offsets [478, 2] along e1 and e2, face's frame, eye distances."""
    weights = keypoint_weights()
    keypoints = np.stack([points[row > 0].mean(0) for row in weights])
    fit = fit_similarity(keypoints, keypoint_weights() @ _average_face()).target_from_source
    direction = fit.apply(standing.camera_from_rig.inverse.translation)
    direction /= np.linalg.norm(direction)
    known = np.isfinite(points).all(-1) & view.seen
    in_camera = standing.camera_from_rig.apply(points[known])
    image, _ = standing.camera.unproject(view.pixels[known])
    marked = np.c_[image, np.ones(len(image))] * in_camera[:, 2:]
    in_rig = (marked - in_camera) @ standing.camera_from_rig.rotation
    offsets = np.full((len(points), 2), np.nan)
    offsets[known] = fit.scale * in_rig @ fit.rotation.T @ axes_across(direction).T
    for centre, rim in IRISES.items():
        offsets[list(rim)] = offsets[centre]
    return direction, offsets


def fit(samples: Samples) -> LandmarkBias:
    """The polynomials and variances of all landmarks."""
    both = samples.with_mirrored()
    basis, growth = monomials(both.directions), squares(both.directions)
    coefficients, variances = [], []
    for landmark in range(both.offsets.shape[1]):
        offsets = both.offsets[:, landmark]
        known = np.isfinite(offsets).all(-1)
        weights = np.ones(known.sum())
        for _ in range(REWEIGHTINGS):
            root = np.sqrt(weights)[:, None]
            solved = np.linalg.lstsq(basis[known] * root, offsets[known] * root, rcond=None)[0]
            errors = np.linalg.norm(offsets[known] - basis[known] @ solved, axis=-1)
            usual = np.median(errors)
            weights = 1 / np.maximum(errors / (ROBUST * usual), 1.0)
        coefficients.append(solved.T)
        variances.append(nnls(growth[known], np.minimum(errors, 4 * usual) ** 2 / 2)[0])
    x, y = np.abs(both.directions[:, :2]).T
    reach = np.array([x.max(), y.max()])
    reach *= np.linalg.norm(both.directions[:, :2] / reach, axis=-1).max()
    return LandmarkBias(
        NAME, FACEMESH478.name, _average_face(), np.array(coefficients), np.array(variances), reach
    )


@cache
def _average_face() -> np.ndarray:
    """Points [478, 3] of the expected face of `preface.align.photos`, eye distances."""
    mean = face_prior().mean
    right, left = (keypoint_weights() @ mean)[:2]
    return mean / np.linalg.norm(left - right)


def _held_out(samples: Samples, group: np.ndarray) -> np.ndarray:
    """Offsets [S, N, 2] that are left when each group is corrected by what the others teach."""
    left = np.empty_like(samples.offsets)
    for name in np.unique(group):
        out = group == name
        left[out] = samples.offsets[out] - fit(samples.where(~out)).across(samples.directions[out])
    return left


def _row(name: str, offsets: np.ndarray) -> dict[str, Any]:
    """Median length per keypoint, and over all landmarks; share of views with one beyond 3%."""
    weights = keypoint_weights()
    five = np.stack([offsets[:, row > 0].mean(1) for row in weights], axis=1)
    lengths = 100 * np.linalg.norm(five, axis=-1)
    row: dict[str, Any] = {"": name} | dict(
        zip(CANONICAL_KEYPOINTS, np.median(lengths, axis=0).tolist(), strict=True)
    )
    row["all five"] = float(np.median(lengths))
    row["all landmarks"] = float(np.nanmedian(100 * np.linalg.norm(offsets, axis=-1)))
    return row | {"keypoints over 3%": float((lengths > 3).mean())}


if __name__ == "__main__":
    main()
