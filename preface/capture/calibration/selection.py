"""Choosing the simplest camera model and board shape that frames not solved for support.

k-fold cross-validation over frames: the rig is adjusted without a fold's frames; in those only the boards'
poses are then fitted, with everything else held, and the remaining errors count. Too simple a model bends
them; a needless parameter has followed the training frames' noise. Of all candidates within one standard
error of the best (Breiman et al., "Classification and Regression Trees", 1984, section 3.4.3; here the
standard error of the difference to the best, over frames), the one with the fewest parameters is chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from preface.capture.calibration.adjustment import Adjusted, minimise
from preface.capture.calibration.covariance import uncertainty
from preface.capture.calibration.determined import FOCAL_TOLERANCE
from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.folding import folding, held_names, unfolded
from preface.capture.calibration.state import RigState, free_head
from preface.capture.calibration.views import BoardViews

CRITERION = (
    "fewest parameters among the candidates whose held-out error is within one standard error of the best "
    "(of the mean difference per frame)"
)
# Frames per fold below which the held-out error says nothing.
MIN_FRAMES_PER_FOLD = 2


@dataclass(frozen=True)
class Candidate:
    """One line of the selection table.

    Attributes:
        camera_model: a key of `CAMERA_MODELS`.
        board_warp: whether the board's two warp parameters were free.
        parameters: number of them, of all cameras and the warp.
        training_rms: pixels, with all frames.
        held_out_rms: pixels, over the frames held out in turn; None for a refused candidate.
        excess: mean over frames of the squared held-out error beyond the best candidate's, pixels²; or None.
        standard_error: of `excess`; or None.
        refused: why the candidate cannot be chosen; empty if it can.
        chosen: whether it was.
        held: coefficients held at zero, as the lens would fold inside its image with them.
    """

    camera_model: str
    board_warp: bool
    parameters: int
    training_rms: float
    held_out_rms: float | None
    excess: float | None
    standard_error: float | None
    refused: str
    chosen: bool
    held: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Tried:
    model: str
    warp: bool
    solution: Adjusted
    free: np.ndarray
    training_rms: float
    refused: str
    by_frame: np.ndarray  # mean squared held-out error per frame, NaN where it has none; empty if refused
    held_out_rms: float | None

    @property
    def parameters(self) -> int:
        return int(self.free[: self.solution.state.params.size].sum()) + 2 * self.warp


def select_model(
    views: BoardViews,
    flexible: Adjusted,
    models: Sequence[str],
    warps: Sequence[bool],
    folds: int,
    camera_ids: tuple[str, ...],
    image_sizes: tuple[tuple[int, int], ...],
) -> tuple[tuple[Candidate, ...], RigState, np.ndarray]:
    """Choose among camera models and board shapes.

    Args:
        views: the problem.
        flexible: a robust solution under a flexible model; all candidates are judged on its inliers.
        models, warps: the candidates, each model with each of the warps.
        folds: how many parts the frames are divided into.
        camera_ids, image_sizes: of the cameras.

    Returns:
        the table, simplest first; the chosen candidate's solution over all frames, and what is free in it, [Nh].

    Raises:
        CalibrationError: too few frames, or the sightings determine no candidate.
    """
    frames = np.unique(views.frame[flexible.used.any(axis=1)])
    if len(frames) < folds * MIN_FRAMES_PER_FOLD:
        raise CalibrationError(
            f"frames: {len(frames)} are too few to choose a model with {folds} folds; show the board in "
            f"{folds * MIN_FRAMES_PER_FOLD} or more, or name the camera model and the board's warp"
        )
    # Every folds-th frame, so that each part spans the whole session.
    parts = [frames[start::folds] for start in range(folds)]
    tried = [
        _try(views, flexible, model, warp, parts, camera_ids, image_sizes)
        for model in models
        for warp in warps
    ]
    tried.sort(key=lambda candidate: candidate.parameters)
    allowed = [candidate for candidate in tried if not candidate.refused]
    if not allowed:
        reasons = "; ".join(sorted({candidate.refused for candidate in tried}))
        raise CalibrationError(f"camera_model: the sightings determine none of the candidates: {reasons}")
    best = min(allowed, key=lambda candidate: candidate.held_out_rms or 0.0)
    chosen = next(c for c in allowed if _excess(c, best)[0] <= _excess(c, best)[1])
    table = tuple(
        Candidate(
            candidate.model,
            candidate.warp,
            candidate.parameters,
            candidate.training_rms,
            candidate.held_out_rms,
            None if candidate.refused else _excess(candidate, best)[0],
            None if candidate.refused else _excess(candidate, best)[1],
            candidate.refused,
            candidate is chosen,
            held_names(candidate.solution.state, candidate.free, camera_ids),
        )
        for candidate in tried
    )
    return table, chosen.solution.state, chosen.free


def held_out(
    views: BoardViews, solution: Adjusted, free: np.ndarray, parts: Sequence[np.ndarray]
) -> np.ndarray:
    """Residuals [V, P, 2] of each part's frames under the rig that the other frames give; NaN elsewhere."""
    held = np.full_like(solution.residuals, np.nan)
    nothing = np.zeros_like(free)
    for part in parts:
        out = np.isin(views.frame, part)
        train = views.select(~out)
        state, _ = minimise(train, solution.state, solution.used[~out], free, tolerance=1e-6, iterations=20)
        _, residual = minimise(views.select(out), state, solution.used[out], nothing, tolerance=1e-6)
        held[out] = np.where(solution.used[out, :, None], residual, np.nan)
    return held


