"""Epipolar errors of a calibrated rig: two images of a point must agree without asking where it is in space."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from preface.capture.calibration import Calibration
from preface.geometry.transforms import Rigid


@dataclass(frozen=True)
class PairError:
    """Distances, in pixels, of corners from their epipolar lines, over both images of a pair of cameras."""

    first: str
    second: str
    rms: float
    median: float
    count: int


def epipolar_errors(calibration: Calibration) -> list[PairError]:
    """The error of every pair of cameras that share corners which the solver used."""
    seen = calibration.observations
    normalised = np.full((len(seen), 2), np.nan)
    for index, camera in enumerate(calibration.cameras):
        mine = calibration.inliers & (seen.camera == index)
        found, valid = camera.unproject(seen.pixels[mine])
        normalised[mine] = np.where(valid[:, None], found, np.nan)
    usable = np.isfinite(normalised).all(axis=1)
    key = seen.frame.astype(np.int64) * len(seen.board_points) + seen.point
    poses = calibration.camera_from_rig
    errors = []
    for first, second in combinations(range(len(calibration.cameras)), 2):
        of_first, of_second = (np.flatnonzero(usable & (seen.camera == index)) for index in (first, second))
        _, at_first, at_second = np.intersect1d(key[of_first], key[of_second], return_indices=True)
        if not len(at_first):
            continue
        pose, other = (Rigid(poses.rotation[i], poses.translation[i]) for i in (first, second))
        distances = _distances(
            other @ pose.inverse,
            normalised[of_first[at_first]],
            normalised[of_second[at_second]],
            float(calibration.cameras[first].intrinsics[:2].mean()),
            float(calibration.cameras[second].intrinsics[:2].mean()),
        )
        names = seen.camera_ids[first], seen.camera_ids[second]
        rms = float(np.sqrt((distances**2).mean()))
        errors.append(PairError(*names, rms, float(np.median(distances)), len(at_first)))
    return errors


def _distances(
    second_from_first: Rigid, first: np.ndarray, second: np.ndarray, first_focal: float, second_focal: float
) -> np.ndarray:
    """Distances [2 N] to epipolar lines in the undistorted images, pixels; points [N, 2] are at depth 1.

    Hartley and Zisserman, "Multiple View Geometry", equation 9.11: E = [t]x R.
    """
    x, y, z = second_from_first.translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ second_from_first.rotation
    a, b = (np.concatenate([points, np.ones((len(points), 1))], axis=1) for points in (first, second))
    in_second, in_first = a @ essential.T, b @ essential
    algebraic = np.abs((b * in_second).sum(axis=1))
    return np.concatenate(
        [
            first_focal * algebraic / np.linalg.norm(in_first[:, :2], axis=1),
            second_focal * algebraic / np.linalg.norm(in_second[:, :2], axis=1),
        ]
    )
