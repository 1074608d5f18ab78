"""Which views of a subject are right: judged as wholes, by geometry, never by the detector's own word.

A detector may put a whole face wrong: on a profile, on another person, on a mirrored image. Its landmarks then fit
each other, and rejecting them one by one leaves what happens to fit. So views are judged as wholes, by their five
keypoints. Every two views propose where the keypoints are, and the proposal that most views agree with wins. A view
agrees when three of its keypoints do, the outer eye corners among them: nose, mouth and chin alone may also fit a view
in which left and right are exchanged.

Each keypoint of a view is then held against what the other views say of it without this one, and is left out where it
disagrees; detectors slide along the chin and the nose as the head turns. What is left of a view that agrees is within
the tolerance. Disagreement is measured at the keypoint's depth, as a share of the distance between the outer eye
corners.

A view that would agree better if it were mirrored is named so; it counts as support for a proposal, and is not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS, Scheme
from preface.align.keypoints3d import eye_distance
from preface.align.options import TriangulationOptions
from preface.align.triangulation import triangulate
from preface.geometry import Views, lens

COUNT = len(CANONICAL_KEYPOINTS)
EYES = [CANONICAL_KEYPOINTS.index(name) for name in ("right_eye_outer", "left_eye_outer")]
LEAST = 3  # keypoints that a view must show, and agree in
SLACK = 2.0  # factor on the tolerance for what two views alone propose: their depth is noisier than a pixel
MAX_PROPOSALS = 300  # pairs of views; beyond 25 views, random ones
# Deviations in pixels of a camera whose focal length is 1000 px: only their ratios matter here.
_SIGMA_PER_FOCAL = 1e-3
# How a view may have been turned about: as it is, a mirrored image, left and right landmarks exchanged.
_AS_IS, _MIRRORED, _SWAPPED = range(3)


@dataclass(frozen=True, eq=False)
class ViewVerdict:
    """What is thought of one view.

    Attributes:
        used: whether the view takes part in triangulation.
        code: "agrees", "partly" (used, but for some keypoints), "unchecked" (used, but no third view to check it),
            "disagrees", "mirrored", "swapped" (left and right landmarks exchanged), "ambiguous", "unseen" (too few
            keypoints), "no_face" or "not_in_rig".
        reason: the same as a sentence with its remedy; empty where it agrees.
        disagreement: float64 [5], distance of each keypoint from where the other used views put it, at its
            depth, as a share of the distance between the outer eye corners; NaN where it cannot be said.
        left_out: names of the keypoints that a used view does not contribute to.
    """

    used: bool
    code: str
    reason: str
    disagreement: np.ndarray
    left_out: tuple[str, ...] = ()

    @staticmethod
    def without(code: str, reason: str) -> ViewVerdict:
        """Of a view that could not be judged."""
        return ViewVerdict(False, code, reason, np.full(COUNT, np.nan))


_REASONS = {
    _MIRRORED: (
        "mirrored",
        "would agree with the other views if the image were not mirrored; flip it, or calibrate with images that are "
        "mirrored in the same way",
    ),
    _SWAPPED: (
        "swapped",
        "would agree with the other views if left and right were exchanged; number the subject's right, not the "
        "image's, as the scheme says",
    ),
}


class Measured(NamedTuple):
    """Keypoints of V views.

    Attributes:
        views: their cameras.
        pixels: [V, 5, 2].
        image: [V, 3, 5, 2], undistorted to depth 1: as they are, unmirrored and with left and right exchanged.
    """

    views: Views
    pixels: np.ndarray
    image: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Which keypoints are seen [V, 5]."""
        return np.isfinite(self.image[:, _AS_IS]).all(-1)


def measure(scheme: Scheme, views: Views, widths: Sequence[int], landmarks: np.ndarray) -> Measured:
    """Gather the keypoints of landmarks [V, N, 2] in images of these widths."""
    as_is = scheme.keypoint_pixels(landmarks)
    swapped = scheme.keypoint_pixels(landmarks[:, scheme.mirror])
    mirrored = swapped * (-1, 1) + np.stack([np.asarray(widths, float), np.zeros(len(widths))], -1)[:, None]
    pixels = np.stack([as_is, mirrored, swapped], 1)
    image, _, _ = lens.unproject(
        views.intrinsics[:, None, None], views.monotonic_radius[:, None, None], pixels
    )
    return Measured(views, as_is, image)


class Judgement(NamedTuple):
    """What is thought of V views.

    Attributes:
        verdicts: [V].
        kept: bool [V, 5], the keypoints that each view contributes.
        points: [5, 3], the keypoints that they make; NaN where there is none.
    """

    verdicts: list[ViewVerdict]
    kept: np.ndarray
    points: np.ndarray