def _try(
    views: BoardViews,
    flexible: Adjusted,
    model: str,
    warp: bool,
    parts: Sequence[np.ndarray],
    camera_ids: tuple[str, ...],
    image_sizes: tuple[tuple[int, int], ...],
) -> _Tried:
    start = flexible.state.as_model(model)
    if not warp:
        start = replace(start, warp=np.zeros(2))
    free = free_head(start, warp=warp)
    state, residual = minimise(views, start, flexible.used, free, tolerance=1e-6, iterations=20)
    solution, free = unfolded(views, Adjusted(state, flexible.used, residual), free, image_sizes)
    training = float(np.sqrt((solution.residuals[flexible.used] ** 2).sum(axis=-1).mean()))
    refused = _refusal(views, solution, free, camera_ids, image_sizes)
    if refused:
        return _Tried(model, warp, solution, free, training, refused, np.empty(0), None)
    squared = (held_out(views, solution, free, parts) ** 2).sum(axis=-1)
    counted = np.isfinite(squared)
    total = np.bincount(views.frame, np.where(counted, squared, 0).sum(axis=1), views.frames)
    count = np.bincount(views.frame, counted.sum(axis=1), views.frames)
    by_frame = np.divide(total, count, out=np.full(views.frames, np.nan), where=count > 0)
    rms = float(np.sqrt(total.sum() / count.sum()))
    return _Tried(model, warp, solution, free, training, refused, by_frame, rms)


def _refusal(
    views: BoardViews,
    solution: Adjusted,
    free: np.ndarray,
    camera_ids: tuple[str, ...],
    image_sizes: tuple[tuple[int, int], ...],
) -> str:
    """Say why the sightings rule a candidate out, or nothing."""
    state = solution.state
    try:
        known = uncertainty(views, state, solution.used, free, camera_ids)
    except CalibrationError as error:
        return str(error)
    deviation = known.standard_deviations[0][:, 0] / state.params[:, 0]
    worst = int(np.argmax(deviation))
    if deviation[worst] > FOCAL_TOLERANCE:
        return f"focal length of camera '{camera_ids[worst]}' is only known to {deviation[worst]:.1%}"
    folded = folding(state, image_sizes)
    return f"the lens of camera '{camera_ids[folded[0]]}' would fold inside its image" if folded else ""


def _excess(candidate: _Tried, best: _Tried) -> tuple[float, float]:
    """Mean over frames of the squared error beyond the best's, and its standard error."""
    difference = candidate.by_frame - best.by_frame
    difference = difference[np.isfinite(difference)]
    return float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(len(difference)))
