"""The optimal similarity between corresponding points, with the checks that degenerate points need.

Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 13(4),
1991; its equation numbers are cited as (n). Weights replace its 1/n.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from preface.geometry.arrays import rotate
from preface.geometry.errors import GeometryError
from preface.geometry.transforms import Similarity

# Points are collinear when their second principal extent is below this fraction of the first.
RANK_TOLERANCE = 1e-6
# A reflection is reported when its RMS residual is below this fraction of the rotation's.
MIRROR_RATIO = 0.5
# Three-point subsets that the robust fit starts from: all of them up to 16 points. With half of the points
# wrong, none of 600 random subsets is right with a chance below 1e-34; with 80% wrong, of 1%.
MAX_SUBSETS = 600
# Refits of each subset to the points within the threshold; most settle in two or three.
REFITS = 10


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A similarity and how well the points obey it.

    Attributes:
        target_from_source: the similarity; its rotation always has determinant +1.
        residuals: [n], distances |target - similarity(source)|, units of the target; also of outliers.
        weights: [n], of the final least-squares fit; 0 for outliers.
        mirrored_residuals: [n], distances that the best reflection of all points would leave.
        hint: what to check when the reflection is much better than the rotation; empty otherwise.
    """

    target_from_source: Similarity
    residuals: np.ndarray
    weights: np.ndarray
    mirrored_residuals: np.ndarray
    hint: str

    @property
    def mirrored(self) -> bool:
        """Whether left and right, or the handedness of a frame, seem to be swapped."""
        return bool(self.hint)

    @property
    def inliers(self) -> np.ndarray:
        """Points [n] that took part in the fit."""
        return self.weights > 0

    @property
    def rms(self) -> float:
        """Weighted root mean square of the residuals, units of the target."""
        return _rms(self.residuals, self.weights)


def fit_similarity(
    source: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray | None = None,
    fixed_scale: float | None = None,
) -> SimilarityFit:
    """Minimise sum_i w_i |target_i - (scale R source_i + t)|².

    Exactly coplanar points are accepted: with (43) they determine the rotation.

    Args:
        source, target: [n, 3], corresponding points, at any distance from the origin.
        weights: [n], not negative, 1 by default. Points of weight 0 are left out, and may be NaN.
        fixed_scale: the scale where it is known, as 1 is between metric frames.

    Raises:
        GeometryError: fewer than three points, or not finite, coincident, collinear or unrelated ones.
    """
    source, target, weights, missing = _checked(source, target, weights, fixed_scale)
    _require_rank(source, target, weights)
    proper = _least_squares(source, target, weights, fixed_scale, handedness=1)
    mirrored = _least_squares(source, target, weights, fixed_scale, handedness=-1)
    return SimilarityFit(
        target_from_source=Similarity(proper.scale, proper.rotation, proper.translation),
        residuals=np.where(missing, np.nan, proper.residuals),
        weights=weights,
        mirrored_residuals=np.where(missing, np.nan, mirrored.residuals),
        hint=_mirror_hint(
            _rms(proper.residuals, weights), _rms(mirrored.residuals, weights), target[weights > 0]
        ),
    )


def fit_similarity_robust(
    source: np.ndarray,
    target: np.ndarray,
    threshold: float,
    weights: np.ndarray | None = None,
    fixed_scale: float | None = None,
) -> SimilarityFit:
    """Fit the similarity that the most points agree on, then refit to those.

    Every subset of three points (random ones, always the same, beyond `MAX_SUBSETS`) is fitted and refitted
    to the points that it explains; the one of least truncated cost sum_i w_i min(r_i, threshold)² wins
    (MSAC, Torr and Zisserman 2000). It finds the truth as long as no wrong subset is more consistent.

    Args:
        source, target, weights, fixed_scale: as for `fit_similarity`.
        threshold: the largest residual of a good point, units of the target; some three standard
            deviations of the points' noise.

    Raises:
        GeometryError: as `fit_similarity`, or no three points agree within the threshold.
    """
    if not threshold > 0:
        raise GeometryError(f"threshold: {threshold} is not a positive distance in units of the target")
    everything = fit_similarity(source, target, weights, fixed_scale)
    clean_source, clean_target, base, _ = _checked(source, target, weights, fixed_scale)
    support = _consensus(clean_source, clean_target, base, threshold, fixed_scale)
    if np.count_nonzero(support) < 3:
        raise GeometryError(
            f"threshold: no three points agree within {threshold:g}; the residuals of the fit to all are "
            f"{np.array2string(everything.residuals, precision=3)}. Check the units and the order of the "
            "points, and that the threshold suits their noise"
        )
    robust = fit_similarity(source, target, support, fixed_scale)
    return replace(robust, mirrored_residuals=everything.mirrored_residuals, hint=everything.hint)


class _Solution(NamedTuple):
    """Fits to n points: scale [...], rotation [..., 3, 3], translation [..., 3], residuals [..., n]."""

    scale: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    residuals: np.ndarray