def judge_views(measured: Measured, tolerance: float, options: TriangulationOptions) -> Judgement:
    """Judge V views, each against the others.

    Args:
        measured: see `measure`.
        tolerance: largest disagreement of a good view.
        options: of the triangulation; here for its smallest angle.

    Returns:
        Fewer than two views are used when no two or more can be told to be right.
    """
    counts = measured.seen.sum(1)
    verdicts = [
        ViewVerdict.without("unseen", f"shows {count} of the five keypoints; {LEAST} are needed to judge it")
        for count in counts
    ]
    nothing = Judgement(verdicts, np.zeros_like(measured.seen), np.full((COUNT, 3), np.nan))
    judged = np.flatnonzero(counts >= LEAST)
    chosen = _choose(measured, judged, tolerance, options) if len(judged) > 1 else None
    if chosen is None or chosen.ambiguous:
        for view in judged:
            verdicts[view] = (
                _alone(len(judged)) if chosen is None else ViewVerdict.without("ambiguous", _AMBIGUOUS)
            )
        return nothing
    kept = _settle(measured, chosen.kept, judged, tolerance, options)
    disagreement = _disagreement(measured, kept, options)
    points = _points(measured, kept.T[None], options)[0]
    variants = _errors(measured, points)
    for view in judged:
        verdicts[view] = _verdict(
            kept[view], measured.seen[view], disagreement[view], variants[view], tolerance, kept.any(1).sum()
        )
    return Judgement(verdicts, kept, points)


_AMBIGUOUS = (
    "the views contradict each other, and as many agree on one face as on another; look at the images, remove the "
    "wrong ones, or add views"
)


def _alone(count: int) -> ViewVerdict:
    if count == 1:
        reason = "is the only view of the face; a second view is needed"
        return ViewVerdict.without("disagrees", reason)
    reason = "no two views agree on the face; are the images of one instant, and is this their rig?"
    return ViewVerdict.without("disagrees", reason)


def _verdict(
    kept: np.ndarray,
    seen: np.ndarray,
    disagreement: np.ndarray,
    variants: np.ndarray,
    tolerance: float,
    used: int,
) -> ViewVerdict:
    """Put into words what disagreements [5], those of the three variants [3, 5] and the number of used views say."""
    named = dict(zip(CANONICAL_KEYPOINTS, 100 * disagreement, strict=True))
    far = [name for name, here, there in zip(named, kept, seen, strict=True) if there and not here]
    parts = ", ".join(f"{name} {named[name]:.3g}%" for name in far)
    if kept.any():
        left_out = tuple(name for name, here in zip(named, kept, strict=True) if not here)
        if used == 2:
            reason = "only two views agree, and a third to check them is missing"
            return ViewVerdict(True, "unchecked", reason, disagreement, left_out)
        if not far:
            return ViewVerdict(True, "agrees", "", disagreement, left_out)
        reason = f"used without {parts} of the distance between the outer eye corners off the other views"
        return ViewVerdict(True, "partly", reason, disagreement, left_out)
    as_is = _score(variants[_AS_IS], tolerance)
    for variant, (code, reason) in _REASONS.items():
        if _score(variants[variant], SLACK * tolerance) > max(as_is, LEAST):
            return ViewVerdict(False, code, reason, disagreement)
    reason = (
        f"lies where the other views do not put it: {parts} of the distance between the outer eye corners off, and "
        f"{100 * tolerance:g}% are accepted"
    )
    return ViewVerdict(False, "disagrees", reason, disagreement)


# ---------------------------------------------------------------------------------- geometry


def _points(measured: Measured, masks: np.ndarray, options: TriangulationOptions) -> np.ndarray:
    """Keypoints [H, 5, 3] from the views in each of the masks [H, 5, V]; NaN where there is none."""
    loose = TriangulationOptions(
        outlier_threshold=1e9, minimum_angle_degrees=options.minimum_angle_degrees, minimum_share=0.0
    )
    pixels = np.where(masks[..., None], np.swapaxes(measured.pixels, 0, 1), np.nan)
    sigmas = _SIGMA_PER_FOCAL * measured.views.intrinsics[:, 0]
    return triangulate(measured.views, pixels, sigmas, loose).points


def _errors(measured: Measured, points: np.ndarray) -> np.ndarray:
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


def _score(errors: np.ndarray, tolerance: float) -> np.ndarray:
    """How many of errors [..., 5] are within the tolerance; 0 where they are fewer than three, or an eye is not."""
    within = errors <= tolerance
    count = within.sum(-1)
    eyes = errors[..., EYES]
    seen = ~np.isnan(eyes)
    return np.where((count >= LEAST) & seen.any(-1) & (within[..., EYES] | ~seen).all(-1), count, 0)


