"""Skin: colour from melanin and blood, and a detail texture of the face with freckles, pores and lips."""

from dataclasses import dataclass

import cv2
import numpy as np

from synthetic_studio.identity import HAIR_COLOURS, Identity
from synthetic_studio.regions import beard_mask, head_regions, scalp_mask, smoothstep
from synthetic_studio.template import painted_mask

TEXTURE_SIZE = 1536
# Linear sRGB albedo of skin from pale to dark, after the spread of measured diffuse reflectances.
SKIN_MELANIN = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
SKIN_ALBEDO = np.array(
    [[0.72, 0.47, 0.37], [0.60, 0.36, 0.26], [0.40, 0.21, 0.135], [0.21, 0.105, 0.065], [0.085, 0.045, 0.030]]
)
BLOOD = np.array([0.10, -0.22, -0.20])  # relative change of albedo where blood shows
METRES_PER_TEXEL = 0.16 / (0.17 / 0.25 * TEXTURE_SIZE)


@dataclass(frozen=True)
class Skin:
    """Colour and relief of one identity's skin.

    Attributes:
        albedo: ``[V, 3]`` linear RGB per fine vertex.
        gloss: ``[V]`` strength of the specular reflection per fine vertex, 1 for ordinary skin.
        detail: ``[T, T, 4]`` float32 over the face's texture: RGB factor on the albedo, and factor on the gloss.
        relief: ``[T, T, 2]`` float32 slope of the surface along the texture's columns and rows.
        shirt: ``[V, 3]`` linear RGB of the cloth per fine vertex, where the shirt covers the skin.
        painted: ``[H, W, 3]`` float32 linear RGB in hm08's texture layout, on which ``albedo`` is then a factor.
    """

    albedo: np.ndarray
    gloss: np.ndarray
    detail: np.ndarray
    relief: np.ndarray
    shirt: np.ndarray
    painted: np.ndarray | None = None


def make_skin(identity: Identity, rng: np.random.Generator) -> Skin:
    """Paint one identity's skin from its random stream."""
    regions = head_regions()
    base = base_albedo(identity.melanin)
    albedo = np.broadcast_to(base, regions.position.shape).copy()
    pale = 1.0 - 0.75 * identity.melanin
    blood = identity.redness * pale * (0.9 * regions.cheeks + 0.9 * regions.nose + 0.8 * regions.ears)
    albedo *= 1.0 + blood[:, None] * BLOOD + 0.05 * _solid_noise(regions.position, 0.018, rng)[:, None]
    albedo *= 1.0 - (0.16 * regions.eye_sockets)[:, None] * np.array([0.8, 1.0, 0.7])
    hair = _hair_cover(identity, regions.position)
    albedo = (1.0 - hair) * albedo + hair * (
        0.6 * np.array(HAIR_COLOURS[identity.hair_colour]) + 0.12 * albedo
    )
    gloss = 1.0 + 0.5 * regions.nose + 0.45 * regions.forehead + 0.25 * regions.cheeks
    gloss *= 1.0 - 0.85 * hair[:, 0]
    detail, relief = _face_texture(identity, rng)
    weave = 1.0 + 0.08 * _solid_noise(regions.position, 0.006, rng)
    return Skin(
        np.clip(albedo, 0.005, 0.9), gloss, detail, relief, np.array(identity.garment) * weave[:, None]
    )


def base_albedo(melanin: float) -> np.ndarray:
    """Return the linear RGB albedo ``[3]`` of unblemished skin for ``melanin`` in 0..1."""
    return np.array([np.interp(melanin, SKIN_MELANIN, SKIN_ALBEDO[:, c]) for c in range(3)])


def _hair_cover(identity: Identity, position: np.ndarray) -> np.ndarray:
    """Return how much of the skin ``[V, 1]`` thin hairs cover, between the strands of scalp hair and beard."""
    cover = {"bald": 0.10, "buzz": 0.88}.get(identity.hair_style, 0.92)
    scalp = cover * scalp_mask(position, identity.hairline + 0.002) * (1.0 - head_regions().ears)
    beard = 0.55 * min(identity.stubble, 1.0) * beard_mask(position)
    return np.maximum(scalp, beard)[:, None]


