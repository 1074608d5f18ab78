"""One identity in the user's own assets: its proxies fitted to its body, its skin and irises painted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from synthetic_studio.assets import Chosen, choose, read_library
from synthetic_studio.cards import Cards, light_both_sides, make_cards, recolour, shadow_triangles, split
from synthetic_studio.eyes import EyeColour
from synthetic_studio.facial_hair import brow_colour
from synthetic_studio.identity import HAIR_COLOURS, IRIS_COLOURS, Identity
from synthetic_studio.lighting import Occluders
from synthetic_studio.painted_skin import draw_tone, iris_colour, paint_skin
from synthetic_studio.proxies import Proxy
from synthetic_studio.raycasting import raycasting_scene
from synthetic_studio.skin import Skin
from synthetic_studio.strands import unit
from synthetic_studio.streams import Stream, generator
from synthetic_studio.subdivision import vertex_normals
from synthetic_studio.template import EYE_RANGES, fit_sphere
from synthetic_studio.textures import read_texture

if TYPE_CHECKING:
    from synthetic_studio.heads import Surface

# Hair frames the face, as the built-in hair does: metres from the eyes' midpoint, within which it is cut.
FACE_HALF_WIDTH = 0.054
FACE_HEIGHTS = (-0.20, 0.034)
FACE_BACK = -0.045
BROW_LIFT = 0.0004  # metres over the skin, so that no brow sinks into it


@dataclass(frozen=True)
class Fitted:
    """A proxy on one head.

    Attributes:
        proxy: Which one.
        vertices: ``[V, 3]`` metres in the studio's frame.
        clearance: ``[V]`` see :class:`~synthetic_studio.cards.Cards`.
        texture: ``[H, W, 4]`` linear RGB and alpha.
    """

    proxy: Proxy
    vertices: np.ndarray
    clearance: np.ndarray
    texture: np.ndarray

    def shadow(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what casts a shadow: vertices and triangles ``[K, 3]``."""
        return self.vertices, shadow_triangles(self.proxy, self.clearance, self.texture)


@dataclass(frozen=True)
class Dressing:
    """The assets of one identity; whatever is None is left to the built-in materials.

    Attributes:
        identity: Who wears them.
        chosen: Which assets; None without any.
        hair: The hair on this head.
        eyebrows: The brows on this head.
        iris: ``[3]`` linear RGB.
        tone: ``[3]`` factor on the skin's texture.
    """

    identity: Identity
    chosen: Chosen | None
    hair: Fitted | None
    eyebrows: Fitted | None
    iris: np.ndarray | None
    tone: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """Return what the identity's parameters say about assets."""
        return {} if self.chosen is None else {"assets": self.chosen.to_json()}

    def skin(self, built_in: Skin) -> Skin:
        """Return the skin of this identity."""
        if self.chosen is None or self.chosen.skin is None:
            return built_in
        return paint_skin(built_in, read_texture(self.chosen.skin.texture), self.identity, self.tone)

    def eye_colour(self, built_in: EyeColour) -> EyeColour:
        """Return the eyes' pattern of this identity."""
        return built_in if self.iris is None else built_in._replace(iris=self.iris)

    def cards(self, surface: Surface, occluders: Occluders) -> tuple[Cards, ...]:
        """Light the hair and the brows.

        Args:
            surface: The finished skin.
            occluders: What casts shadows, the hair included.
        """
        parts = []
        if self.hair is not None:
            hair, triangles = self.hair, split(self.hair.proxy.faces, self.hair.proxy.corner_uvs)[0]
            light = light_both_sides(hair.vertices, vertex_normals(hair.vertices, triangles), occluders)
            texture = recolour(hair.texture, np.array(HAIR_COLOURS[self.identity.hair_colour]))
            parts.append(make_cards(hair.proxy, hair.vertices, light, hair.clearance, texture))
        if self.eyebrows is not None:
            brows = self.eyebrows
            vertices, light = _on_skin(brows.vertices, surface)
            texture = recolour(brows.texture, brow_colour(self.identity))
            parts.append(make_cards(brows.proxy, vertices, light, np.ones(len(vertices)), texture))
        return tuple(parts)


def dress(
    folder: Path | None,
    identity: Identity,
    seed: int,
    body: np.ndarray,
    seat: Callable[[np.ndarray], np.ndarray],
) -> Dressing:
    """Choose and fit the assets of one identity.

    Args:
        folder: The user's assets; None for the built-in materials alone.
        identity: Whom to dress.
        seed: The studio's seed.
        body: ``[19158, 3]`` the identity's upright hm08 body, metres.
        seat: Moves points ``[V, 3]`` of the upright body to where the subject sits.

    Raises:
        UsageError: there are no assets in the folder.
        ArtifactError: a file that is broken.
    """
    rng = generator(seed, Stream.ASSETS, identity.index)
    tone = draw_tone(rng)
    if folder is None:
        return Dressing(identity, None, None, None, None, tone)
    chosen = choose(read_library(folder), identity, rng)
    eyes = np.mean([fit_sphere(body[slice(*EYE_RANGES[side])])[0] for side in EYE_RANGES], axis=0)

    def fitted(proxy: Proxy | None) -> Fitted | None:
        if proxy is None:
            return None
        upright = proxy.fit(body)
        texture = read_texture(next(iter(proxy.textures.values())))
        return Fitted(proxy, seat(upright), _clearance(upright - eyes), texture)

    iris = None
    if chosen.iris is not None:
        # Painted irises are more vivid than real ones.
        iris = 0.5 * (iris_colour(chosen.iris, body) + IRIS_COLOURS[identity.iris])
    return Dressing(identity, chosen, fitted(chosen.hair), fitted(chosen.eyebrows), iris, tone)


def _clearance(points: np.ndarray) -> np.ndarray:
    """Return how far points ``[V, 3]``, relative to the eyes, are from the space before the face; negative inside."""
    x, y, z = points.T
    side, (bottom, top), back = FACE_HALF_WIDTH, FACE_HEIGHTS, FACE_BACK
    return np.max([np.abs(x) - side, y - top, bottom - y, back - z], axis=0)


def _on_skin(vertices: np.ndarray, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Lift vertices ``[V, 3]`` out of the skin; return them and the skin's light there, on both sides ``[V, 2]``."""
    scene = raycasting_scene([(surface.vertices, surface.triangles)])
    closest = scene.compute_closest_points(vertices.astype(np.float32), nthreads=1)
    foot = closest["points"].numpy().astype(np.float64)
    outward = unit(closest["primitive_normals"].numpy().astype(np.float64))
    height = ((vertices - foot) * outward).sum(axis=1, keepdims=True)
    lifted = np.where(height < BROW_LIFT, foot + BROW_LIFT * outward, vertices)
    _, nearest = cKDTree(surface.vertices).query(vertices)
    light = surface.irradiance[nearest].mean(axis=1)
    return lifted, np.repeat(light[:, None], 2, axis=1)
