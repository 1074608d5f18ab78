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

Of the keypoints that agree a view contributes those that it is good for, where the errors by direction are known
(`landmark_bias`): a nose that is seen from the side agrees with other such noses, and all are wrong alike.

A view that would agree better if it were mirrored is named so; it counts as support for a proposal, and is not used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.options import TriangulationOptions
from preface.align.view_consensus import (
    AS_IS,
    COUNT,
    LEAST,
    MIRRORED,
    SLACK,
    SWAPPED,
    Measured,
    choose,
    disagreement_of,
    errors_of,
    points_from,
    scores_of,
    settle,
    triangulated_from,
)

SPREAD_DEGREES = 30.0  # between two rays of a keypoint's best views, below which the others take part too


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
        correction: float64 [5, 2] pixels that were added to its keypoints for the detector's bias; None without.
    """

    used: bool
    code: str
    reason: str
    disagreement: np.ndarray
    left_out: tuple[str, ...] = ()
    correction: np.ndarray | None = None

    @staticmethod
    def without(code: str, reason: str) -> ViewVerdict:
        """Of a view that could not be judged."""
        return ViewVerdict(False, code, reason, np.full(COUNT, np.nan))


_REASONS = {
    MIRRORED: (
        "mirrored",
        "would agree with the other views if the image were not mirrored; flip it, or calibrate with images that are "
        "mirrored in the same way",
    ),
    SWAPPED: (
        "swapped",
        "would agree with the other views if left and right were exchanged; number the subject's right, not the "
        "image's, as the scheme says",
    ),
}


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


def judge_views(
    measured: Measured, tolerance: float, credible: float, options: TriangulationOptions
) -> Judgement:
    """Judge V views, each against the others.

    Args:
        measured: see `measure`.
        tolerance: largest disagreement of a good view.
        credible: largest deviation of a keypoint that a view contributes, in eye distances; the `LEAST` best views
            of a keypoint always do.
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
    chosen = choose(measured, judged, tolerance, options) if len(judged) > 1 else None
    if chosen is None or chosen.ambiguous:
        for view in judged:
            verdicts[view] = (
                _alone(len(judged)) if chosen is None else ViewVerdict.without("ambiguous", _AMBIGUOUS)
            )
        return nothing
    agreeing = settle(measured, chosen.kept, judged, tolerance, options)
    kept = _credible(measured, agreeing, credible, options)
    points = points_from(measured, kept.T[None], options)[0]
    if not np.isfinite(points).any():
        for view in judged:
            verdicts[view] = ViewVerdict.without("disagrees", _ONE_DIRECTION)
        return nothing
    disagreement = disagreement_of(measured, kept, options)
    variants = errors_of(measured, points)
    for view in judged:
        verdicts[view] = _verdict(
            kept[view],
            measured.seen[view],
            (agreeing & ~kept)[view],
            disagreement[view],
            variants[view],
            tolerance,
            kept.any(1).sum(),
        )
    return Judgement(verdicts, kept, points)


def _credible(
    measured: Measured, agreeing: np.ndarray, credible: float, options: TriangulationOptions
) -> np.ndarray:
    """The keypoints [V, 5] of those that agree which their views are good for.

    All that agree where the best ones look from almost one side: a poor view then tells more of the depth.
    """
    deviations = np.where(agreeing, measured.deviations, np.inf)
    best = np.sort(deviations, axis=0)[min(LEAST, len(deviations)) - 1]
    kept = agreeing & (deviations <= np.maximum(credible, best))
    angles = triangulated_from(measured, kept.T[None], options).angle[0]
    return np.where(angles >= np.radians(SPREAD_DEGREES), kept, agreeing)


_AMBIGUOUS = (
    "the views contradict each other, and as many agree on one face as on another; look at the images, remove the "
    "wrong ones, or add views"
)
_ONE_DIRECTION = (
    "sees the face from almost the same direction as all that agree with it; add a view from another side"
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
    vague: np.ndarray,
    disagreement: np.ndarray,
    variants: np.ndarray,
    tolerance: float,
    used: int,
) -> ViewVerdict:
    """Put into words what disagreements [5], those of the three variants [3, 5] and the number of used views say.

    Of its keypoints [5] a view keeps some, sees some, and is not good enough for the vague ones.
    """
    named = dict(zip(CANONICAL_KEYPOINTS, 100 * disagreement, strict=True))
    far = [name for name, there in zip(named, seen & ~kept & ~vague, strict=True) if there]
    aside = [name for name, there in zip(named, vague, strict=True) if there]
    parts = ", ".join(f"{name} {named[name]:.3g}%" for name in far)
    if kept.any():
        left_out = tuple(name for name, here in zip(named, kept, strict=True) if not here)
        if used == 2:
            reason = "only two views agree, and a third to check them is missing"
            return ViewVerdict(True, "unchecked", reason, disagreement, left_out)
        if not far and not aside:
            return ViewVerdict(True, "agrees", "", disagreement, left_out)
        reasons = [f"{parts} of the distance between the outer eye corners off the other views"] * bool(far)
        reasons += [f"{', '.join(aside)}, which other views show better"] * bool(aside)
        reason = f"used without {'; '.join(reasons)}"
        return ViewVerdict(True, "partly", reason, disagreement, left_out)
    as_is = scores_of(variants[AS_IS], tolerance)
    for variant, (code, reason) in _REASONS.items():
        if scores_of(variants[variant], SLACK * tolerance) > max(as_is, LEAST):
            return ViewVerdict(False, code, reason, disagreement)
    reason = (
        f"lies where the other views do not put it: {parts} of the distance between the outer eye corners off, and "
        f"{100 * tolerance:g}% are accepted"
    )
    return ViewVerdict(False, "disagrees", reason, disagreement)
