"""Which keypoints of which views agree on one face: the geometry and the search behind `view_check`.

Every two views propose where the keypoints are, and the proposal that most views agree with wins; then each keypoint
of a view is held against what the other views say of it. Disagreement is measured at the keypoint's depth, as a share
of the distance between the outer eye corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS, Scheme
from preface.align.keypoints3d import eye_distance
from preface.align.options import TriangulationOptions
from preface.align.triangulation import Triangulation, triangulate
from preface.geometry import Views, lens

COUNT = len(CANONICAL_KEYPOINTS)
EYES = [CANONICAL_KEYPOINTS.index(name) for name in ("right_eye_outer", "left_eye_outer")]
LEAST = 3  # keypoints that a view must show, and agree in
SLACK = 2.0  # factor on the tolerance for what two views alone propose: their depth is noisier than a pixel
MAX_PROPOSALS = 300  # pairs of views; beyond 25 views, random ones
# How a view may have been turned about: as it is, a mirrored image, left and right landmarks exchanged.
AS_IS, MIRRORED, SWAPPED = range(3)


class Measured(NamedTuple):
    """Keypoints of V views.

    Attributes:
        views: their cameras.
        pixels: [V, 5, 2].
        image: [V, 3, 5, 2], undistorted to depth 1: as they are, unmirrored and with left and right exchanged.
        deviations: [V, 5], what each is worth: standard deviation of a coordinate, in eye distances.
    """

    views: Views
    pixels: np.ndarray
    image: np.ndarray
    deviations: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Which keypoints are seen [V, 5]."""
        return np.isfinite(self.image[:, AS_IS]).all(-1)


def measure(
    scheme: Scheme,
    views: Views,
    widths: Sequence[int],
    landmarks: np.ndarray,
    shifts: np.ndarray,
    deviations: np.ndarray,
) -> Measured:
    """Gather the keypoints of landmarks [V, N, 2] in images of these widths.

    Args:
        scheme, views, widths, landmarks: as said.
        shifts: [V, 5, 2] pixels that are added to the keypoints, whichever variant of the view is right.
        deviations: [V, 5], see `Measured`.
    """
    as_is = scheme.keypoint_pixels(landmarks)
    swapped = scheme.keypoint_pixels(landmarks[:, scheme.mirror])
    mirrored = swapped * (-1, 1) + np.stack([np.asarray(widths, float), np.zeros(len(widths))], -1)[:, None]
    pixels = np.stack([as_is, mirrored, swapped], 1) + shifts[:, None]
    image, _, _ = lens.unproject(
        views.intrinsics[:, None, None], views.monotonic_radius[:, None, None], pixels
    )
    return Measured(views, pixels[:, AS_IS], image, deviations)


# ---------------------------------------------------------------------------------- geometry


def points_from(measured: Measured, masks: np.ndarray, options: TriangulationOptions) -> np.ndarray:
    """Keypoints [H, 5, 3] from the views in each of the masks [H, 5, V]; NaN where there is none."""
    return triangulated_from(measured, masks, options).points


def triangulated_from(measured: Measured, masks: np.ndarray, options: TriangulationOptions) -> Triangulation:
    """Keypoints [H, 5] from all views in each of the masks [H, 5, V], none of them rejected."""
    loose = TriangulationOptions(
        outlier_threshold=1e9, minimum_angle_degrees=options.minimum_angle_degrees, minimum_share=0.0
    )
    pixels = np.where(masks[..., None], np.swapaxes(measured.pixels, 0, 1), np.nan)
    sigmas = measured.deviations.T * measured.views.intrinsics[:, 0]
    return triangulate(measured.views, pixels, sigmas, loose)


def errors_of(measured: Measured, points: np.ndarray) -> np.ndarray:
    """Disagreement [..., V, 3, 5] of all views, in their three variants, with keypoints [..., 5, 3].

    NaN where a keypoint is not seen or not proposed; infinite where it lies behind the view.
    """
    poses = measured.views.world_from_camera
    relative = points[..., None, :, :] - poses[:, None, :, 3]  # [..., V, 5, 3]
    in_camera = np.einsum("vba,...vkb->...vka", poses[:, :, :3], relative)
    depth = in_camera[..., 2]
    with np.errstate(all="ignore"):  # behind the camera, and NaN
        image = in_camera[..., :2] / depth[..., None]
        distance = np.linalg.norm(measured.image - image[..., None, :, :], axis=-1) * depth[..., None, :]
        share = distance / eye_distance(points)[..., None, None, None]
    behind = (depth <= 0)[..., None, :] & np.isfinite(measured.image).all(-1)
    return np.where(behind, np.inf, share)


def scores_of(errors: np.ndarray, tolerance: float) -> np.ndarray:
    """How many of errors [..., 5] are within the tolerance; 0 where they are fewer than three, or an eye is not."""
    within = errors <= tolerance
    count = within.sum(-1)
    eyes = errors[..., EYES]
    seen = ~np.isnan(eyes)
    return np.where((count >= LEAST) & seen.any(-1) & (within[..., EYES] | ~seen).all(-1), count, 0)


# --------------------------------------------------------------------------------- consensus


class Choice(NamedTuple):
    """The keypoints [V, 5] of the views that a proposal stands on; whether an equally good one contradicts it."""

    kept: np.ndarray
    ambiguous: bool


