"""Pictures of a fit under way: each view beside its render, and the head from where no photograph was taken."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from preface.geometry import Box, Camera, Rigid
from preface.model.evaluation.options import LARGEST_PSNR
from preface.model.fitting.cameras import corrected_pose
from preface.model.fitting.heads import Correction, code_of
from preface.model.fitting.reduction import reduce_pixels
from preface.model.metrics.image_quality import psnr
from preface.model.model import PriorModel
from preface.model.rendering.image import RenderedImage, Space, render_image
from preface.model.rendering.shortcuts import DEFAULT_QUALITY, QUALITIES, accelerate
from preface.model.rendering.showing import (
    ERROR_SHOWN,
    depth_picture,
    error_entry,
    error_picture,
    normals_entry,
    normals_picture,
    tile_size,
)
from preface.model.training.data import TrainingData
from preface.reports.pictures import Picture, as_picture, contact_sheet, with_legend
from preface.shards.heads import standing

PIXELS = 2**13  # of a picture, at most; previews are to be looked at, not measured
AWAY = math.radians(30)  # how far the new view is turned away from the front, about the vertical axis
_COLUMNS = 6


@dataclass(frozen=True, eq=False)
class Previewer:
    """Renders previews of a head.

    Attributes:
        model: the head, on its device.
        data: the views fitted to.
        pairs: int64 [n, 2], identity and view, in the order of the sheet's rows.
        correction: of their cameras, or None.
        micro_rays: rays at a time.
    """

    model: PriorModel
    data: TrainingData
    pairs: np.ndarray
    correction: Correction | None
    micro_rays: int

    def sheet(self) -> tuple[Picture, list[float]]:
        """A row per view: photograph, render, error, depth, normals and a new view; below, a legend.

        Returns:
            The sheet, and the PSNR of each view on black, whole pictures, dB.
        """
        tiles, found, render = [], [], self._renderer()
        for person, view in self.pairs.tolist():
            row, quality = self._row(person, view, render)
            tiles += row
            found.append(quality)
        drawn = contact_sheet(tiles, _COLUMNS, tile_size(*self._size()))
        return with_legend(drawn, [error_entry(), normals_entry()]), found

    def _renderer(self) -> Callable[[Camera, Rigid], RenderedImage]:
        """Render the head as it is now, by shortcuts: a preview shall not take longer than the fit."""
        scene, code = self.data.scene, code_of(self.model)
        space = Space(Box(scene.box[0], scene.box[1]), scene.scene_scale)
        row = None if code is None else code[0].detach()
        rays = accelerate(self.model, row, space, QUALITIES[DEFAULT_QUALITY], normals=True)
        how: dict[str, Any] = {"rays_at_a_time": self.micro_rays, "device": self.model.codes.device}
        return lambda camera, pose: render_image(rays, space, camera, pose, **how)

    def _row(
        self, person: int, view: int, render: Callable[[Camera, Rigid], RenderedImage]
    ) -> tuple[list[tuple[Picture, str]], float]:
        entry = self.data.dataset.manifest.identities[person]
        camera, pose = self._camera(person, view)
        truth = self._truth(person, view)
        seen, new = render(camera, pose), render(camera, turned_away(pose))
        quality = min(psnr(torch.from_numpy(seen.rgb), torch.from_numpy(truth)), LARGEST_PSNR)
        depths = self.data.scene.near_far
        assert seen.normals is not None
        row = [
            (as_picture(truth), str(entry.cameras[view])),
            (as_picture(seen.rgb), f"{quality:.2f} dB"),
            (error_picture(seen.rgb, truth), f"error, 0 to {ERROR_SHOWN}"),
            (depth_picture(seen.depth, *depths), f"depth, {depths[0]:.2f} to {depths[1]:.2f} m"),
            (normals_picture(seen.normals), "normals"),
            (as_picture(new.rgb), "a new view"),
        ]
        return row, quality

    def _size(self) -> tuple[int, int]:
        """Of the pictures: the views', or smaller."""
        width, height = self.data.scene.resolution
        factor = min(1.0, math.sqrt(PIXELS / (width * height)))
        return max(1, round(width * factor)), max(1, round(height * factor))

    def _camera(self, person: int, view: int) -> tuple[Camera, Rigid]:
        camera, placed = standing(self.data.dataset, person, view)
        if self.correction is not None:
            row = int(self.correction.rows[view])
            names = [str(number) for number in range(len(self.pairs))]
            placed = corrected_pose(
                placed, self.correction.cameras.described(names, self.correction.scale)[str(row)]
            )
        return camera.resized(*self._size()), placed

    def _truth(self, person: int, view: int) -> np.ndarray:
        """The photograph on black, float32 [h, w, 3] in [0, 1]."""
        pixels = self.data.dataset.pixels(person, view)
        if self._size() != self.data.scene.resolution:
            pixels = reduce_pixels(pixels, self._size())
        return (pixels[..., :3].astype(np.float32) / 255) * (pixels[..., 3:].astype(np.float32) / 255)


def turned_away(canonical_from_camera: Rigid) -> Rigid:
    """A pose turned about the vertical axis through the canonical origin, to the side where the camera is already."""
    side = math.copysign(AWAY, canonical_from_camera.translation[0])
    turn = Rotation.from_rotvec([0.0, side, 0.0]).as_matrix()
    pose = canonical_from_camera
    return Rigid(turn @ pose.rotation, turn @ pose.translation)
