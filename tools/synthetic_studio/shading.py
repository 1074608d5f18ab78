"""How skin, eyes and hair answer the studio's light: diffuse, specular and Fresnel terms in linear light.

Radiances are relative to a white diffuse surface under the surround and key, which has about 1.
"""

import cv2
import numpy as np

from synthetic_studio.eyes import shade_eye
from synthetic_studio.heads import Head, Surface
from synthetic_studio.lighting import FILL_DIRECTION, KEY_DIRECTION, studio_lights
from synthetic_studio.regions import head_regions
from synthetic_studio.skin import METRES_PER_TEXEL, TEXTURE_SIZE
from synthetic_studio.strands import unit
from synthetic_studio.template import full_uvs
from synthetic_studio.textures import pyramid, sample

SKIN_F0 = 0.028  # reflectance at normal incidence for an index of refraction of 1.4
SKIN_ROUGHNESS = 0.40
EYE_F0 = 0.025
SURROUND_RADIANCE = 0.62
KEY_PANEL_RADIANCE = 5.0  # what a mirror would show of the softbox
KEY_PANEL_TANGENT = 0.36
METRES_PER_UV = METRES_PER_TEXEL * TEXTURE_SIZE / 0.25  # about, on the face in hm08's texture layout


def interpolate(values: np.ndarray, corners: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Interpolate per-vertex ``values`` ``[V, C]`` at hits: ``corners`` ``[P, 3]``, barycentric ``uv`` ``[P, 2]``."""
    u, v = uv[:, :1], uv[:, 1:]
    table = values.astype(np.float32)
    return (1.0 - u - v) * table[corners[:, 0]] + u * table[corners[:, 1]] + v * table[corners[:, 2]]


class SkinShader:
    """Shades skin hits; holds the packed vertex table and the texture pyramid of one head."""

    def __init__(self, head: Head, corner_uvs: np.ndarray) -> None:
        surface, skin = head.surface, head.skin
        self._triangles = surface.triangles
        self._corner_uvs = corner_uvs
        columns = [surface.normals, skin.albedo, surface.irradiance, skin.gloss, surface.key_visibility]
        columns += [surface.openness, skin.shirt, head_regions().above_neckline]
        self._table = np.column_stack(columns).astype(np.float32)
        self._tangents = _tangent_frames(surface, corner_uvs)
        self._pyramid = [(skin.detail, skin.relief)]
        while len(self._pyramid) < 7:
            self._pyramid.append(tuple(cv2.pyrDown(level) for level in self._pyramid[-1]))
        self._painted = [] if skin.painted is None else pyramid(skin.painted)

    def normals(self, primitive: np.ndarray, uv: np.ndarray) -> np.ndarray:
        """Return smooth geometric normals ``[P, 3]`` at hits."""
        return unit(interpolate(self._table[:, :3], self._triangles[primitive], uv))

    def shade(
        self,
        primitive: np.ndarray,
        uv: np.ndarray,
        view: np.ndarray,
        footprint: float,
    ) -> np.ndarray:
        """Return radiance ``[P, 3]``.

        Args:
            primitive: ``[P]`` triangle indices.
            uv: ``[P, 2]`` barycentric coordinates.
            view: ``[P, 3]`` unit directions towards the camera.
            footprint: Width of one sample on the surface, metres; picks the texture level.
        """
        packed = interpolate(self._table, self._triangles[primitive], uv)
        normal = unit(packed[:, :3])
        albedo, irradiance = packed[:, 3:6], packed[:, 6:9]
        gloss, key_visibility, openness = packed[:, 9], packed[:, 10], packed[:, 11]
        cloth = np.clip(0.5 - packed[:, 15] / max(footprint, 5e-4), 0.0, 1.0)[:, None]
        if self._painted:
            albedo = albedo * self._painted_albedo(primitive, uv, footprint)
        detail, relief = self._texture(primitive, uv, footprint)
        tangent, bitangent = self._tangents[0][primitive], self._tangents[1][primitive]
        bumped = unit(normal - relief[:, :1] * tangent - relief[:, 1:] * bitangent)
        key = unit(KEY_DIRECTION).astype(np.float32)
        shading = 1.0 + 0.8 * ((bumped - normal) @ key)
        diffuse = albedo * detail[:, :3] * irradiance * shading[:, None]
        specular = key_visibility * _ggx(bumped, view, key, SKIN_ROUGHNESS, SKIN_F0) * _key_irradiance()
        fill = unit(FILL_DIRECTION).astype(np.float32)
        specular += 0.24 * openness * _ggx(bumped, view, fill, SKIN_ROUGHNESS, SKIN_F0) * _key_irradiance()
        # The rough surface blurs the surround; its grazing reflection is weaker than a mirror's.
        grazing = _fresnel(np.clip((bumped * view).sum(axis=1), 0.0, 1.0), SKIN_F0, ceiling=0.20)
        specular += grazing * openness * SURROUND_RADIANCE
        skin = diffuse + (gloss * detail[:, 3] * specular)[:, None]
        return (1.0 - cloth) * skin + cloth * packed[:, 12:15] * irradiance

    def _texture(
        self, primitive: np.ndarray, uv: np.ndarray, footprint: float
    ) -> tuple[np.ndarray, np.ndarray]:
        level = int(np.clip(np.log2(max(footprint / METRES_PER_TEXEL, 1.0)), 0, len(self._pyramid) - 1))
        detail, relief = self._pyramid[level]
        place = self._place(primitive, uv) * detail.shape[0] - 0.5
        sampled, slopes = (
            _remap(texture, place, fill)
            for texture, fill in ((detail, (1.0, 1.0, 1.0, 1.0)), (relief, (0.0, 0.0)))
        )
        return sampled, slopes

    def _painted_albedo(self, primitive: np.ndarray, uv: np.ndarray, footprint: float) -> np.ndarray:
        texel = METRES_PER_UV / self._painted[0].shape[0]
        level = int(np.clip(np.log2(max(footprint / texel, 1.0)), 0, len(self._painted) - 1))
        place = full_uvs(self._place(primitive, uv))
        return np.maximum(sample(self._painted[level], place, cv2.INTER_CUBIC), 0.0)

    def _place(self, primitive: np.ndarray, uv: np.ndarray) -> np.ndarray:
        """Return column and row ``[P, 2]`` in the face's texture, 0..1 inside it."""
        corner = self._corner_uvs[primitive]
        u, v = uv[:, :1], uv[:, 1:]
        return (1.0 - u - v) * corner[:, 0] + u * corner[:, 1] + v * corner[:, 2]


def shade_eyes(head: Head, side: str, primitive: np.ndarray, uv: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Return radiance ``[P, 3]`` at hits of one eyeball, with the softbox mirrored in the cornea."""
    surface = head.eye_surfaces[side]
    corners = surface.triangles[primitive]
    table = np.concatenate(
        [surface.irradiance, surface.key_visibility[:, None], surface.openness[:, None]], axis=1
    )
    light = interpolate(table, corners, uv)
    outward = unit(interpolate(surface.normals, corners, uv))
    albedo, mirror = shade_eye(head.eye_colour, head.eyeballs[side], outward.astype(np.float64))
    reflected = 2.0 * (mirror * view).sum(axis=1, keepdims=True) * mirror - view
    fresnel = _fresnel(np.clip((mirror * view).sum(axis=1), 0.0, 1.0), EYE_F0, ceiling=1.0)
    panel = _softbox(reflected) * KEY_PANEL_RADIANCE * light[:, 3]
    surround = SURROUND_RADIANCE * np.where(reflected[:, 1] < -0.3, 0.35, 1.0) * light[:, 4]
    # The lids' wet rim and the lens darken what lies behind the cornea a little.
    return (albedo * light[:, :3] + (fresnel * (panel + surround))[:, None]).astype(np.float32)


class StrandShader:
    """Shades hair with Kajiya and Kay's diffuse law (baked) and two highlights after Marschner et al. (2003)."""

    def __init__(self, head: Head) -> None:
        strands = head.strands
        count, length, _ = strands.points.shape
        self._triangles = head.ribbon_triangles
        self._length = length
        self._tangents = strands.tangents().reshape(-1, 3).astype(np.float32)
        self._light = strands.light.reshape(-1, 1).astype(np.float32)
        self._colour = strands.colour.astype(np.float32)
        self._outward = strands.outward.astype(np.float32)
        self._phase = np.modf(np.arange(count) * 0.6180339887)[0].astype(np.float32)

    def normals(self, primitive: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Return the ribbons' roots' normals, turned towards the camera: ``[P, 3]``."""
        outward = self._outward[self._strand(primitive)]
        return outward * np.where((outward * view).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0).astype(
            np.float32
        )

    def shade(self, primitive: np.ndarray, uv: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Return radiance ``[P, 3]`` at hits of ribbons."""
        corners = self._triangles[primitive]
        strand = self._strand(primitive)
        tangent = unit(interpolate(self._tangents, corners // 2, uv))
        light = interpolate(self._light, corners // 2, uv)
        across = interpolate(np.array([[0.0], [1.0]]), corners % 2, uv)[:, 0]
        # A ribbon stands for a few hairs: brightness varies across it, more so along its edges.
        fibres = 1.0 + 0.22 * np.cos(2.0 * np.pi * (2.5 * across + 7.0 * self._phase[strand]))
        colour = self._colour[strand]
        key = unit(KEY_DIRECTION).astype(np.float32)
        half = unit(view + key)
        outward = self._outward[strand]
        primary = _highlight(unit(tangent + 0.12 * outward), half, 70.0)
        secondary = _highlight(unit(tangent - 0.16 * outward), half, 16.0)
        gloss = 0.055 * primary[:, None] + 0.9 * np.sqrt(colour) * 0.16 * secondary[:, None]
        return light * fibres[:, None] * (colour * 1.25 + gloss)

    def _strand(self, primitive: np.ndarray) -> np.ndarray:
        return primitive // (2 * (self._length - 1))


def _highlight(tangent: np.ndarray, half: np.ndarray, exponent: float) -> np.ndarray:
    cosine = (tangent * half).sum(axis=1)
    return np.maximum(0.0, 1.0 - cosine * cosine) ** (0.5 * exponent)


def _ggx(
    normal: np.ndarray,
    view: np.ndarray,
    light: np.ndarray,
    roughness: float,
    f0: float,
) -> np.ndarray:
    """Cook-Torrance reflection times the cosine, with the GGX distribution (Walter et al. 2007, eq. 33)."""
    half = unit(view + light)
    n_h = np.clip((normal * half).sum(axis=1), 0.0, 1.0)
    n_v = np.clip((normal * view).sum(axis=1), 0.05, 1.0)
    n_l = np.clip(normal @ light, 0.0, 1.0)
    alpha2 = roughness**4
    distribution = alpha2 / (np.pi * (n_h * n_h * (alpha2 - 1.0) + 1.0) ** 2)
    # Height-correlated Smith masking, Hammon's approximation (2017).
    masking = 0.5 / (0.5 * (2.0 * n_l * n_v) + 0.5 * (n_l + n_v) * 0.5 + 0.25)
    fresnel = _fresnel(np.clip((view * half).sum(axis=1), 0.0, 1.0), f0, ceiling=1.0)
    return distribution * masking * fresnel * n_l


def _fresnel(cosine: np.ndarray, f0: float, ceiling: float) -> np.ndarray:
    """Schlick's approximation (1994), levelling off at ``ceiling`` for rough surfaces."""
    return f0 + (ceiling - f0) * (1.0 - cosine) ** 5


def _key_irradiance() -> float:
    lights = studio_lights()
    return float(np.pi * lights.weights[lights.is_key].sum())


def _softbox(direction: np.ndarray) -> np.ndarray:
    """Return 1 where ``direction`` ``[P, 3]`` meets the square key panel, with a soft edge."""
    forward = unit(KEY_DIRECTION)
    right = unit(np.cross([0.0, 1.0, 0.0], forward))
    up = np.cross(forward, right)
    depth = np.maximum(direction @ forward, 1e-6)
    offset = np.maximum(np.abs(direction @ right), np.abs(direction @ up)) / depth
    return np.clip((KEY_PANEL_TANGENT - offset) / 0.04 + 0.5, 0.0, 1.0)


def _tangent_frames(surface: Surface, corner_uvs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return per triangle the unit directions in which the texture's columns and rows grow: two ``[T, 3]``."""
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    (u1, v1), (u2, v2) = (corner_uvs[:, 1] - corner_uvs[:, 0]).T, (corner_uvs[:, 2] - corner_uvs[:, 0]).T
    determinant = u1 * v2 - u2 * v1
    safe = np.where(np.abs(determinant) < 1e-14, 1.0, determinant)[:, None]
    tangent = (v2[:, None] * (b - a) - v1[:, None] * (c - a)) / safe
    bitangent = (u1[:, None] * (c - a) - u2[:, None] * (b - a)) / safe
    return unit(tangent).astype(np.float32), unit(bitangent).astype(np.float32)


def _remap(texture: np.ndarray, place: np.ndarray, fill: tuple[float, ...]) -> np.ndarray:
    """Sample a texture bilinearly at ``place`` ``[P, 2]`` (column, row), with ``fill`` outside."""
    # cv2.remap wants maps with fewer than 32,768 columns and rows.
    width = 4096
    rows = -(-len(place) // width)
    padded = np.full((rows * width, 2), -10.0, np.float32)
    padded[: len(place)] = place
    maps = padded.reshape(rows, width, 2)
    sampled = cv2.remap(
        texture, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=fill
    )
    return sampled.reshape(-1, texture.shape[2])[: len(place)]