def choose(
    measured: Measured, judged: np.ndarray, tolerance: float, options: TriangulationOptions
) -> Choice | None:
    """Find the proposal that most views agree with; None if not even two do."""
    pairs = np.array(list(combinations(judged, 2)))
    if len(pairs) > MAX_PROPOSALS:
        pairs = np.random.default_rng(0).permutation(pairs)[:MAX_PROPOSALS]
    views = np.zeros((len(pairs), len(measured.pixels)), dtype=bool)
    np.put_along_axis(views, pairs, True, axis=1)
    masks = np.repeat(views[:, None], COUNT, axis=1)
    for factor in (SLACK, SLACK, 1.0):
        errors = errors_of(measured, points_from(measured, masks, options))  # [H, V, 3, 5]
        within = _within(errors[..., AS_IS, :], factor * tolerance)
        masks = np.where(within.sum(-1, keepdims=True) >= 2, within, masks)
    errors = errors_of(measured, points_from(measured, masks, options))
    score = scores_of(errors, SLACK * tolerance)  # [H, V, 3]
    agreeing = score[..., AS_IS] > 0
    named = ~agreeing & (scores_of(errors[..., 1:, :], tolerance) > LEAST).any(-1)
    as_is = np.where(agreeing.sum(1) >= 2, agreeing.sum(1), 0)
    support = np.where(as_is > 0, as_is + named.sum(1), 0)
    strict = scores_of(errors[..., AS_IS, :], tolerance).sum(1)
    best = int(np.lexsort((-strict, -as_is, -support))[0])
    if support[best] < 2:
        return None
    equal = (support == support[best]) & (as_is == as_is[best]) & ((agreeing & agreeing[best]).sum(1) < 2)
    kept = _per_keypoint(measured, np.flatnonzero(agreeing[best]), tolerance, options)
    return Choice(kept, bool(equal.any()))


def _per_keypoint(
    measured: Measured, views: np.ndarray, tolerance: float, options: TriangulationOptions
) -> np.ndarray:
    """For each keypoint the views [V, 5], of these, that agree with what most of them say of it."""
    pairs = np.array(list(combinations(views, 2)))
    masks = np.zeros((len(pairs), COUNT, len(measured.pixels)), dtype=bool)
    for pair, mask in zip(pairs, masks, strict=True):
        mask[:, pair] = True
    allowed = np.isin(np.arange(len(measured.pixels)), views)[:, None]
    errors = errors_of(measured, points_from(measured, masks, options))[..., AS_IS, :]  # [H, V, 5]
    cost = np.where(
        allowed & ~np.isnan(errors), np.minimum(errors, SLACK * tolerance), SLACK * tolerance
    ).sum(1)
    best = cost.argmin(0)
    chosen = errors[best, :, np.arange(COUNT)].T
    kept = allowed & (chosen <= SLACK * tolerance)
    again = errors_of(measured, points_from(measured, kept.T[None], options))[0, :, AS_IS]
    return allowed & (again <= SLACK * tolerance)


def _within(errors: np.ndarray, tolerance: float) -> np.ndarray:
    """The keypoints [..., 5, V] within the tolerance, of errors [..., V, 5], in views that agree."""
    agreeing = scores_of(errors, tolerance) > 0
    return np.swapaxes((errors <= tolerance) & agreeing[..., None], -1, -2)


def settle(
    measured: Measured,
    kept: np.ndarray,
    judged: np.ndarray,
    tolerance: float,
    options: TriangulationOptions,
) -> np.ndarray:
    """Drop the worst view of each keypoint until all agree, and take back those that agree with what is left.

    Args:
        measured, tolerance, options: see `judge_views`.
        kept: [V, 5], from which keypoints of which views to start.
        judged: the views that may take part.

    Returns:
        the keypoints [V, 5] of views of which enough is left; of a keypoint that too few views agree on, none.
    """
    candidates = np.zeros_like(kept)
    candidates[judged] = measured.seen[judged]
    kept = _without_worst(measured, kept & candidates, tolerance, options)
    for view in judged:
        joined = kept.copy()
        joined[view] |= candidates[view]
        errors = disagreement_of(measured, joined, options)
        agreeing = (np.where(joined, errors, 0.0) <= tolerance).all(0) & (kept.sum(0) >= 2)
        kept[view] |= candidates[view] & agreeing
    while True:  # what leaves changes what the rest is held against; nothing comes back, so that this ends
        before = kept
        enough = (kept.sum(1) >= LEAST) & kept[:, EYES].any(1)
        kept = kept & enough[:, None]
        total = (candidates & enough[:, None]).sum(0)
        needed = np.where(total < 3, 2, np.maximum(3, np.ceil(options.minimum_share * total)))
        kept = _without_worst(measured, kept & (kept.sum(0) >= needed), tolerance, options)
        if np.array_equal(kept, before):
            return kept


def _without_worst(
    measured: Measured, kept: np.ndarray, tolerance: float, options: TriangulationOptions
) -> np.ndarray:
    """Drop the worst view of each keypoint of [V, 5] until all that are left agree."""
    kept, keypoints = kept.copy(), np.arange(COUNT)
    while True:
        errors = np.where(kept, disagreement_of(measured, kept, options), -1.0)
        errors = np.where(np.isnan(errors), np.inf, errors)
        worst = errors.argmax(0)
        drop = (errors[worst, keypoints] > tolerance) & (kept.sum(0) > 2)
        if not drop.any():
            return kept
        kept[worst[drop], keypoints[drop]] = False


def disagreement_of(measured: Measured, kept: np.ndarray, options: TriangulationOptions) -> np.ndarray:
    """Disagreement [V, 5] of the keypoints of each view with the kept ones [V, 5] of others.

    Where a view is one of two, with the point of both: what is left is how far their rays miss each other.
    """
    count = len(kept)
    masks = np.repeat(kept.T[None], count, axis=0)  # [H, 5, V], without view h
    views = np.arange(count)
    masks[views, :, views] &= (kept.sum(0) <= 2)[None]
    errors = errors_of(measured, points_from(measured, masks, options))  # [H, V, 3, 5]
    return errors[views, views, AS_IS]
