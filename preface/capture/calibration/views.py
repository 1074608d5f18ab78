"""Sightings as dense arrays: one row per view (a camera that sees the board in a frame), one column per point.

A board has few points and a view sees most of them, so that padding costs less than indexing does: every
formula of the adjustment then runs over [V, P] at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from preface.capture.calibration.errors import CalibrationError
from preface.capture.observations import Observations


@dataclass(frozen=True, eq=False)
class BoardViews:
    """V views of a board of P points.

    Attributes:
        camera: [V], index of the camera of each view.
        frame: [V], index of its frame, thus of its board pose.
        pixels: [V, P, 2]; 0 where the point is not seen.
        seen: [V, P].
        points: [P, 3] metres, about `center`: rotations about the board's middle and shifts of it are then
            nearly independent, and a distant origin of the board's frame costs no digits.
        center: [3] metres, in the board's frame.
        bow: [P, 2], what one metre of each warp parameter adds to z: 1 - x² and 1 - y², with x and y in
            [-1, 1] over the board (mrcal's calobject_warp).
        cameras: number of cameras.
        frames: number of frames.
    """

    camera: np.ndarray
    frame: np.ndarray
    pixels: np.ndarray
    seen: np.ndarray
    points: np.ndarray
    center: np.ndarray
    bow: np.ndarray
    cameras: int
    frames: int

    def __len__(self) -> int:
        return len(self.camera)

    def select(self, keep: np.ndarray) -> BoardViews:
        """Return some of the views, by mask or index [V]; cameras and frames keep their numbers."""
        return replace(
            self,
            camera=self.camera[keep],
            frame=self.frame[keep],
            pixels=self.pixels[keep],
            seen=self.seen[keep],
        )

    def apart(self) -> BoardViews:
        """Return the same views with a frame of their own each, so that each camera stands alone."""
        return replace(self, frame=np.arange(len(self)), frames=len(self))


def stack_views(observations: Observations) -> tuple[BoardViews, np.ndarray]:
    """Arrange sightings by view.

    Returns:
        the views, and for each observation the index of its view, [M].

    Raises:
        CalibrationError: nothing was seen, or the board's points do not span a plane.
    """
    if not len(observations):
        raise CalibrationError(
            "frames: no camera saw the board in any frame; check the board's description and the images"
        )
    count = len(observations.frame_ids)
    keys = observations.camera.astype(np.int64) * count + observations.frame
    views, view_of = np.unique(keys, return_inverse=True)
    shape = (len(views), len(observations.board_points))
    pixels, seen = np.zeros((*shape, 2)), np.zeros(shape, bool)
    pixels[view_of, observations.point] = observations.pixels
    seen[view_of, observations.point] = True
    center, points, bow = _shape_of(observations.board_points)
    stacked = BoardViews(
        camera=views // count,
        frame=views % count,
        pixels=pixels,
        seen=seen,
        points=points,
        center=center,
        bow=bow,
        cameras=len(observations.camera_ids),
        frames=count,
    )
    return stacked, view_of


def _shape_of(board_points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the board's middle [3], its points about it [P, 3], and the warp basis [P, 2]."""
    low, high = board_points.min(axis=0), board_points.max(axis=0)
    center = (low + high) / 2
    half = (high - low)[:2] / 2
    if not (half > 0).all():
        raise CalibrationError(
            f"board_points: they span {2 * half[0]:g} x {2 * half[1]:g}; a board's points span a plane"
        )
    points = board_points - center
    return center, points, 1 - (points[:, :2] / half) ** 2