def _face_texture(identity: Identity, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    size = (TEXTURE_SIZE, TEXTURE_SIZE)
    lips = cv2.GaussianBlur(painted_mask("lips", size), (0, 0), 4.0)
    lids = cv2.GaussianBlur(painted_mask("eyelids", size), (0, 0), 10.0)
    inside = _border_fade()
    pores = _band_noise(rng, 0.00045) * (1.0 - lips)
    mottle = 0.6 * _band_noise(rng, 0.0025) + 0.4 * _band_noise(rng, 0.008)
    spots = _spots(identity, rng) * (1.0 - lips) * inside

    pale = 1.0 - 0.7 * identity.melanin
    factor = np.ones((*size, 4), np.float32)
    tint = (0.035 * pores + 0.045 * mottle) * inside
    factor[..., :3] += tint[..., None] * np.array([0.7, 1.1, 1.1], np.float32)
    factor[..., :3] *= 1.0 - spots[..., None] * np.array([0.30, 0.48, 0.55], np.float32)
    lip_tint = np.array(
        [0.92 - 0.10 * pale, 0.58 - 0.14 * pale * identity.redness, 0.62 - 0.10 * pale], np.float32
    )
    creases = 1.0 + 0.10 * _band_noise(rng, 0.0007, stretch=5.0)
    factor[..., :3] *= 1.0 + lips[..., None] * (lip_tint * creases[..., None] - 1.0)
    factor[..., :3] *= 1.0 + lids[..., None] * np.array([-0.10, -0.20, -0.16], np.float32) * pale
    factor[..., 3] = (1.0 + 0.25 * pores * inside) * (1.0 + 0.7 * lips)

    age = identity.phenotypes["age"]
    height = 7e-6 * pores + (1.2e-5 + 1.2e-4 * max(0.0, age - 0.75)) * _band_noise(rng, 0.0013)
    height = (height + 3e-5 * lips * (creases - 1.0) * 10.0) * inside
    relief = np.stack([np.gradient(height, axis=1), np.gradient(height, axis=0)], axis=-1) / METRES_PER_TEXEL
    return np.clip(factor, 0.1, 2.0), relief.astype(np.float32)


def _spots(identity: Identity, rng: np.random.Generator) -> np.ndarray:
    """Scatter freckles (many, faint, over nose and cheeks) and a few moles."""
    image = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE), np.float32)
    freckles = int(900 * identity.freckles)
    moles = int(rng.poisson(5))
    for k in range(freckles + moles):
        mole = k >= freckles
        spread = (0.30, 0.30) if mole else (0.13, 0.22)
        u, v = (
            np.clip(rng.normal((0.72, 0.5), spread), 0.02, 0.98)
            if mole
            else np.clip(rng.normal((0.62, 0.5), spread), 0.02, 0.98)
        )
        radius = rng.uniform(0.0006, 0.0014) if mole else rng.uniform(0.0004, 0.0011)
        strength = rng.uniform(0.8, 1.2) if mole else rng.uniform(0.25, 0.7)
        centre = (int(u * TEXTURE_SIZE * 16), int(v * TEXTURE_SIZE * 16))
        stamp = int(max(1.0, radius / METRES_PER_TEXEL) * 16)
        cv2.circle(image, centre, stamp, float(strength), -1, cv2.LINE_AA, shift=4)
    return cv2.GaussianBlur(image, (0, 0), 2.0)


def _border_fade() -> np.ndarray:
    """Return 1 inside the face's texture and 0 at its border, where plain vertex colours take over."""
    ramp = np.minimum(np.arange(TEXTURE_SIZE), np.arange(TEXTURE_SIZE)[::-1]) / (0.08 * TEXTURE_SIZE)
    ramp = smoothstep(0.0, 1.0, ramp)
    return np.minimum(ramp[:, None], ramp[None, :]).astype(np.float32)


def _band_noise(rng: np.random.Generator, wavelength: float, stretch: float = 1.0) -> np.ndarray:
    """Return texture noise of unit deviation around one wavelength in metres, stretched along the rows."""
    sigma = max(0.35 * wavelength / METRES_PER_TEXEL, 0.6)
    shrink = max(1, int(sigma // 2))
    side = -(-TEXTURE_SIZE // shrink)
    white = rng.standard_normal((side, side)).astype(np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), sigmaX=stretch * sigma / shrink, sigmaY=sigma / shrink)
    coarse = cv2.GaussianBlur(white, (0, 0), sigmaX=2 * stretch * sigma / shrink, sigmaY=2 * sigma / shrink)
    band = smooth - coarse
    band /= band.std()
    return cv2.resize(band, (TEXTURE_SIZE, TEXTURE_SIZE), interpolation=cv2.INTER_CUBIC)


def _solid_noise(position: np.ndarray, wavelength: float, rng: np.random.Generator) -> np.ndarray:
    """Return smooth noise ``[V]`` of about unit deviation as a sum of random plane waves; it has no seams."""
    waves = rng.normal(0.0, 2.0 * np.pi / wavelength, (32, 3))
    phases = rng.uniform(0.0, 2.0 * np.pi, 32)
    return np.cos(position @ waves.T + phases).sum(axis=1) / 4.0
