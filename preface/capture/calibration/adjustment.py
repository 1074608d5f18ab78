"""Rig adjustment: Levenberg-Marquardt, and the robust sequence around it.

Cauchy's loss finds the solution that most sightings agree on; sightings further off than four standard
deviations are then left out, and least squares over the others, which is efficient, ends it. Left-out
sightings come back as soon as the solution explains them, so that good ones are not lost to a poor start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.normal_equations import (
    NormalEquations,
    linearise,
    normal_equations,
    residuals,
)
from preface.capture.calibration.state import RigState
from preface.capture.calibration.views import BoardViews
from preface.geometry.errors import GeometryError

# A sighting is an outlier beyond this many standard deviations: of good ones, exp(-4²/2) = 0.03% are.
PRUNE_SIGMAS = 4.0
# Cauchy's scale in standard deviations; 2.385 would give 95% efficiency to one coordinate at a time.
CAUCHY_SIGMAS = 3.0
# The median length of two normal coordinates, in their standard deviation: sqrt(2 log 2).
RAYLEIGH_MEDIAN = 1.1774100225154747
# No detector is better than this, pixels: keeps exact sightings from being pruned for their rounding.
SIGMA_FLOOR = 1e-3
# Rounds of re-weighting and of pruning; two or three of each suffice on good footage.
ROBUST_ROUNDS = 8
PRUNE_ROUNDS = 8
# Next to nothing, as starts are good and weakly known directions (the principal point's) need long steps.
START_DAMPING = 1e-8
SLIGHT_DAMPING = 1e-6
MAX_DAMPING = 1e12
# A step that gains no more than this share of the cost may be the last.
NEARLY = 1e-3
# What summing squares may lose.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An adjusted rig.

    Attributes:
        state: the rig.
        used: [V, P], the sightings that least squares ran over.
        residuals: [V, P, 2] pixels, projected minus measured; NaN where nothing was seen.
    """

    state: RigState
    used: np.ndarray
    residuals: np.ndarray


def minimise(
    views: BoardViews,
    state: RigState,
    used: np.ndarray,
    free: np.ndarray,
    *,
    cauchy: float = np.inf,
    tolerance: float = 1e-9,
    iterations: int = 50,
) -> tuple[RigState, np.ndarray]:
    """Minimise the sum of losses of the used residuals.

    The loss of a sighting with residual r is c² log(1 + |r|²/c²) (Cauchy), or |r|² for infinite c. Damping
    follows Nielsen, "Damping parameter in Marquardt's method", 1999.

    Args:
        views, state: the problem and where to start.
        used: [V, P]; sightings that the start cannot project are left out.
        free: [Nh], from `free_head`; board poses are always free.
        cauchy: c, pixels.
        tolerance: end when less than this share of the cost remains to be gained.
        iterations: at most.

    Returns:
        the solution and its residuals [V, P, 2].
    """
    used = used & views.seen & np.isfinite(residuals(views, state)).all(axis=-1)
    at = _point(views, state, used, cauchy)
    damping = START_DAMPING
    for _ in range(iterations):
        equations = normal_equations(views, at.state, at.rows, at.weights).restricted(free)
        growth, gained, ahead = 2.0, -np.inf, 0.0
        while damping <= MAX_DAMPING:
            trial, ahead = _step(views, at, used, cauchy, equations, free, damping)
            gained = at.cost - trial.cost
            # Rounding can make the last, negligible step look uphill.
            if gained > 0 or (ahead <= ROUNDING * at.cost and np.isfinite(gained)):
                break
            damping, growth = damping * growth, growth * 2
        if not gained > 0:
            break
        ratio = gained / (2 * ahead)
        # Newton's next step gains about (1 - ratio)² of this one, unless damping holds it back.
        rest = gained * min(1.0, abs(1 - ratio)) if damping <= SLIGHT_DAMPING else gained
        finished = gained <= NEARLY * at.cost and rest <= tolerance * at.cost
        at = trial
        damping *= max(1 / 10, 1 - (2 * min(ratio, 1.5) - 1) ** 3)
        if finished:
            break
    return at.state, at.residual


