"""What a camera sees of a model: colour, opacity, depth and normals, strip by strip.

A strip is some rows of the image, as many as memory allows. Nothing is random and no ray knows its neighbours, so
that an image does not depend on how it was cut but for the rounding of matrix products of other sizes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from preface.geometry import Box, Camera, GeometryError, Rigid, Views, cast_rays
from preface.model.model import Render
from preface.model.rays import Rays
from preface.model.training.prior_files import Prior

SEEN = 0.5  # opacity from which a pixel has a depth and a normal
STRIP_RAYS = 65_536  # rays whose geometry is held at a time

RenderRays = Callable[[Rays], Render]


@dataclass(frozen=True, eq=False)
class Space:
    """Where a model lives.

    Attributes:
        box: of the canonical frame, metres.
        scale: 1/metre; the model's lengths are metres times this.
    """

    box: Box
    scale: float


def space_of(prior: Prior) -> Space:
    """Where a prior or a head lives."""
    scene = prior.scene
    return Space(Box(scene.box[0], scene.box[1]), scene.scene_scale)


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """An image of H rows and W columns.

    Attributes:
        rgb: float32 [H, W, 3], sRGB-encoded, in front of the background that was asked for.
        alpha: float32 [H, W], opacity.
        depth: float32 [H, W], metres along the camera's z axis, the median of where light stops; NaN where the
            opacity is below a half.
        normals: float32 [H, W, 3], of length one, canonical frame, out of the surface; NaN where depth is; None
            if they were not asked for.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    normals: np.ndarray | None


def render_image(
    render: RenderRays,
    space: Space,
    camera: Camera,
    canonical_from_camera: Rigid,
    *,
    rays_at_a_time: int,
    device: torch.device | str = "cpu",
    progress: Callable[[int], None] | None = None,
) -> RenderedImage:
    """Render what a camera sees of the box.

    Args:
        render: rays in scene units to what they see, such as `lambda rays: model(rays, code[None])`.
        space: of the model.
        camera: of the image; its distortion is rendered as it is.
        canonical_from_camera: pose, metres.
        rays_at_a_time: given to `render` together; memory goes with it.
        device: where `render` computes.
        progress: told the rows done, after each strip.

    Raises:
        GeometryError: the lens folds inside the image, so that some pixels have no ray.
        ValueError: `rays_at_a_time` is not positive.
    """
    if rays_at_a_time < 1:
        raise ValueError(f"rays_at_a_time: {rays_at_a_time} is not positive")
    rows = max(1, min(STRIP_RAYS, rays_at_a_time) // camera.width)
    view = Views.stack([camera], [canonical_from_camera])[0]
    canvas = _Canvas(camera.width, camera.height, space.scale)
    for top in range(0, camera.height, rows):
        bottom = min(top + rows, camera.height)
        strip = _strip_rays(view, space, camera.width, top, bottom).to(device)
        for begin in range(0, len(strip), rays_at_a_time):
            canvas.put(top * camera.width + begin, render(strip[begin : begin + rays_at_a_time]))
        if progress is not None:
            progress(bottom)
    return canvas.image()


class _Canvas:
    """An image that is filled ray by ray, in raster order."""

    def __init__(self, width: int, height: int, scale: float):
        self._shape, self._scale = (height, width), np.float32(scale)
        self._rgb = np.empty((height * width, 3), np.float32)
        self._alpha, self._depth = (np.empty(height * width, np.float32) for _ in range(2))
        self._normals: np.ndarray | None = None

    def put(self, first: int, seen: Render) -> None:
        """Keep what rays from number `first` on saw."""
        part = slice(first, first + len(seen.rgb))
        opaque = seen.acc > SEEN
        self._rgb[part] = _numpy(seen.rgb)
        self._alpha[part] = _numpy(seen.acc)
        self._depth[part] = _numpy(torch.where(opaque, seen.distance_median, torch.nan)) / self._scale
        normals = _normals(seen, opaque)
        if normals is not None:
            self._normals = np.empty_like(self._rgb) if self._normals is None else self._normals
            self._normals[part] = _numpy(normals)

    def image(self) -> RenderedImage:
        """What was put."""
        alpha, depth = (flat.reshape(self._shape) for flat in (self._alpha, self._depth))
        rgb = self._rgb.reshape(*self._shape, 3)
        return RenderedImage(
            rgb, alpha, depth, None if self._normals is None else self._normals.reshape(rgb.shape)
        )


def _strip_rays(view: Views, space: Space, width: int, top: int, bottom: int) -> Rays:
    """Rays of rows `top` to `bottom` - 1 in scene units, formed in float64."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(top, bottom) + 0.5)
    cast = cast_rays(view, np.stack([x, y], axis=-1).reshape(-1, 2))
    if not cast.valid.all():
        first = x.reshape(-1)[~cast.valid][0], y.reshape(-1)[~cast.valid][0]
        raise GeometryError(
            f"camera: its lens folds inside the image, so that pixel ({first[0]}, {first[1]}) has no ray; "
            "use a camera without distortion, or crop the image"
        )
    near, far, hit = space.box.intersect(cast.origins, cast.directions)
    arrays = {
        "origins": cast.origins * space.scale,
        "directions": cast.directions,
        "viewdirs": cast.viewdirs,
        "radii": cast.radii,
        # Rays that miss are not evaluated; their ends only have to be numbers.
        "near": np.where(hit, near, 0.0)[:, None] * space.scale,
        "far": np.where(hit, far, 1.0)[:, None] * space.scale,
    }
    tensors = {name: torch.from_numpy(values.astype(np.float32)) for name, values in arrays.items()}
    return Rays(**tensors, hit=torch.from_numpy(hit[:, None]))


def _normals(seen: Render, opaque: Tensor) -> Tensor | None:
    """The mean normal of a ray, at length one: the density's, or the predicted where there are no others."""
    along = seen.normals_pred if seen.normals is None else seen.normals
    if along is None:
        return None
    mean = (seen.levels[-1].weights[..., None] * along).sum(dim=-2)
    if seen.evaluated is not None:
        mean = torch.zeros_like(seen.rgb).index_copy(0, seen.evaluated, mean)
    length = mean.norm(dim=-1, keepdim=True)
    known = opaque[:, None] & (length > 0)
    return torch.where(known, mean / length.clamp_min(torch.finfo(mean.dtype).tiny), torch.nan)


def _numpy(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()
