"""First poses: the affine camera that most landmarks of a view agree on, and what is wrong with views without one.

An affine camera needs no focal length, has no local minima, and a face is shallow. The least median of squares
(Rousseeuw, 1984) over random subsets finds it with nearly half of the landmarks wrong.
"""

from dataclasses import dataclass

import numpy as np

from preface.align.keypoints import FACEMESH478

SUBSETS, SUBSET = 500, 7
MIN_LANDMARKS = 20
# A face smaller than this, in pixels, says nothing; nor does an affine fit with a median error over this share
# of the face's extent in the image: a wrong face is within a few per cent.
MIN_EXTENT = 12.0
MAX_MEDIAN_ERROR = 0.10
MAX_SQUASH = 0.3  # the two scales of an affine camera differ by less, or the image is no photograph of a face


class ViewProblemError(Exception):
    """Why a view cannot be used, as part of a sentence."""


@dataclass(frozen=True, eq=False)
class Affine:
    """rotation [3, 3] of camera from face, placement [3] (u, v, log_scale), median error (share of extent)."""

    rotation: np.ndarray
    placement: np.ndarray
    error: float

    @property
    def facing(self) -> float:
        """Cosine of the angle between the face's forward axis and the direction to the camera."""
        return -float(self.rotation[2, 2])


def first_pose(mean: np.ndarray, image: np.ndarray, longer_side: float) -> Affine:
    """Find the affine camera of one view.

    Args:
        mean: [N, 3] the expected face, metres.
        image: [N, 2] landmarks in longer sides about the image's centre, NaN where not seen.
        longer_side: of the image, in pixels.

    Raises:
        ViewProblemError: too few landmarks, too small a face, no face at all, or left and right swapped.
    """
    seen = np.isfinite(image).all(-1)
    if seen.sum() < MIN_LANDMARKS:
        raise ViewProblemError(
            f"only {seen.sum()} of {len(image)} landmarks are seen; {MIN_LANDMARKS} are needed"
        )
    extent = np.ptp(image[seen], axis=0).max() * longer_side
    if extent < MIN_EXTENT:
        raise ViewProblemError(f"the face spans {extent:.1f} pixels; {MIN_EXTENT:.0f} are needed")
    fit = _affine(mean, image, seen)
    mirror = FACEMESH478.mirror
    swapped = _affine(mean, image[mirror], seen[mirror])
    if fit.error > MAX_MEDIAN_ERROR and swapped.error > MAX_MEDIAN_ERROR:
        raise ViewProblemError(
            f"the landmarks form no face: half of them are off by more than {fit.error:.0%} of its size"
        )
    # Seen from behind the front of a face and its swapped labels look alike from afar.
    if (fit.facing < 0 < swapped.facing) or (2 * swapped.error < fit.error and swapped.facing > 0):
        raise ViewProblemError("left and right are swapped: the landmarks fit a face only when mirrored")
    if fit.facing < 0:
        raise ViewProblemError("the face is seen from behind")
    return fit


def _affine(mean: np.ndarray, image: np.ndarray, seen: np.ndarray) -> Affine:
    points = np.c_[mean, np.ones(len(mean))][seen]
    target = image[seen]
    extent = np.ptp(target, axis=0).max()
    order = np.random.default_rng(0).random((SUBSETS, len(points)))
    subsets = np.argpartition(order, SUBSET, axis=1)[:, :SUBSET]
    solutions = np.linalg.pinv(points[subsets], rcond=1e-6) @ target[subsets]  # [S, 4, 2]
    errors = np.linalg.norm(points @ solutions - target, axis=-1)
    best = solutions[np.argmin(np.median(errors, axis=1))]
    for _ in range(5):
        error = np.linalg.norm(points @ best - target, axis=-1)
        good = error <= 2.5 * 1.48 * np.median(error)
        best = np.linalg.lstsq(points[good], target[good], rcond=None)[0]
    median = float(np.median(np.linalg.norm(points @ best - target, axis=-1)) / extent)
    u, scales, vt = np.linalg.svd(best[:3].T, full_matrices=False)  # [2, 3]
    if not scales[1] > (1 - MAX_SQUASH) * scales[0] / 2:
        raise ViewProblemError("the landmarks form no face: they lie on a line or are squashed")
    rows = u @ vt
    rotation = np.stack([rows[0], rows[1], np.cross(rows[0], rows[1])])
    return Affine(rotation, np.array([*best[3], np.log(scales.mean())]), median)
