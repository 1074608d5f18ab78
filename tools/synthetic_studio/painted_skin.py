"""Skin and irises from the user's own painted textures."""

from dataclasses import replace

import cv2
import numpy as np

from synthetic_studio.assets import Iris
from synthetic_studio.eyes import IRIS_RADIUS
from synthetic_studio.identity import Identity
from synthetic_studio.regions import beard_mask, head_regions, scalp_mask
from synthetic_studio.skin import Skin
from synthetic_studio.template import EYE_RANGES, fit_sphere, painted_mask
from synthetic_studio.textures import read_texture, sample

PAINTED_LIGHT = 0.85  # a painted texture is a little brighter than an albedo: some light is painted in
TONE_SPREAD, TINT_SPREAD = 0.06, 0.02  # standard deviations of an identity's brightness and hue, relative
COARSE_SIDE = 1024  # texels along a texture that is too coarse to show pores
HIGH_PASS = 6.0  # texels of the built-in detail; what is wider than pores and freckles is painted already
SAFE_HAIRLINE = 0.014  # metres above the built-in hairline, where every hair style has hair
IRIS_RING = (0.55, 0.8)  # of the iris' radius, between the pupil and the dark rim
BRIGHTEST_IRIS = 0.25  # linear; brighter painted irises make no albedo


def draw_tone(rng: np.random.Generator) -> np.ndarray:
    """Draw an identity's own factor ``[3]`` on a painted texture."""
    return PAINTED_LIGHT * np.exp(rng.normal(0.0, TONE_SPREAD) + rng.normal(0.0, TINT_SPREAD, 3))


def paint_skin(skin: Skin, texture: np.ndarray, identity: Identity, tone: np.ndarray) -> Skin:
    """Return a skin that takes its colours from a texture, and its pores, gloss and shirt from ``skin``.

    Args:
        skin: The built-in skin of the identity.
        texture: ``[H, W, 4]`` linear RGB and alpha in hm08's layout.
        identity: Whose skin; hair and beard darken the skin below them.
        tone: ``[3]`` factor on the texture.
    """
    position = head_regions().position
    scalp = scalp_mask(position, identity.hairline + SAFE_HAIRLINE) * (1.0 - head_regions().ears)
    covered = 0.0 if identity.hair_style == "bald" else 0.75
    shade = np.maximum(covered * scalp, 0.45 * min(identity.stubble, 1.0) * beard_mask(position))
    return replace(
        skin,
        albedo=tone * (1.0 - shade[:, None]),
        detail=_pores_only(skin.detail, share=min(1.0, COARSE_SIDE / texture.shape[1])),
        painted=np.ascontiguousarray(texture[..., :3]),
    )


def iris_colour(iris: Iris, body: np.ndarray) -> np.ndarray:
    """Return the linear RGB ``[3]`` of painted irises, found in the texture at the front of the fitted left eyeball.

    Args:
        iris: Which eyes.
        body: ``[19158, 3]`` an upright hm08 body in metres, looking along z.
    """
    centre, _ = fit_sphere(body[slice(*EYE_RANGES["left"])])
    # One place in the texture per triangle corner; transparent ones belong to the cornea.
    points = iris.proxy.fit(body)[iris.proxy.faces.ravel()] - centre
    uvs, texture = iris.proxy.corner_uvs.reshape(-1, 2), read_texture(iris.texture)
    front = (np.hypot(points[:, 0], points[:, 1]) < 1.5 * IRIS_RADIUS) & (points[:, 2] > 0.0)
    front &= sample(texture, uvs)[:, 3] > 0.5
    design = np.column_stack([np.ones(front.sum()), points[front, :2]])
    middle, *uv_from_metres = np.linalg.lstsq(design, uvs[front], rcond=None)[0]
    angle, radius = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 64), IRIS_RADIUS * np.linspace(*IRIS_RING, 8))
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    colour = sample(texture, middle + ring @ uv_from_metres)[:, :3].mean(axis=0).astype(np.float64)
    return colour * min(1.0, BRIGHTEST_IRIS / max(colour.max(), 1e-6))


def _pores_only(detail: np.ndarray, share: float) -> np.ndarray:
    """Return the detail without the tints of lips and lids and with a ``share`` of its fine structure."""
    factor = detail[..., :3]
    fine = factor / cv2.GaussianBlur(factor, (0, 0), HIGH_PASS)
    lips = cv2.GaussianBlur(painted_mask("lips", (factor.shape[1], factor.shape[0])), (0, 0), 2.0 * HIGH_PASS)
    strength = share * (1.0 - np.clip(2.0 * lips, 0.0, 1.0))[..., None]
    return np.concatenate([1.0 + strength * (fine - 1.0), detail[..., 3:]], axis=2)
