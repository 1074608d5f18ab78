"""Letting the board move within frames, where cameras turn out not to take them at the same instant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from preface.capture.calibration.adjustment import CAUCHY_SIGMAS, Adjusted, least_squares, minimise, spread
from preface.capture.calibration.initial import Alone
from preface.capture.calibration.motion import Motion
from preface.capture.calibration.normal_equations import residuals
from preface.capture.calibration.state import RigState

# Errors in the rig beyond this multiple of those of its cameras alone come from the rig: time, or motion. They are
# 0.91 to 1.03 of them in simulated rigs without lag, where letting the board move changes nothing.
UNSYNCHRONISED = 1.15
# So do views that it leaves out as a whole although they agree with themselves, beyond this share of all.
WHOLE_VIEWS = 0.03
# Views that moved further than this, in deviations, are of another frame altogether: of the t distribution of
# six numbers with four degrees of freedom, six in 10,000 are.
STRAY = 20.0
# Rounds of weighing the motion, until its deviations change by less than this share.
ROUNDS = 12
SETTLED = 0.02


def unsynchronised(adjusted: Adjusted, trusted: np.ndarray, noise: float) -> bool:
    """Whether a rig adjusted as if all cameras looked at once fits far worse than its cameras alone.

    Args:
        adjusted: the rig.
        trusted: [V, P], sightings that agree within their views.
        noise: standard deviation of the pixel noise that the cameras show alone.
    """
    of_view = trusted.sum(axis=1)
    left_out = (adjusted.used & trusted).sum(axis=1) < 0.5 * of_view
    whole = np.count_nonzero(left_out) > WHOLE_VIEWS * np.count_nonzero(of_view)
    return whole or spread(adjusted.residuals, trusted & adjusted.used) > UNSYNCHRONISED * noise


def adjust_moving(alone: Alone, rough: RigState, trusted: np.ndarray, free: np.ndarray) -> Adjusted:
    """Adjust all unknowns and how far the board moves within frames.

    Args:
        alone: the cameras alone, whose views have poses of their own.
        rough: the rig assembled from them, without motion.
        trusted: [V, P], sightings that are likely right, of views that are roughly so.
        free: [Nh], from `free_head`.
    """
    views = alone.views
    at_rest = rough.camera_from_board_at_rest(views)
    motion = Motion.between(views, at_rest, alone.state.rig_from_board)
    state, near, before = rough, trusted, np.full(6, np.inf)
    for _ in range(ROUNDS):
        sigma = spread(residuals(views, replace(state, motion=motion)), near)
        motion = motion.weighed(views, np.any(near, axis=1), sigma)
        near = trusted & (motion.lengths(views) <= STRAY)[:, None]
        start = replace(state, motion=motion)
        state, _ = minimise(views, start, near, free, cauchy=CAUCHY_SIGMAS * sigma, tolerance=1e-4)
        motion = state.motion or motion
        if np.allclose(motion.deviations, before, rtol=SETTLED):
            break
        before = motion.deviations
    return least_squares(views, state, near, free)
