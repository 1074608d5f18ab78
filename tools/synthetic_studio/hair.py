"""Scalp hair: guide strands grown over the head by style, and the many strands between them.

A few hundred guides follow a combing direction, gravity and the head's surface; every strand blends its
three nearest guides, with clumping and frizz, so the hair looks combed rather than scattered.
"""

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from synthetic_studio.identity import HAIR_COLOURS, Identity
from synthetic_studio.raycasting import raycasting_scene
from synthetic_studio.regions import SurfacePoints, coarse_ear_mask, eye_midpoint, scalp_mask, smoothstep
from synthetic_studio.strands import Strands, resample, unit
from synthetic_studio.template import HeadTemplate

GUIDE_COUNT = 900
GUIDE_POINTS = 18
STRAND_POINTS = 12
# Points lie denser near the root, where hair leaves the skin and bends over.
POINT_SPACING = np.diff(np.linspace(0.0, 1.0, GUIDE_POINTS) ** 1.7)
FALL = np.array([0.0, -1.0, -0.12])  # hair falls a little behind the shoulders rather than before the face
FRONT_BACKWARDS = 0.8  # extra backward combing at the forehead, for hair long enough to hang into the face


@dataclass(frozen=True)
class Style:
    """How hair grows and falls.

    Attributes:
        strands: Number of strands.
        width: Ribbon width in metres; a ribbon stands for a small lock of hairs.
        top, side: Length in metres on the crown and at the sides and nape.
        comb: Weights of the combing directions: backwards, sideways from the parting, forwards, down.
        lift: Weight of the outward normal at the root.
        gravity: Weight of the pull downwards along the strand.
        volume: Height in metres of the outermost strands over the skin.
        curl: Radius in metres and turns per metre of curls.
        frizz: Random displacement in metres at the tip.
        parting: Where the parting lies, metres from the middle (the subject's left is positive).
    """

    strands: int
    width: float
    top: float
    side: float
    comb: tuple[float, float, float, float]
    lift: float
    gravity: float
    volume: float
    curl: tuple[float, float] = (0.0, 0.0)
    frizz: float = 0.002
    parting: float = 0.0


STYLES = {
    "buzz": Style(26000, 0.00042, 0.006, 0.004, (0.1, 0.0, 0.5, 0.3), 0.9, 0.0, 0.005, frizz=0.001),
    "short": Style(24000, 0.0005, 0.030, 0.013, (0.1, 0.35, 0.5, 0.25), 0.5, 0.05, 0.012, parting=0.03),
    "side_part": Style(24000, 0.0005, 0.070, 0.026, (0.45, 0.9, 0.0, 0.2), 0.3, 0.12, 0.014, parting=0.035),
    "slick_back": Style(24000, 0.0005, 0.100, 0.050, (1.0, 0.1, 0.0, 0.15), 0.2, 0.08, 0.010, frizz=0.0015),
    "bob": Style(28000, 0.00055, 0.230, 0.150, (0.45, 0.75, 0.0, 0.35), 0.15, 1.1, 0.014, parting=0.01),
    "long": Style(30000, 0.00055, 0.400, 0.330, (0.45, 0.65, 0.0, 0.4), 0.15, 1.1, 0.015, (0.004, 14.0)),
    "bun": Style(24000, 0.0005, 0.190, 0.150, (1.0, 0.0, 0.0, -0.15), 0.12, 0.0, 0.008, frizz=0.001),
    "curly": Style(
        30000, 0.0005, 0.080, 0.055, (0.1, 0.2, 0.0, 0.1), 1.2, 0.06, 0.055, (0.0045, 60.0), 0.003
    ),
}


