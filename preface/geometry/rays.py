"""Rays of pixels, undistorted on the fly, from the same formulas for numpy and torch.

The definitions are multinerf's (google-research/multinerf, internal/camera_utils.py, `pixels_to_rays`),
with the world's axes as ours:

- a direction is the camera-frame vector (x, y, 1) of the undistorted pixel turned into the world, not
  normalised, so that a point at ray parameter t has depth t in its camera;
- a view direction is that direction at length one;
- a radius is 2/sqrt(12) times the mean length of the direction's change over one pixel in x and in y: at
  t = 1 a disc of that radius has the variance of the pixel's footprint.

multinerf takes that change as a difference to the next pixels. Here it is the derivative at the pixel's
centre, out of the Jacobian that undistortion has in hand: identical for a pinhole, half a pixel better
centred for a distorted lens, free of cancellation in float32, and defined up to the fold.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from array_api_compat import array_namespace

from preface.geometry import lens
from preface.geometry.arrays import Array, floating, rotate
from preface.geometry.cameras import Camera, stack_intrinsics
from preface.geometry.transforms import Rigid


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras of any models with their poses, stacked: all that rays need.

    Attributes:
        intrinsics: [..., 12] (see `preface.geometry.lens`), pixels.
        monotonic_radius: [...], normalised units.
        world_from_camera: [..., 3, 4], metres.
    """

    intrinsics: Array
    monotonic_radius: Array
    world_from_camera: Array

    @staticmethod
    def stack(cameras: Sequence[Camera], world_from_camera: Sequence[Rigid]) -> Views:
        """Stack n cameras and their n poses as float64 numpy arrays [n, ...]."""
        poses = [pose.matrix[:3] for _, pose in zip(cameras, world_from_camera, strict=True)]
        return Views(*stack_intrinsics(cameras), np.stack(poses))

    def map(self, function: Callable[[Array], Array]) -> Views:
        """Apply a function to each array, say `lambda a: torch.as_tensor(a, dtype=..., device=...)`."""
        return Views(*(function(getattr(self, field.name)) for field in fields(self)))

    def __getitem__(self, index: int | Array) -> Views:
        """Pick one view, or gather one per ray: an index [n] turns arrays [views, ...] into [n, ...]."""
        return self.map(lambda array: array[index])


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in the world frame, metres; NaN where not valid.

    Attributes:
        origins: [..., 3], camera centres.
        directions: [..., 3], of depth one.
        viewdirs: [..., 3], of length one.
        radii: [..., 1], of the cone at ray parameter 1.
        valid: [...], False where the lens maps no direction to the pixel.
    """

    origins: Array
    directions: Array
    viewdirs: Array
    radii: Array
    valid: Array


def cast_rays(views: Views, pixels: Array) -> Rays:
    """Cast rays through pixels [..., 2], whose leading dimensions broadcast against those of the views.

    For a training batch with a view index [n] and pixels [n, 2]: `cast_rays(views[index], pixels)`.
    For a whole image: `cast_rays(views[i], pixel_centers(width, height))`.
    """
    pixels = floating(pixels)
    xp = array_namespace(views.intrinsics, pixels)
    normalised, jacobian, valid = lens.unproject(views.intrinsics, views.monotonic_radius, pixels)
    in_camera = xp.concat((normalised, xp.ones_like(normalised[..., :1])), axis=-1)
    directions = rotate(views.world_from_camera[..., :3], in_camera)
    length = xp.sqrt(xp.sum(in_camera * in_camera, axis=-1, keepdims=True))
    footprint = xp.sqrt(xp.sum(jacobian * jacobian, axis=-2))  # change per pixel in x and in y
    return Rays(
        origins=xp.broadcast_to(views.world_from_camera[..., 3], directions.shape),
        directions=directions,
        viewdirs=directions / length,
        radii=xp.mean(footprint, axis=-1, keepdims=True) * (2 / math.sqrt(12)),
        valid=valid,
    )


def pixel_centers(width: int, height: int) -> np.ndarray:
    """Return the centres [height, width, 2] of an image's pixels as (x, y); the first is (0.5, 0.5)."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
