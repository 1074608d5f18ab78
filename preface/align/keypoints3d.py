"""The five canonical keypoints of a subject in 3D, each with its covariance, or the reason why it is missing.

A keypoint that is the mean of several landmarks is the mean of their 3D points: the mean of their projections is
not the projection of their mean. How much the mean gains depends on how far the landmarks err together. Detectors
regress all landmarks of an image at once and move neighbours as one, which in the model here is one correlation ρ
between the errors, in units of their standard deviations, of two landmarks in the same view (views are independent):

    Cov(X_i, X_j) = ρ C_i (Σ_v J_iv^T J_jv) C_j,    i ≠ j,

with J the whitened Jacobians of the views that both rest on, and C_i = (Σ_v J_iv^T J_iv)^-1 the landmark's own
covariance. ρ = 0 is the textbook's mean; ρ = 1 says that averaging gains nothing, which errs on the safe side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS, Scheme
from preface.align.options import AlignmentOptions
from preface.align.triangulation import Reason, Triangulation
from preface.geometry import Views, lens


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Five points in the order of `CANONICAL_KEYPOINTS`, in the rig frame.

    Attributes:
        positions: float64 [5, 3] metres; NaN where missing.
        covariance: float64 [5, 3, 3] square metres; NaN where missing.
        views: int [5], the number of views that each rests on (of its worst landmark).
        reasons: [5] why a keypoint is missing, as part of a sentence; empty where it is good.
    """

    positions: np.ndarray
    covariance: np.ndarray
    views: np.ndarray
    reasons: tuple[str, ...]

    @property
    def good(self) -> np.ndarray:
        """Which keypoints there are, bool [5]."""
        return np.isfinite(self.positions).all(-1)

    @property
    def eye_distance(self) -> float:
        """Metres between the outer eye corners; NaN when one is missing."""
        return float(eye_distance(self.positions))

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviation [5] in the worst direction, metres; NaN where missing."""
        return _worst_deviation(self.covariance)


def eye_distance(keypoints: np.ndarray) -> np.ndarray:
    """Distance [...] between the outer eye corners of keypoints [..., 5, 3]."""
    right, left = (CANONICAL_KEYPOINTS.index(name) for name in ("right_eye_outer", "left_eye_outer"))
    return np.linalg.norm(keypoints[..., right, :] - keypoints[..., left, :], axis=-1)


def out_of_face(keypoints: np.ndarray) -> np.ndarray:
    """Normal [3] of the plane of outer eye corners and chin of keypoints [5, 3], on the side of the face; no unit."""
    right, left, _, _, chin = keypoints
    return np.cross(left - right, (right + left) / 2 - chin)


def inside_out(keypoints: np.ndarray) -> bool:
    """Whether the nose of keypoints [5, 3] is behind that plane, as when left and right are exchanged.

    False where a keypoint that it takes is missing.
    """
    right, _, nose, _, _ = keypoints
    return bool((nose - right) @ out_of_face(keypoints) < 0)


def no_keypoints(reason: str) -> Keypoints:
    """Five missing keypoints."""
    count = len(CANONICAL_KEYPOINTS)
    return Keypoints(
        np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan), np.zeros(count, int), (reason,) * count
    )


def form_keypoints(
    scheme: Scheme,
    views: Views,
    landmarks: Triangulation,
    sigmas: np.ndarray,
    options: AlignmentOptions,
) -> Keypoints:
    """Average landmarks to keypoints.

    Args:
        scheme: says which landmarks make which keypoint.
        views: the V cameras that the landmarks were triangulated from.
        landmarks: of N points; its covariance belongs to `sigmas`.
        sigmas: [N, V], the standard deviations of the landmarks, pixels.
        options: the correlation, and the largest deviation of a good keypoint.
    """
    positions, covariances, counts, reasons = [], [], [], []
    for name in CANONICAL_KEYPOINTS:
        members = list(scheme.keypoints[name])
        inliers = landmarks.inliers[members]
        positions.append(landmarks.points[members].mean(0))
        own = landmarks.covariance[members]
        covariances.append(
            _covariance_of_mean(views, landmarks.points[members], own, inliers, sigmas[members], options)
        )
        counts.append(int(inliers.sum(-1).min()))
        missing = [index for index in members if landmarks.reason[index] != Reason.OK]
        reasons.append(
            f"landmark {missing[0]}: {Reason(landmarks.reason[missing[0]]).words}" if missing else ""
        )
    found = Keypoints(np.array(positions), np.array(covariances), np.array(counts), tuple(reasons))
    return _without_vague_ones(found, options.keypoint_deviation)


def _covariance_of_mean(
    views: Views,
    points: np.ndarray,
    own: np.ndarray,
    inliers: np.ndarray,
    sigmas: np.ndarray,
    options: AlignmentOptions,
) -> np.ndarray:
    """Covariance [3, 3] of the mean of points [M, 3], by the model in the header."""
    count = len(points)
    total = own.sum(0)
    if count > 1:
        jacobians = np.where(inliers[..., None, None], _jacobians(views, points), 0.0)
        gain = own[:, None] @ np.swapaxes(jacobians / sigmas[..., None, None], -1, -2)  # [M, V, 3, 2]
        together = gain.sum(0)
        crossed = np.einsum("vab,vcb->ac", together, together) - np.einsum("mvab,mvcb->ac", gain, gain)
        total = total + options.landmark_correlation * crossed
    return total / count**2


def _jacobians(views: Views, points: np.ndarray) -> np.ndarray:
    """d_pixels/d_point [M, V, 2, 3] of points [M, 3] of the world."""
    rotation = np.swapaxes(views.world_from_camera[:, :, :3], -1, -2)
    in_camera = np.einsum("vab,mvb->mva", rotation, points[:, None] - views.world_from_camera[:, :, 3])
    by_point, _ = lens.projection_jacobians(views.intrinsics, views.monotonic_radius, in_camera)
    return by_point @ rotation


def _without_vague_ones(keypoints: Keypoints, share: float) -> Keypoints:
    """Drop keypoints that are known too badly, in shares of the distance between the outer eye corners.

    Where an eye corner is missing, the largest distance between two keypoints stands in: no smaller.
    """
    scale = keypoints.eye_distance
    if not np.isfinite(scale):
        good = keypoints.positions[keypoints.good]
        scale = np.linalg.norm(good[:, None] - good, axis=-1).max(initial=0.0)
    deviations = keypoints.deviations
    vague = deviations > share * scale
    reasons = tuple(
        f"its standard deviation of {1000 * deviation:.3g} mm is more than {100 * share:g}% of the distance between "
        "the outer eye corners"
        if is_vague
        else reason
        for reason, deviation, is_vague in zip(keypoints.reasons, deviations, vague, strict=True)
    )
    return Keypoints(
        np.where(vague[:, None], np.nan, keypoints.positions),
        np.where(vague[:, None, None], np.nan, keypoints.covariance),
        keypoints.views,
        reasons,
    )


def _worst_deviation(covariance: np.ndarray) -> np.ndarray:
    known = np.isfinite(covariance).all((-1, -2))
    largest = np.linalg.eigvalsh(np.where(known[..., None, None], covariance, 0.0))[..., -1]
    return np.where(known, np.sqrt(np.maximum(largest, 0.0)), np.nan)