def _least_squares(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray, fixed_scale: float | None, handedness: int
) -> _Solution:
    """Solve for each row of weights [..., n], with a rotation (handedness 1) or a reflection (-1).

    Residuals are taken about the means, so that distant origins cost no digits.
    """
    share = weights / weights.sum(-1, keepdims=True)
    source_mean, target_mean = share @ source, share @ target  # (34), (35)
    s, t = source - source_mean[..., None, :], target - target_mean[..., None, :]
    variance = (share * (s**2).sum(-1)).sum(-1)  # (36)
    u, d, vt = np.linalg.svd(np.swapaxes(share[..., None] * t, -1, -2) @ s)  # (38)
    signs = np.ones_like(d)
    signs[..., 2] = handedness * np.sign(np.linalg.det(u) * np.linalg.det(vt))  # (39), (43)
    rotation = (u * signs[..., None, :]) @ vt  # (40)
    if fixed_scale is None:
        scale = (d * signs).sum(-1) / np.where(variance > 0, variance, np.inf)  # (42)
    else:
        scale = np.full_like(variance, fixed_scale)
    turned = scale[..., None, None] * rotate(rotation[..., None, :, :], s)
    translation = target_mean - scale[..., None] * rotate(rotation, source_mean)  # (41)
    return _Solution(scale, rotation, translation, np.linalg.norm(t - turned, axis=-1))


def _consensus(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray, threshold: float, fixed_scale: float | None
) -> np.ndarray:
    """Return the weights [n] with those points set to 0 that the best hypothesis does not explain."""
    usable = np.flatnonzero(weights)
    if comb(len(usable), 3) <= MAX_SUBSETS:
        subsets = np.array(list(combinations(usable, 3)))
    else:
        order = np.random.default_rng(0).random((MAX_SUBSETS, len(usable)))
        subsets = usable[np.argsort(order, axis=-1)[:, :3]]
    support: np.ndarray = np.zeros((len(subsets), len(weights)))
    np.put_along_axis(support, subsets, weights[subsets], axis=-1)
    for _ in range(REFITS):
        residuals = _least_squares(source, target, support, fixed_scale, handedness=1).residuals
        explained = np.where(residuals <= threshold, weights, 0.0)
        enough = np.count_nonzero(explained, axis=-1, keepdims=True) >= 3
        support = np.where(enough, explained, support)
    residuals = _least_squares(source, target, support, fixed_scale, handedness=1).residuals
    cost = (weights * np.minimum(residuals, threshold) ** 2).sum(-1)
    best = int(np.argmin(cost))
    return np.where(residuals[best] <= threshold, weights, 0.0)


def _checked(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None, fixed_scale: float | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return points and weights as float64, and which points are missing [n]: NaN, here replaced by 0."""
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if source.ndim != 2 or source.shape[-1] != 3 or source.shape != target.shape:
        raise GeometryError(f"source, target: shapes {source.shape} and {target.shape} are not both (n, 3)")
    weights = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
    if weights.shape != source.shape[:1] or not np.isfinite(weights).all() or (weights < 0).any():
        raise GeometryError(f"weights: {weights.tolist()} are not {len(source)} finite numbers >= 0")
    if fixed_scale is not None and not (np.isfinite(fixed_scale) and fixed_scale > 0):
        raise GeometryError(f"fixed_scale: {fixed_scale} is not a positive number")
    missing = ~np.isfinite(source).all(-1) | ~np.isfinite(target).all(-1)
    if (missing & (weights > 0)).any():
        name, points = (
            ("source", source) if not np.isfinite(source[weights > 0]).all() else ("target", target)
        )
        index = int(np.flatnonzero(~np.isfinite(points).all(-1) & (weights > 0))[0])
        raise GeometryError(f"{name}[{index}]: {points[index].tolist()} is not finite; give it the weight 0")
    if np.count_nonzero(weights) < 3:
        raise GeometryError(
            f"source: {np.count_nonzero(weights)} points of positive weight; a similarity takes three or more"
        )
    drop = missing[:, None]
    return np.where(drop, 0.0, source), np.where(drop, 0.0, target), weights, missing


def _require_rank(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> None:
    """Raise GeometryError unless the points determine a rotation."""
    share = weights / weights.sum()
    centred, extents = [], []
    for name, points in (("source", source), ("target", target)):
        centred.append(np.sqrt(share)[:, None] * (points - share @ points))
        extent = np.linalg.svd(centred[-1], compute_uv=False)
        extents.append(extent)
        rounding = 8 * np.finfo(np.float64).eps * np.abs(points).max()
        if extent[0] <= rounding:
            raise GeometryError(f"{name}: all points coincide; a similarity takes three that form a triangle")
        if extent[1] <= max(RANK_TOLERANCE * extent[0], rounding):
            raise GeometryError(
                f"{name}: the points are collinear (extents {extent[0]:.3g} and {extent[1]:.3g}), which "
                "leaves the turn about their line open; add a point off the line"
            )
    shared = np.linalg.svd(centred[1].T @ centred[0], compute_uv=False)
    if shared[1] <= RANK_TOLERANCE * extents[0][1] * extents[1][1]:
        raise GeometryError(
            "source, target: the points do not correspond (no correlation); check their order"
        )


def _mirror_hint(proper_rms: float, mirrored_rms: float, target: np.ndarray) -> str:
    """Say that a reflection fits much better, if it does by more than rounding."""
    extent = np.ptp(target, axis=0).max()
    if mirrored_rms >= MIRROR_RATIO * proper_rms or proper_rms <= RANK_TOLERANCE * extent:
        return ""
    return (
        f"a reflection would fit with an RMS residual of {mirrored_rms:.3g} where the rotation leaves "
        f"{proper_rms:.3g}: are left and right swapped in one of the two sets of points?"
    )


def _rms(residuals: np.ndarray, weights: np.ndarray) -> float:
    """Weighted root mean square over the points of positive weight."""
    used = weights > 0
    return float(np.sqrt(np.average(residuals[used] ** 2, weights=weights[used])))
