"""Looking at a prior: whole views rendered and measured, and faces between faces.

Figures and pictures are of the model without jitter, hence repeatable, and as it is trained: one that models the
background is rendered with it, between the planes of the view, and held against photographs as they are. Rendering
and evaluation leave the background out (`preface.model.rendering.accelerated`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from preface.model.evaluation.options import LARGEST_PSNR
from preface.model.metrics.image_quality import psnr
from preface.model.model import PriorModel
from preface.model.rendering.image import SEEN
from preface.model.rendering.showing import ERROR_SHOWN, error_picture, tile_size
from preface.model.training.data import TrainingData, WholeViews, frontal_view
from preface.model.training.prior_loss import rays_of, target_colors
from preface.model.training.trainer import slice_batch
from preface.reports.pictures import Picture, as_picture, colorize, contact_sheet
from preface.shards import Batch, Loader

MAX_ROWS = 12  # of a sheet of views; more is no longer looked at
STEPS_BETWEEN = 7  # faces per row of an interpolation, both ends included


@dataclass(frozen=True, eq=False)
class ViewImages:
    """A view, rendered.

    Attributes:
        name: identity/camera.
        truth, rgb: float32 [H, W, 3] in [0, 1].
        depth: float32 [H, W], metres; NaN where the model is transparent.
        psnr: over the pixels whose ray meets the box, dB.
        psnr_foreground: over those that are more than half foreground; NaN if there are none.
    """

    name: str
    truth: np.ndarray
    rgb: np.ndarray
    depth: np.ndarray
    psnr: float
    psnr_foreground: float


@dataclass(frozen=True, eq=False)
class Viewer:
    """Renders views of a dataset with a model on the device where that is.

    Attributes:
        model: to look at.
        data: the views.
        planes: as `rays_of` takes them.
        micro_rays: rays at a time.
    """

    model: PriorModel
    data: TrainingData
    planes: Tensor
    micro_rays: int

    def render(self, pairs: np.ndarray) -> Iterator[ViewImages]:
        """Render views int64 [n, 2] with the codes of their identities, one at a time."""
        for batch, pair in self._batches(pairs):
            yield self._compare(batch, pair)

    def interpolate(self, people: Sequence[tuple[int, int]]) -> list[list[np.ndarray]]:
        """Faces between pairs of identities, each row seen as the first one's most frontal view.

        Args:
            people: numbers of identities of the dataset, two per row.

        Returns:
            Rows of `STEPS_BETWEEN` pictures, float32 [H, W, 3].
        """
        pairs = np.array([(one, frontal_view(self.data, one)) for one, _ in people])
        rows = []
        for (batch, _), (one, other) in zip(self._batches(pairs), people, strict=True):
            first, last = (self.model.codes[int(self.data.row[person])].detach() for person in (one, other))
            shares = np.linspace(0, 1, STEPS_BETWEEN).tolist()
            rows.append([self._image(batch, torch.lerp(first, last, share))[0] for share in shares])
        return rows

    def _batches(self, pairs: np.ndarray) -> Iterator[tuple[Batch, tuple[int, int]]]:
        views = WholeViews(self.data.train, pairs)
        device, scale = self.model.codes.device, self.data.scene.scene_scale
        loader = Loader(self.data.dataset, views, device=device, placement="mmap", scale=scale)
        for number, pair in enumerate(views):
            yield loader.batch(number), pair

    def _image(self, batch: Batch, code: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Colours [H, W, 3] and depths [H, W] of a whole view."""
        width, height = self.data.scene.resolution
        colors, depths = [], []
        with torch.no_grad():
            for begin in range(0, len(batch), self.micro_rays):
                part = slice_batch(batch, begin, begin + self.micro_rays)
                rays = rays_of(part, self.model, self.planes, self.data.dataset.manifest.views)
                seen = self.model(rays, code[None])
                colors.append(seen.rgb.cpu())
                depth = torch.where(seen.acc > SEEN, seen.distance_median, torch.nan)
                depths.append(depth.cpu() / self.data.scene.scene_scale)
        return (
            torch.cat(colors).view(height, width, 3).numpy(),
            torch.cat(depths).view(height, width).numpy(),
        )

    def _compare(self, batch: Batch, pair: tuple[int, int]) -> ViewImages:
        entry = self.data.dataset.manifest.identities[pair[0]]
        rgb, depth = self._image(batch, self.model.codes[int(self.data.row[pair[0]])])
        truth = target_colors(batch, self.model.config.background).cpu().view(rgb.shape).numpy()
        hit = batch.hit.cpu().view(depth.shape)
        foreground = hit & (batch.alpha.cpu().view(depth.shape) > 0.5)
        figures = [_psnr(rgb, truth, mask) for mask in (hit, foreground)]
        return ViewImages(f"{entry.identity}/{entry.cameras[pair[1]]}", truth, rgb, depth, *figures)


def _psnr(rgb: np.ndarray, truth: np.ndarray, mask: Tensor) -> float:
    """In dB, at most `LARGEST_PSNR`, so that it can be averaged and written; NaN where no pixel counts."""
    if not bool(mask.any()):
        return math.nan
    return min(psnr(torch.from_numpy(rgb), torch.from_numpy(truth), mask), LARGEST_PSNR)


@dataclass(frozen=True, eq=False)
class Validation:
    """Figures of many views: means over those that have the figure, and some of the views to look at."""

    figures: dict[str, float]
    shown: list[ViewImages]

    @staticmethod
    def of(viewer: Viewer, pairs: np.ndarray) -> Validation:
        """Render views, and keep the pictures of `MAX_ROWS` of them, spread over all."""
        kept = set(np.linspace(0, len(pairs) - 1, MAX_ROWS).round().tolist())
        found: dict[str, list[float]] = {"psnr": [], "psnr_foreground": []}
        shown = []
        for number, view in enumerate(viewer.render(pairs)):
            for name, values in found.items():
                values.append(getattr(view, name))
            if number in kept:
                shown.append(view)
        known = {name: [v for v in values if not math.isnan(v)] for name, values in found.items()}
        figures: dict[str, float] = {"views": len(pairs)}
        figures.update({name: float(np.mean(values)) for name, values in known.items() if values})
        return Validation(figures, shown)


def view_sheet(views: Sequence[ViewImages], box_depths: tuple[float, float]) -> Picture:
    """A row per view: the photograph, the render, their difference and the depth."""
    height, width = views[0].depth.shape
    tiles = []
    for view in views:
        tiles += [
            (as_picture(view.truth), view.name),
            (as_picture(view.rgb), f"{view.psnr:.2f} dB"),
            (error_picture(view.rgb, view.truth), f"error, 0 to {ERROR_SHOWN}"),
            (colorize(view.depth, *box_depths, "viridis"), "depth"),
        ]
    return contact_sheet(tiles, 4, tile_size(width, height))


def interpolation_sheet(rows: Sequence[Sequence[np.ndarray]], names: Sequence[tuple[str, str]]) -> Picture:
    """A row per pair of identities."""
    height, width = rows[0][0].shape[:2]
    tiles = []
    for row, (one, other) in zip(rows, names, strict=True):
        captions = [one, *[f"{share:.2f}" for share in np.linspace(0, 1, len(row))[1:-1]], other]
        tiles += [(as_picture(picture), words) for picture, words in zip(row, captions, strict=True)]
    return contact_sheet(tiles, len(rows[0]), tile_size(width, height))


def as_png(picture: Picture) -> bytes:
    """Encode a picture."""
    return cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes()
