"""What one camera sees of one head: radiance and fractional coverage, and exact depth and normals."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from preface.geometry import Camera, Rigid
from synthetic_studio.cards import CardLayers
from synthetic_studio.heads import Head
from synthetic_studio.shading import SkinShader, StrandShader, shade_eyes
from synthetic_studio.strands import unit
from synthetic_studio.template import head_template

RAYS_PER_STRIP = 1 << 19  # bounds the memory at any resolution
SKIN, STRANDS = 0, 3  # geometry ids in the ray caster
EYES = {1: "right", 2: "left"}
SUBJECT_DISTANCE = 0.95  # metres; picks the level of the skin's texture


@dataclass(frozen=True)
class HeadRender:
    """One view.

    Attributes:
        radiance: ``[H, W, 3]`` float32 linear light, premultiplied by coverage.
        alpha: ``[H, W]`` float32 coverage in 0..1.
        depth: ``[H, W]`` float32 metres along the camera's z axis at pixel centres; NaN where nothing is hit.
        normals: ``[H, W, 3]`` float32 unit normals in the studio's frame at pixel centres; NaN where nothing is hit.
    """

    radiance: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    normals: np.ndarray


class HeadRenderer:
    """Renders one head for any number of cameras."""

    def __init__(self, head: Head) -> None:
        self._head = head
        self._skin = SkinShader(head, head_template().corner_uvs)
        self._strands = StrandShader(head)
        self._cards = CardLayers(head.cards) if head.cards else None

    def render(self, camera: Camera, camera_from_studio: Rigid, antialias: int) -> HeadRender:
        """Render one view with ``antialias`` x ``antialias`` samples per pixel."""
        height, width = camera.height, camera.width
        radiance = np.zeros((height, width, 3), np.float32)
        alpha = np.zeros((height, width), np.float32)
        depth = np.full((height, width), np.nan, np.float32)
        normals = np.full((height, width, 3), np.nan, np.float32)
        rows = max(1, RAYS_PER_STRIP // (width * antialias**2))
        for top in range(0, height, rows):
            bottom = min(height, top + rows)
            strip = slice(top, bottom)
            radiance[strip], alpha[strip] = self._colour(camera, camera_from_studio, top, bottom, antialias)
            depth[strip], normals[strip] = self._geometry(camera, camera_from_studio, top, bottom)
        return HeadRender(radiance, alpha, depth, normals)

    def _colour(
        self, camera: Camera, camera_from_studio: Rigid, top: int, bottom: int, antialias: int
    ) -> tuple[np.ndarray, np.ndarray]:
        rays = pixel_rays(camera, camera_from_studio, top, bottom, antialias)
        hits = self._head.scene.cast_rays(rays, nthreads=1)
        geometry, primitive = hits["geometry_ids"].numpy(), hits["primitive_ids"].numpy().astype(np.int64)
        uv = hits["primitive_uvs"].numpy()
        view = -rays[:, 3:]
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        footprint = _footprint(camera, antialias)
        radiance = np.zeros((len(rays), 3), np.float32)
        for part in np.unique(geometry[geometry <= STRANDS]):
            at = np.flatnonzero(geometry == part)
            radiance[at] = self._shade(int(part), primitive[at], uv[at], view[at], footprint)
        covered = (geometry <= STRANDS).astype(np.float32)
        if self._cards:
            radiance, covered = self._cards.over(rays, hits["t_hit"].numpy(), radiance, covered, footprint)
        shape = (bottom - top, antialias, camera.width, antialias)
        return radiance.reshape(*shape, 3).mean(axis=(1, 3)), covered.reshape(shape).mean(axis=(1, 3))

    def _shade(
        self, part: int, primitive: np.ndarray, uv: np.ndarray, view: np.ndarray, footprint: float
    ) -> np.ndarray:
        if part == SKIN:
            return self._skin.shade(primitive, uv, view, footprint)
        if part == STRANDS:
            return self._strands.shade(primitive, uv, view)
        return shade_eyes(self._head, EYES[part], primitive, uv, view)

    def _geometry(
        self, camera: Camera, camera_from_studio: Rigid, top: int, bottom: int
    ) -> tuple[np.ndarray, np.ndarray]:
        rays = pixel_rays(camera, camera_from_studio, top, bottom, 1)
        hits = self._head.scene.cast_rays(rays, nthreads=1)
        geometry, primitive = hits["geometry_ids"].numpy(), hits["primitive_ids"].numpy().astype(np.int64)
        uv = hits["primitive_uvs"].numpy()
        # Directions have unit length along the camera's axis, so the ray parameter is the depth.
        depth = np.where(geometry <= STRANDS, hits["t_hit"].numpy(), np.nan)
        normals = np.full((len(rays), 3), np.nan, np.float32)
        at = np.flatnonzero(geometry == SKIN)
        normals[at] = self._skin.normals(primitive[at], uv[at])
        at = np.flatnonzero(geometry == STRANDS)
        normals[at] = self._strands.normals(primitive[at], -unit(rays[at, 3:]))
        for part, side in EYES.items():
            at = np.flatnonzero(geometry == part)
            points = rays[at, :3] + depth[at, None] * rays[at, 3:]
            normals[at] = unit(points - self._head.eyeballs[side].centre)
        if self._cards:
            depth, normals = self._cards.first_surface(rays, depth, normals, _footprint(camera, 1))
        shape = (bottom - top, camera.width)
        return depth.reshape(shape), normals.reshape(*shape, 3)


@lru_cache(maxsize=64)
def _camera_directions(camera: Camera, top: int, bottom: int, antialias: int) -> np.ndarray:
    """Return camera-frame directions with z = 1 at the samples of some rows, through the lens: ``[R, 3]``."""
    rows = top + (np.arange((bottom - top) * antialias) + 0.5) / antialias
    columns = (np.arange(camera.width * antialias) + 0.5) / antialias
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    xy, valid = camera.unproject(pixels)
    if not valid.all():
        raise ValueError(
            f"{(~valid).sum()} pixels lie past the monotonic radius of the lens; weaken its distortion"
        )
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1).astype(np.float32)


def _footprint(camera: Camera, antialias: int) -> float:
    """Return the width of a sample on the subject, in metres."""
    focal_length = float(np.mean(camera.intrinsics[:2]))
    return SUBJECT_DISTANCE / (focal_length * antialias)


def pixel_rays(
    camera: Camera, camera_from_studio: Rigid, top: int, bottom: int, antialias: int
) -> np.ndarray:
    """Return rays ``[R, 6]`` (origin, direction) in the studio's frame; directions have unit camera z."""
    directions = _camera_directions(camera, top, bottom, antialias) @ camera_from_studio.rotation.astype(
        np.float32
    )
    origin = camera_from_studio.inverse.translation.astype(np.float32)
    return np.concatenate([np.broadcast_to(origin, directions.shape), directions], axis=1)
