"""Corrections of the cameras of a fit.

The paper names the error of its calibration as a limit of its results: at a metre, half a degree shifts a picture by
nine millimetres. A correction turns a camera about its own centre and then moves the centre, both along the axes of the
canonical frame:

    direction' = R(rotation) direction        origin' = origin + translation
    canonical_from_camera' = (R(rotation) R, centre + translation / scene_scale)

The part of the motion that all cameras share moves the head and nothing else. No photograph settles it: only what the
prior knows of where heads lie does, and the pull to zero (`CameraCorrections.penalty`). It is left in: with a prior,
taking it out gave back less of what wrong cameras cost.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from preface.geometry import Box, Rigid
from preface.model.rays import Rays

ROTATION_DEVIATION = math.radians(0.5)  # of a camera about each axis, radians
TRANSLATION_DEVIATION = 2e-3  # of its centre along each axis, metres
# Below this squared angle sin and cos are their series: three terms are then exact to a rounding of float64.
_SERIES_BELOW = 1e-4


class CameraCorrections(nn.Module):
    """A small motion per camera, none at first.

    Args:
        views: v, how many cameras.

    Attributes:
        rotation: [v, 3], rotation vectors, radians, canonical axes.
        translation: [v, 3], of the camera centres, scene units, canonical axes.
    """

    def __init__(self, views: int):
        super().__init__()
        self.rotation = nn.Parameter(torch.zeros(views, 3))
        self.translation = nn.Parameter(torch.zeros(views, 3))

    @classmethod
    def of(
        cls, known: Mapping[str, Mapping[str, Any]], cameras: Sequence[str], scene_scale: float
    ) -> CameraCorrections:
        """Those that `described` gave, none for a camera that is not among them."""
        made = cls(len(cameras))
        with torch.no_grad():
            for row, name in enumerate(cameras):
                if name in known:
                    moved = torch.tensor(known[name]["translation_m"], dtype=torch.float64)
                    made.rotation[row] = torch.tensor(known[name]["rotation"], dtype=torch.float64)
                    made.translation[row] = moved * scene_scale
        return made

    def apply(self, rays: Rays, view: Tensor, box: Box, scene_scale: float) -> Rays:  # type: ignore[override]
        """The rays of the corrected cameras.

        Origins and both kinds of directions carry derivatives. Near and far do not: they say where a ray is looked
        at, not what it sees. Rays of cameras without a correction are returned bit for bit. (The name hides
        `nn.Module.apply`, which has no use for a module without children.)

        Args:
            rays: n of them, in scene units.
            view: int64 [n], the row of the correction for each.
            box: canonical frame, metres, between whose faces the corrected rays run.
            scene_scale: scene units per metre.

        Returns:
            Rays with `near`, `far` and `hit` as `Box.intersect` gives them; rays that miss the box keep the near
            and far that they had.
        """
        turn, shift = self.rotation[view], self.translation[view]
        origins = rays.origins + shift
        directions, viewdirs = rotated(turn, rays.directions), rotated(turn, rays.viewdirs)
        moved = rays_between_faces(rays, origins, directions, viewdirs, box, scene_scale)
        assert moved.hit is not None
        before = torch.ones_like(moved.hit) if rays.hit is None else rays.hit
        still = ((turn == 0) & (shift == 0)).all(dim=-1, keepdim=True)
        return replace(
            moved,
            near=torch.where(still, rays.near, moved.near),
            far=torch.where(still, rays.far, moved.far),
            hit=torch.where(still, before, moved.hit),
        )

    def penalty(
        self,
        scene_scale: float,
        rotation_deviation: float = ROTATION_DEVIATION,
        translation_deviation: float = TRANSLATION_DEVIATION,
    ) -> Tensor:
        """How unlikely the corrections are, a number, 0 where there are none.

        It is the negative logarithm of independent normal densities, less its constant, as a mean over cameras. A
        loss that is the mean absolute error of N independent numbers, whose size is b, becomes the posterior's when
        the penalty is added with weight views * b / N. Neighbouring pixels err alike, so N is far below their count.

        Args:
            scene_scale: scene units per metre.
            rotation_deviation: standard deviation about each axis, radians.
            translation_deviation: along each axis, metres.
        """
        turned = self.rotation / rotation_deviation
        moved = self.translation / (translation_deviation * scene_scale)
        return 0.5 * (turned.square() + moved.square()).sum(dim=-1).mean()

    def described(self, cameras: Sequence[str], scene_scale: float) -> dict[str, dict[str, list[float]]]:
        """The corrections as `model.json` carries them: `rotation`, radians, and `translation_m` by camera."""
        turns = self.rotation.detach().double().tolist()
        shifts = (self.translation.detach().double() / scene_scale).tolist()
        return {
            camera: {"rotation": turn, "translation_m": shift}
            for camera, turn, shift in zip(cameras, turns, shifts, strict=True)
        }


def rays_between_faces(
    rays: Rays, origins: Tensor, directions: Tensor, viewdirs: Tensor, box: Box, scene_scale: float
) -> Rays:
    """Rays that were moved, between the faces of the box as they are now.

    Args:
        rays: n of them, before they were moved.
        origins, directions, viewdirs: [n, 3], after it, scene units.
        box: canonical frame, metres.
        scene_scale: scene units per metre.

    Returns:
        Rays with `near`, `far` and `hit` as `Box.intersect` gives them, without derivatives; those that miss the box
        keep the near and far that they had.
    """
    scaled = Box(box.minimum * scene_scale, box.maximum * scene_scale)
    near, far, hit = (x[:, None] for x in scaled.intersect(origins.detach(), directions.detach()))
    return replace(
        rays,
        origins=origins,
        directions=directions,
        viewdirs=viewdirs,
        near=torch.where(hit, near, rays.near),
        far=torch.where(hit, far, rays.far),
        hit=hit,
    )


def corrected_pose(canonical_from_camera: Rigid, correction: Mapping[str, Any]) -> Rigid:
    """A pose after the correction of its camera, as `CameraCorrections.described` gives it.

    Args:
        canonical_from_camera: metres.
        correction: `rotation` [3], radians, and `translation_m` [3].
    """
    turn = Rotation.from_rotvec(correction["rotation"]).as_matrix()
    return Rigid(
        turn @ canonical_from_camera.rotation,
        canonical_from_camera.translation + correction["translation_m"],
    )


def rotated(rotation: Tensor, vectors: Tensor) -> Tensor:
    """Turn vectors by rotation vectors: Rodrigues' formula, exact at no rotation, smooth everywhere.

    v' = v + sin(a)/a (r x v) + (1 - cos(a))/a^2 (r x (r x v)) with a = |r|.

    Args:
        rotation: [..., 3], radians.
        vectors: [..., 3].

    Returns:
        [..., 3].
    """
    squared = rotation.square().sum(dim=-1, keepdim=True)
    small = squared < _SERIES_BELOW
    # Where the series holds, the other branch is taken at an angle of one: it must be finite to have no derivative.
    apart = torch.where(small, torch.ones_like(squared), squared)
    angle = apart.sqrt()
    half = torch.sin(0.5 * angle)
    sine = torch.where(small, 1 - squared / 6 + squared.square() / 120, torch.sin(angle) / angle)
    versine = torch.where(small, 0.5 - squared / 24 + squared.square() / 720, 2 * half.square() / apart)
    once = torch.linalg.cross(rotation, vectors)
    return vectors + sine * once + versine * torch.linalg.cross(rotation, once)
