"""Lenses that would fold where no board was seen: the coefficients that make them do so are not determined.

A polynomial fitted to the middle of an image can turn back on itself before the corners. Which coefficient
leads it there, no sighting says: the highest of that camera are held at zero, and the others are fitted again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from preface.capture.calibration.adjustment import Adjusted, minimise
from preface.capture.calibration.state import RigState
from preface.capture.calibration.views import BoardViews
from preface.geometry.cameras import CAMERA_MODELS, Camera

# Highest first; a rational model's denominator goes as a whole. The first radial coefficient stays: no camera
# of a distorting lens does without.
DISPENSABLE = (("k4", "k5", "k6"), ("k3",), ("k2",))


def unfolded(
    views: BoardViews, solution: Adjusted, free: np.ndarray, image_sizes: tuple[tuple[int, int], ...]
) -> tuple[Adjusted, np.ndarray]:
    """Hold coefficients at zero until no lens folds inside its image, or none is left to hold.

    Args:
        views, solution: the problem and its solution, to which the sightings in use belong.
        free: [Nh], what it ran over.
        image_sizes: (width, height) per camera.

    Returns:
        the solution without those coefficients, and what is free in it.
    """
    state, residual, free = solution.state, solution.residuals, free.copy()
    while folded := folding(state, image_sizes):
        highest = [_highest(state, free, camera) for camera in folded]
        if not all(highest):
            break
        held = np.concatenate(highest)
        params = state.params.copy()
        params.ravel()[held] = 0
        free[held] = False
        state = replace(state, params=params)
        state, residual = minimise(views, state, solution.used, free, tolerance=1e-6, iterations=20)
    seen = views.seen[..., None]
    return Adjusted(state, solution.used, np.where(seen, residual, np.nan)), free


def folding(state: RigState, image_sizes: tuple[tuple[int, int], ...]) -> list[int]:
    """Cameras whose lens folds inside the image."""
    return [
        camera
        for camera, (size, params) in enumerate(zip(image_sizes, state.params, strict=True))
        if Camera(state.model, *size, params).folds_inside_image()
    ]


def held_names(state: RigState, free: np.ndarray, camera_ids: tuple[str, ...]) -> tuple[str, ...]:
    """Name the camera parameters that are not free."""
    return tuple(state.head_name(int(i), camera_ids) for i in np.flatnonzero(~free[: state.params.size]))


def _highest(state: RigState, free: np.ndarray, camera: int) -> list[int]:
    """Where the highest coefficients of a camera that are still free stand in the head; empty if none is."""
    names = CAMERA_MODELS[state.model]
    for group in DISPENSABLE:
        places = [camera * len(names) + names.index(name) for name in group if name in names]
        if places and free[places].all():
            return places
    return []