def grow_hair(
    identity: Identity,
    template: HeadTemplate,
    vertices: np.ndarray,
    eyes: np.ndarray,
    rng: np.random.Generator,
) -> tuple[Strands, Strands] | None:
    """Grow the scalp hair of one identity.

    Args:
        identity: Whose hair; its style, colour, length and hairline are used.
        template: The head template.
        vertices: ``[V, 3]`` coarse skin of the identity, metres, before the head is posed.
        eyes: ``[3]`` midpoint of the eyeballs.
        rng: Random stream of the identity's hair.

    Returns:
        All strands, with no light yet, and the guides they blend; None for a bald head.
    """
    if identity.hair_style == "bald":
        return None
    style = STYLES[identity.hair_style]
    parting = style.parting * (1.0 if identity.index % 2 else -1.0)
    roots, average_roots = sample_scalp(template, identity.hairline, GUIDE_COUNT + style.strands, rng)
    root = roots.at(vertices, template.coarse_triangles)
    crown = smoothstep(0.030, 0.085, average_roots[:, 1])
    length = identity.hair_length * (style.side + (style.top - style.side) * crown)
    length *= rng.uniform(0.85, 1.0, len(length))
    guides, outward = _grow_guides(
        style, parting, root[:GUIDE_COUNT], length[:GUIDE_COUNT], vertices, template, rng
    )

    shape = guides - guides[:, :1]
    blend, nearest = _nearest_guides(root, shape)
    children = root[GUIDE_COUNT:]
    rescale = length[GUIDE_COUNT:] / (blend * length[nearest]).sum(axis=1)
    points = np.einsum("sg,sgkc->skc", blend, shape[nearest]) * np.clip(rescale, 0.6, 1.3)[:, None, None]
    points = children[:, None] + resample(points, STRAND_POINTS)
    points = _curl_and_frizz(points, style, rng)
    normals = unit(np.einsum("sg,sgc->sc", blend, outward[nearest]))
    colour = _strand_colours(identity, len(points), rng)
    strands = Strands(
        points, normals, style.width * rng.uniform(0.7, 1.2, len(points)), colour, np.ones(points.shape[:2])
    )
    if identity.hair_style == "bun":
        strands = _with_bun(strands, style, vertices, eyes, rng)
    strands = _keep_face_free(strands, identity, eyes)
    guide_strands = Strands(
        resample(guides, STRAND_POINTS),
        outward,
        np.full(GUIDE_COUNT, style.width),
        colour[:GUIDE_COUNT],
        np.ones((GUIDE_COUNT, STRAND_POINTS)),
    )
    return strands, guide_strands


def shadow_casters(strands: Strands) -> Strands:
    """Return every sixth strand, wider: hair as shadow rays see it, at a fraction of the cost."""
    return Strands(
        strands.points[::6],
        strands.outward[::6],
        3.0 * strands.width[::6],
        strands.colour[::6],
        strands.light[::6],
    )


def light_from_guides(strands: Strands, guides: Strands, guide_light: np.ndarray) -> np.ndarray:
    """Spread the guides' baked light ``[G, K]`` to all strands ``[S, K]`` by distance in space."""
    tree = cKDTree(guides.points.reshape(-1, 3))
    distance, index = tree.query(strands.points.reshape(-1, 3), k=4)
    weight = 1.0 / (distance + 2e-3)
    light = (weight * guide_light.ravel()[index]).sum(axis=1) / weight.sum(axis=1)
    return light.reshape(strands.points.shape[:2])


def sample_scalp(
    template: HeadTemplate, hairline: float, count: int, rng: np.random.Generator
) -> tuple[SurfacePoints, np.ndarray]:
    """Scatter ``count`` roots evenly over the scalp of the average head; return them and their positions there."""
    average = template.average[: template.skin_vertex_count] - eye_midpoint(template)
    corners = average[template.coarse_triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    density = scalp_mask(corners.mean(axis=1), hairline - 0.01)
    candidates = 3 * count
    triangle = rng.choice(len(area), size=candidates, p=area * (density > 0) / (area * (density > 0)).sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), size=candidates)
    points = SurfacePoints(triangle, weights)
    position = points.at(average, template.coarse_triangles)
    ear = points.at(coarse_ear_mask()[:, None], template.coarse_triangles)[:, 0]
    kept = np.flatnonzero(rng.random(candidates) < scalp_mask(position, hairline) * (ear < 0.5))[:count]
    return SurfacePoints(triangle[kept], weights[kept]), position[kept]


