"""Cards: the alpha-textured triangles as which MakeHuman models hair and brows, lit and laid over a view."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from synthetic_studio.lighting import KEY_DIRECTION, Occluders, bake_surface
from synthetic_studio.proxies import Proxy
from synthetic_studio.raycasting import raycasting_scene
from synthetic_studio.regions import smoothstep
from synthetic_studio.strands import unit
from synthetic_studio.subdivision import catmull_clark, subdivide_corner_uvs, triangulate, vertex_normals
from synthetic_studio.textures import pyramid, sample

MAX_LAYERS = 16  # of hair over each other along a ray; what is behind shows through the rest
HIDDEN = 0.004  # share of a layer that no longer matters
FAR = 1e3  # metres, beyond every hit
RAGGED = 0.008  # metres; the length over which hair ends where it would hang before the face
OPAQUE = 0.35  # mean alpha from which on a triangle casts a shadow
THROUGH = 0.3  # share of the light on a card that comes through hair from its other side
# Recolouring keeps a texture's contrast, between these factors on the wanted colour.
CONTRAST = (0.25, 3.0)
OWN_HUE = 0.35  # share of a texture's deviations from its mean hue that are kept
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
DARK_LEVEL = 0.01  # linear; below it a texture's contrast is mostly the rounding of 8 bits


@dataclass(frozen=True)
class Cards:
    """One kind of cards on one head.

    Attributes:
        vertices: ``[V, 3]`` metres in the studio's frame.
        triangles: ``[T, 3]``.
        corner_uvs: ``[T, 3, 2]`` column and row in the texture, 0..1.
        texture: ``[H, W, 4]`` float32 linear RGB, premultiplied by alpha, and alpha.
        normals: ``[V, 3]`` unit normals of the front.
        light: ``[V, 2]`` irradiance over pi on the front and on the back.
        clearance: ``[V]`` metres from where they would hide the face; nothing is seen of them where it is negative.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    corner_uvs: np.ndarray
    texture: np.ndarray
    normals: np.ndarray
    light: np.ndarray
    clearance: np.ndarray


def make_cards(
    proxy: Proxy, vertices: np.ndarray, light: np.ndarray, clearance: np.ndarray, texture: np.ndarray
) -> Cards:
    """Smooth a fitted proxy by one level of subdivision, if it has quads, so that its outline is round.

    Args:
        proxy: The proxy.
        vertices: ``[V, 3]`` its vertices on one head, metres.
        light: ``[V, 2]`` their light on the front and on the back.
        clearance: ``[V]`` their clearance.
        texture: ``[H, W, 4]`` linear RGB, premultiplied, and alpha.
    """
    triangles, corner_uvs = proxy.faces, proxy.corner_uvs
    if triangles.shape[1] == 4:
        level = catmull_clark(proxy.faces, len(vertices))
        vertices, light, clearance = (level.operator @ values for values in (vertices, light, clearance))
        triangles, corner_uvs = split(level.quads, subdivide_corner_uvs(corner_uvs))
    normals = vertex_normals(vertices, triangles)
    return Cards(vertices, triangles, corner_uvs, texture, normals, light, clearance)