class _Point(NamedTuple):
    """A state with everything that is known there."""

    state: RigState
    residual: np.ndarray
    rows: np.ndarray
    cost: float
    weights: np.ndarray


def _point(views: BoardViews, state: RigState, used: np.ndarray, cauchy: float) -> _Point:
    """Evaluate residuals and derivatives; the cost is infinite where a used residual is not finite."""
    residual, rows = linearise(views, state)
    squared = np.where(used, (residual**2).sum(axis=-1), 0.0)
    weights = used.astype(float)
    if not np.isfinite(squared).all():
        return _Point(state, residual, rows, np.inf, weights)
    moving = state.motion.cost(views) if state.motion else 0.0
    if np.isinf(cauchy):
        return _Point(state, residual, rows, moving + float(squared.sum()), weights)
    share = squared / cauchy**2
    cost = moving + float(cauchy**2 * np.log1p(share).sum())
    return _Point(state, residual, rows, cost, weights / (1 + share))


def _step(
    views: BoardViews,
    at: _Point,
    used: np.ndarray,
    cauchy: float,
    equations: NormalEquations,
    free: np.ndarray,
    damping: float,
) -> tuple[_Point, float]:
    """Take a damped step; return where it leads, and half the decrease of the cost that it promises."""
    try:
        head_step, tail_step, ahead = equations.step(damping)
        head = np.zeros(len(free))
        head[free] = head_step
        state = at.state.moved(head, tail_step)
        if state.motion:
            state = replace(state, motion=state.motion.moved(views, equations.view_step(head, tail_step)))
        return _point(views, state, used, cauchy), ahead
    except (np.linalg.LinAlgError, GeometryError):  # too little damping for a direction that nothing fixes
        return at._replace(cost=np.inf), np.inf


def adjust_robustly(views: BoardViews, state: RigState, trusted: np.ndarray, free: np.ndarray) -> Adjusted:
    """Adjust all unknowns although some sightings are wrong.

    Args:
        views, state: the problem and where to start.
        trusted: [V, P], sightings that are likely right; the first rounds run over those.
        free: [Nh], from `free_head`.
    """
    residual = residuals(views, state)
    sigma = spread(residual, trusted)
    for _ in range(ROBUST_ROUNDS):
        state, residual = minimise(
            views, state, trusted, free, cauchy=CAUCHY_SIGMAS * sigma, tolerance=1e-3, iterations=5
        )
        before, sigma = sigma, spread(residual, trusted)
        if sigma > 0.9 * before:
            break
    return least_squares(views, state, trusted, free)


def least_squares(views: BoardViews, state: RigState, trusted: np.ndarray, free: np.ndarray) -> Adjusted:
    """Alternate between pruning at four standard deviations and least squares until the two agree."""
    used = within(views, residuals(views, state), trusted & views.seen)
    for _ in range(PRUNE_ROUNDS):
        state, residual = minimise(views, state, used, free, tolerance=1e-8)
        before, used = used, within(views, residual, used)
        if np.array_equal(before, used):
            break
    return Adjusted(state, used, np.where(views.seen[..., None], residual, np.nan))


def within(views: BoardViews, residual: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the sightings [V, P] within four standard deviations, those estimated per camera over `used`.

    Cameras differ in focus and resolution, hence in noise.
    """
    length = np.linalg.norm(residual, axis=-1)
    inside = np.zeros_like(used)
    for camera in range(views.cameras):
        of_camera = views.camera == camera
        sigma = spread(residual[of_camera], used[of_camera])
        inside[of_camera] = length[of_camera] <= PRUNE_SIGMAS * sigma
    return inside & views.seen


def spread(residual: np.ndarray, used: np.ndarray) -> float:
    """Standard deviation per coordinate that the median residual suggests, pixels; robust to 50% outliers."""
    lengths = np.linalg.norm(residual[used], axis=-1)
    lengths = np.where(np.isnan(lengths), np.inf, lengths)
    if not len(lengths):
        return SIGMA_FLOOR
    median = np.median(lengths)
    if not np.isfinite(median):
        raise CalibrationError(
            "frames: most board points lie behind the cameras of the start; check camera order"
        )
    return max(float(median) / RAYLEIGH_MEDIAN, SIGMA_FLOOR)