# --------------------------------------------------------------------------------- consensus


class _Choice(NamedTuple):
    """The keypoints [V, 5] of the views that a proposal stands on; whether an equally good one contradicts it."""

    kept: np.ndarray
    ambiguous: bool


def _choose(
    measured: Measured, judged: np.ndarray, tolerance: float, options: TriangulationOptions
) -> _Choice | None:
    """Find the proposal that most views agree with; None if not even two do."""
    pairs = np.array(list(combinations(judged, 2)))
    if len(pairs) > MAX_PROPOSALS:
        pairs = np.random.default_rng(0).permutation(pairs)[:MAX_PROPOSALS]
    views = np.zeros((len(pairs), len(measured.pixels)), dtype=bool)
    np.put_along_axis(views, pairs, True, axis=1)
    masks = np.repeat(views[:, None], COUNT, axis=1)
    for factor in (SLACK, SLACK, 1.0):
        errors = _errors(measured, _points(measured, masks, options))  # [H, V, 3, 5]
        within = _within(errors[..., _AS_IS, :], factor * tolerance)
        masks = np.where(within.sum(-1, keepdims=True) >= 2, within, masks)
    errors = _errors(measured, _points(measured, masks, options))
    score = _score(errors, SLACK * tolerance)  # [H, V, 3]
    agreeing = score[..., _AS_IS] > 0
    named = ~agreeing & (_score(errors[..., 1:, :], tolerance) > LEAST).any(-1)
    as_is = np.where(agreeing.sum(1) >= 2, agreeing.sum(1), 0)
    support = np.where(as_is > 0, as_is + named.sum(1), 0)
    strict = _score(errors[..., _AS_IS, :], tolerance).sum(1)
    best = int(np.lexsort((-strict, -as_is, -support))[0])
    if support[best] < 2:
        return None
    equal = (support == support[best]) & (as_is == as_is[best]) & ((agreeing & agreeing[best]).sum(1) < 2)
    kept = _per_keypoint(measured, np.flatnonzero(agreeing[best]), tolerance, options)
    return _Choice(kept, bool(equal.any()))


def _per_keypoint(
    measured: Measured, views: np.ndarray, tolerance: float, options: TriangulationOptions
) -> np.ndarray:
    """For each keypoint the views [V, 5], of these, that agree with what most of them say of it."""
    pairs = np.array(list(combinations(views, 2)))
    masks = np.zeros((len(pairs), COUNT, len(measured.pixels)), dtype=bool)
    for pair, mask in zip(pairs, masks, strict=True):
        mask[:, pair] = True
    allowed = np.isin(np.arange(len(measured.pixels)), views)[:, None]
    errors = _errors(measured, _points(measured, masks, options))[..., _AS_IS, :]  # [H, V, 5]
    cost = np.where(
        allowed & ~np.isnan(errors), np.minimum(errors, SLACK * tolerance), SLACK * tolerance
    ).sum(1)
    best = cost.argmin(0)
    chosen = errors[best, :, np.arange(COUNT)].T
    kept = allowed & (chosen <= SLACK * tolerance)
    again = _errors(measured, _points(measured, kept.T[None], options))[0, :, _AS_IS]
    return allowed & (again <= SLACK * tolerance)


def _within(errors: np.ndarray, tolerance: float) -> np.ndarray:
    """The keypoints [..., 5, V] within the tolerance, of errors [..., V, 5], in views that agree."""
    agreeing = _score(errors, tolerance) > 0
    return np.swapaxes((errors <= tolerance) & agreeing[..., None], -1, -2)


def _settle(
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
        errors = _disagreement(measured, joined, options)
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
        errors = np.where(kept, _disagreement(measured, kept, options), -1.0)
        errors = np.where(np.isnan(errors), np.inf, errors)
        worst = errors.argmax(0)
        drop = (errors[worst, keypoints] > tolerance) & (kept.sum(0) > 2)
        if not drop.any():
            return kept
        kept[worst[drop], keypoints[drop]] = False


def _disagreement(measured: Measured, kept: np.ndarray, options: TriangulationOptions) -> np.ndarray:
    """Disagreement [V, 5] of the keypoints of each view with the kept ones [V, 5] of others.

    Where a view is one of two, with the point of both: what is left is how far their rays miss each other.
    """
    count = len(kept)
    masks = np.repeat(kept.T[None], count, axis=0)  # [H, 5, V], without view h
    views = np.arange(count)
    masks[views, :, views] &= (kept.sum(0) <= 2)[None]
    errors = _errors(measured, _points(measured, masks, options))  # [H, V, 3, 5]
    return errors[views, views, _AS_IS]