def split(faces: np.ndarray, corner_uvs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles ``[T, 3]`` and their texture coordinates ``[T, 3, 2]`` of quads, or of triangles as they are."""
    if faces.shape[1] == 3:
        return faces, corner_uvs
    return triangulate(faces), corner_uvs[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 2)


def recolour(texture: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return a texture ``[H, W, 4]`` premultiplied, its pattern kept and its mean moved to ``colour`` (linear RGB)."""
    alpha = texture[..., 3:]
    shade = texture[..., :3] + DARK_LEVEL
    mean = (alpha * shade).sum(axis=(0, 1)) / max(float(alpha.sum()), 1e-6)
    brightness = (shade @ LUMINANCE / (mean @ LUMINANCE))[..., None]
    pattern = brightness ** (1.0 - OWN_HUE) * (shade / mean) ** OWN_HUE
    return np.concatenate([alpha * np.clip(pattern, *CONTRAST) * colour, alpha], axis=2).astype(np.float32)


def shadow_triangles(proxy: Proxy, clearance: np.ndarray, texture: np.ndarray) -> np.ndarray:
    """Return the triangles ``[K, 3]`` of a proxy that are opaque enough to cast a shadow, and not before the face."""
    triangles, corner_uvs = split(proxy.faces, proxy.corner_uvs)
    levels = pyramid(np.ascontiguousarray(texture[..., 3:]))
    inner = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6.0
    place = np.einsum("sk,tkc->tsc", inner, corner_uvs)
    alpha = sample(levels[min(3, len(levels) - 1)], place.reshape(-1, 2)).reshape(len(place), -1)
    return triangles[(alpha.mean(axis=1) > OPAQUE) & (clearance[triangles].mean(axis=1) > 0.0)]


def light_both_sides(vertices: np.ndarray, normals: np.ndarray, occluders: Occluders) -> np.ndarray:
    """Return the light ``[V, 2]`` on the front and on the back of cards, some of it from the other side."""
    front, back = (bake_surface(vertices, side * normals, occluders).irradiance for side in (1.0, -1.0))
    return np.stack([front, back], axis=1) @ np.array([[1.0 - THROUGH, THROUGH], [THROUGH, 1.0 - THROUGH]])


class Hits(NamedTuple):
    """Where rays meet one kind of cards: ray, distance and triangle ``[P]``, barycentric coordinates ``[P, 2]``."""

    ray: np.ndarray
    distance: np.ndarray
    primitive: np.ndarray
    uv: np.ndarray


class CardShader:
    """Shades one kind of cards: diffuse on both sides, with a hair's soft highlight."""

    def __init__(self, cards: Cards) -> None:
        self._triangles, self._corner_uvs = cards.triangles, cards.corner_uvs
        self._table = np.column_stack([cards.normals, cards.light, cards.clearance]).astype(np.float32)
        self._brightness = float(cards.texture[..., :3].sum() / max(cards.texture[..., 3].sum(), 1e-6))
        self._pyramid = pyramid(cards.texture)
        a, b, c = (cards.vertices[cards.triangles[:, k]] for k in range(3))
        p, q, r = (cards.corner_uvs[:, k] * cards.texture.shape[1::-1] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        texels = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
        self._texel = float(np.sqrt(np.median(area / np.maximum(texels, 1e-9))))  # metres

    def normals(self, hits: Hits, view: np.ndarray) -> np.ndarray:
        """Return unit normals ``[P, 3]``, turned towards the camera in direction ``view`` ``[P, 3]``."""
        normal = unit(self._packed(hits)[:, :3])
        return np.where((normal * view).sum(axis=1, keepdims=True) < 0.0, -normal, normal)

    def alpha(self, hits: Hits, footprint: float) -> np.ndarray:
        """Return the opacity ``[P]`` of samples that are ``footprint`` metres wide."""
        return self._texture(hits, self._packed(hits)[:, 5], footprint)[:, 3]

    def shade(self, hits: Hits, view: np.ndarray, footprint: float) -> tuple[np.ndarray, np.ndarray]:
        """Return radiance ``[P, 3]``, premultiplied, and opacity ``[P]``."""
        packed = self._packed(hits)
        rgba = self._texture(hits, packed[:, 5], footprint)
        colour, alpha = rgba[:, :3], rgba[:, 3:]
        normal = unit(packed[:, :3])
        back = (normal * view).sum(axis=1, keepdims=True) < 0.0
        light = np.where(back, packed[:, 4:5], packed[:, 3:4])
        half = unit(view + unit(KEY_DIRECTION).astype(np.float32))
        mirror = np.clip((np.where(back, -normal, normal) * half).sum(axis=1, keepdims=True), 0.0, 1.0)
        gloss = 0.03 * alpha * mirror**40 + 0.12 * np.sqrt(alpha * colour) * mirror**8
        return light * (1.1 * colour + gloss), alpha[:, 0]

    def _packed(self, hits: Hits) -> np.ndarray:
        return _interpolated(self._table[self._triangles[hits.primitive]], hits.uv)

    def _texture(self, hits: Hits, clearance: np.ndarray, footprint: float) -> np.ndarray:
        level = int(np.clip(np.log2(max(footprint / self._texel, 1.0)), 0, len(self._pyramid) - 1))
        rgba = sample(self._pyramid[level], _interpolated(self._corner_uvs[hits.primitive], hits.uv))
        rgba = np.clip(rgba, 0.0, 1.0)
        # Darker hairs end later, so that hair before the face has no straight edge.
        brightness = rgba[:, :3].sum(axis=1) / np.maximum(rgba[:, 3] * self._brightness, 1e-6)
        end = clearance - RAGGED * np.clip(brightness - 1.0, -1.0, 1.0)
        return rgba * smoothstep(-0.5 * RAGGED, 0.5 * RAGGED, end)[:, None]


class CardLayers:
    """All cards of one head, composited from front to back over what else is seen."""

    def __init__(self, parts: tuple[Cards, ...]) -> None:
        self._shaders = [CardShader(cards) for cards in parts]
        self._scene = raycasting_scene([(cards.vertices, cards.triangles) for cards in parts])

    def over(
        self,
        rays: np.ndarray,
        depth: np.ndarray,
        radiance: np.ndarray,
        covered: np.ndarray,
        footprint: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lay the cards over solid surfaces.

        Args:
            rays: ``[R, 6]`` origin and direction.
            depth: ``[R]`` where the solid surfaces are, in lengths of the direction; infinite where there are none.
            radiance: ``[R, 3]`` of the solid surfaces, premultiplied.
            covered: ``[R]`` their coverage.
            footprint: Width of a sample in metres.

        Returns:
            Radiance and coverage with the cards.
        """
        light = np.zeros_like(radiance)
        through = np.ones(len(rays), np.float32)
        for shader, hits in self._front_to_back(rays, depth, through):
            shaded, alpha = shader.shade(hits, -unit(rays[hits.ray, 3:]), footprint)
            light[hits.ray] += through[hits.ray, None] * shaded
            through[hits.ray] *= 1.0 - alpha
        return light + through[:, None] * radiance, 1.0 - through * (1.0 - covered)

    def first_surface(
        self, rays: np.ndarray, depth: np.ndarray, normals: np.ndarray, footprint: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return depth ``[R]`` and normals ``[R, 3]`` where the cards in front, if they hide half of what is behind,
        replace those of the solid surfaces (both NaN where there are none).
        """
        depth, normals = depth.copy(), normals.copy()
        through = np.ones(len(rays), np.float32)
        solid = np.where(np.isnan(depth), np.inf, depth)
        for shader, hits in self._front_to_back(rays, solid, through):
            before = through[hits.ray]
            through[hits.ray] *= 1.0 - shader.alpha(hits, footprint)
            at = np.flatnonzero((before > 0.5) & (through[hits.ray] <= 0.5))
            chosen = Hits(*(values[at] for values in hits))
            depth[chosen.ray] = chosen.distance
            normals[chosen.ray] = shader.normals(chosen, -unit(rays[chosen.ray, 3:]))
        return depth, normals

    def _front_to_back(
        self, rays: np.ndarray, depth: np.ndarray, through: np.ndarray
    ) -> Iterator[tuple[CardShader, Hits]]:
        """Yield hits before ``depth``, layer by layer, on rays that the caller still lets ``through``.

        No ray appears twice in one of them.
        """
        found = self._scene.list_intersections(rays, nthreads=1)
        ray, distance, part, primitive, uv = (
            found[name].numpy()
            for name in ("ray_ids", "t_hit", "geometry_ids", "primitive_ids", "primitive_uvs")
        )
        ray = ray.astype(np.int64)
        shown = np.flatnonzero(distance < depth[ray])
        shown = shown[np.argsort(FAR * ray[shown] + distance[shown], kind="stable")]
        layer = np.arange(len(shown)) - np.searchsorted(ray[shown], ray[shown])
        shown = shown[np.argsort(layer, kind="stable")]
        ends = np.bincount(layer, minlength=1).cumsum()[:MAX_LAYERS]
        for in_layer in np.split(shown, ends)[:-1]:
            seen = in_layer[through[ray[in_layer]] > HIDDEN]
            for index, shader in enumerate(self._shaders):
                at = seen[part[seen] == index]
                yield shader, Hits(ray[at], distance[at], primitive[at].astype(np.int64), uv[at])


def _interpolated(corners: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Interpolate values at triangles' corners ``[P, 3, C]`` at barycentric coordinates ``[P, 2]``."""
    u, v = uv[:, :1], uv[:, 1:]
    return (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