def _nearest_guides(root: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return blending weights ``[S, 3]`` and guides ``[S, 3]`` of every strand; a parting is never blended across."""
    distance, nearest = cKDTree(root[: len(shape)]).query(root[len(shape) :], k=3)
    blend = 1.0 / (distance + 1e-3) ** 2
    fall = unit(shape[:, len(shape[0]) // 2])
    blend *= (fall[nearest] * fall[nearest[:, :1]]).sum(axis=-1) > 0.8
    return blend / blend.sum(axis=1, keepdims=True), nearest


def _grow_guides(
    style: Style,
    parting: float,
    root: np.ndarray,
    length: np.ndarray,
    vertices: np.ndarray,
    template: HeadTemplate,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate guides ``[G, K, 3]`` over the head; also return the outward normals ``[G, 3]`` at their roots."""
    scene = raycasting_scene([(vertices, template.coarse_triangles)])
    _, normal, _ = _closest(scene, root)
    outward = normal
    layer = rng.uniform(0.15, 1.0, (len(root), 1)) * style.volume
    comb = _comb(style, parting, root, rng)
    point, direction = root.copy(), unit(style.lift * normal + _tangential(comb, normal))
    guides = [point]
    for k in range(1, GUIDE_POINTS):
        step = (POINT_SPACING[k - 1] * length)[:, None]
        travelled = POINT_SPACING[:k].sum()
        pull = style.gravity * (0.3 + travelled) * FALL
        lift = style.lift * max(0.0, 1.0 - 2.5 * travelled) * normal
        direction = unit(
            0.9 * direction + 0.5 * _tangential(comb, normal) * (1.0 - travelled) + pull + 0.4 * lift
        )
        point = point + step * direction
        closest, normal, height = _closest(scene, point)
        floor = np.minimum(layer, travelled * length[:, None])
        low = height < floor
        pushed = np.where(low, closest + floor * normal, point)
        high = (height > 1.3 * layer) & (style.gravity < 0.3)
        pushed = np.where(high & (style.lift < 1.0), point - 0.5 * (height - 1.3 * layer) * normal, pushed)
        direction = unit(pushed - guides[-1])
        point = guides[-1] + step * direction
        guides.append(point)
    return _relaxed(np.stack(guides, axis=1)), outward


def _relaxed(guides: np.ndarray) -> np.ndarray:
    """Take out the kinks that collisions leave, root kept: three rounds of averaging along each guide."""
    for _ in range(3):
        guides[:, 1:-1] = 0.25 * guides[:, :-2] + 0.5 * guides[:, 1:-1] + 0.25 * guides[:, 2:]
    return guides


def _closest(
    scene: o3d.t.geometry.RaycastingScene, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the closest surface point, the outward direction there and the signed height above it."""
    answer = scene.compute_closest_points(point.astype(np.float32), nthreads=1)
    closest = answer["points"].numpy().astype(np.float64)
    normal = unit(answer["primitive_normals"].numpy().astype(np.float64))
    offset = point - closest
    height = np.linalg.norm(offset, axis=1, keepdims=True)
    sign = np.where((offset * normal).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    return closest, normal, sign * height


def _comb(style: Style, parting: float, root: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    back, sideways, forward, down = style.comb
    away = np.tanh((root[:, 0] - parting) / 0.012)
    comb = np.zeros_like(root)
    comb[:, 0] = sideways * away
    comb[:, 1] = -down
    front = smoothstep(-0.075, -0.020, root[:, 2]) if style.gravity > 0.3 else 0.0
    comb[:, 2] = forward - back - FRONT_BACKWARDS * front
    return comb + rng.normal(0.0, 0.06, root.shape)


def _tangential(vector: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return vector - (vector * normal).sum(axis=-1, keepdims=True) * normal


def _curl_and_frizz(points: np.ndarray, style: Style, rng: np.random.Generator) -> np.ndarray:
    count, length, _ = points.shape
    along = np.linspace(0.0, 1.0, length)[None, :, None]
    random = rng.normal(0.0, 1.0, (count, 2, 3))
    points = points + style.frizz * (
        random[:, :1] * along + 0.5 * random[:, 1:] * np.sin(2.5 * np.pi * along)
    )
    radius, turns = style.curl
    if radius == 0.0:
        return points
    travelled = np.linalg.norm(np.diff(points, axis=1, prepend=points[:, :1]), axis=2).cumsum(axis=1)[
        ..., None
    ]
    tangent = unit(np.gradient(points, axis=1))
    first = unit(np.cross(tangent, [0.3, 0.9, 0.2]))
    second = np.cross(tangent, first)
    phase = 2.0 * np.pi * (turns * travelled + rng.random((count, 1, 1)))
    grown = np.minimum(1.0, travelled / 0.02)
    return points + radius * grown * (np.cos(phase) * first + np.sin(phase) * second)


def _strand_colours(identity: Identity, count: int, rng: np.random.Generator) -> np.ndarray:
    base = np.array(HAIR_COLOURS[identity.hair_colour])
    lightness = np.exp(rng.normal(0.0, 0.22, (count, 1)))
    colour = base * lightness
    if identity.hair_colour == "grey":
        dark = rng.random((count, 1)) < 0.35
        colour = np.where(dark, 0.2 * colour, colour)
    return np.clip(colour, 0.004, 0.8)


def _with_bun(
    strands: Strands,
    style: Style,
    vertices: np.ndarray,
    eyes: np.ndarray,
    rng: np.random.Generator,
) -> Strands:
    """Gather the ends at the back of the head and wind a bun of great circles there."""
    back = vertices[np.argmin(np.where(vertices[:, 1] > eyes[1], vertices[:, 2], np.inf))]
    centre = back + np.array([-back[0], 0.035, -0.018])
    radius = 0.030
    gather = smoothstep(0.45, 1.0, np.linspace(0.0, 1.0, STRAND_POINTS))[None, :, None]
    points = strands.points + gather * (centre - strands.points)
    count = 5000
    axis, start = unit(rng.normal(0.0, 1.0, (2, count, 3)))
    axis = unit(axis * [0.45, 0.45, 1.0])
    start = unit(np.cross(axis, start))
    angle = np.linspace(0.0, 1.6, STRAND_POINTS)[None, :, None]
    arc = np.cos(angle) * start[:, None] + np.sin(angle) * np.cross(axis, start)[:, None]
    bun = centre + radius * rng.uniform(0.8, 1.02, (count, 1, 1)) * arc * [1.0, 1.0, 0.8]
    return Strands(
        np.concatenate([points, bun]),
        np.concatenate([strands.outward, unit(arc[:, STRAND_POINTS // 2])]),
        np.concatenate([strands.width, np.full(count, style.width)]),
        np.concatenate([strands.colour, strands.colour[rng.integers(0, len(strands), count)]]),
        np.ones((len(points) + count, STRAND_POINTS)),
    )


def _keep_face_free(strands: Strands, identity: Identity, eyes: np.ndarray) -> Strands:
    """Cut every strand where it would hang before the face: hair frames the eyes, it never covers them."""
    relative = strands.points - eyes
    x, y, z = np.moveaxis(relative, -1, 0)
    below = np.clip((identity.hairline - 0.012 - y) / 0.03, 0.0, 1.0)
    limit = 0.050 + 0.022 * (1.0 - below)
    inside = (np.abs(x) < limit) & (y < identity.hairline - 0.012) & (y > -0.2) & (z > -0.045)
    first = np.where(inside.any(axis=1), inside.argmax(axis=1), STRAND_POINTS)
    last = np.minimum(np.arange(STRAND_POINTS)[None, :], np.maximum(first - 1, 0)[:, None])
    points = np.take_along_axis(strands.points, last[..., None], axis=1)
    kept = first > 1
    return Strands(
        points[kept], strands.outward[kept], strands.width[kept], strands.colour[kept], strands.light[kept]
    )
