"""One identity as geometry and appearance, built once and then seen by every camera."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from synthetic_studio.cards import Cards
from synthetic_studio.dressing import dress
from synthetic_studio.eyes import Eyeball, EyeColour, eye_colour, eyeball_mesh
from synthetic_studio.facial_hair import grow_beard, grow_eyebrows, grow_eyelashes
from synthetic_studio.hair import grow_hair, light_from_guides, shadow_casters
from synthetic_studio.identity import Identity, sample_identity
from synthetic_studio.landmarks import facemesh_landmarks, keypoints
from synthetic_studio.lighting import Occluders, bake_strands, bake_surface
from synthetic_studio.raycasting import raycasting_scene
from synthetic_studio.regions import head_regions, smoothstep
from synthetic_studio.skin import Skin, make_skin
from synthetic_studio.strands import Strands, concatenate, ribbons, unit
from synthetic_studio.streams import Stream, generator
from synthetic_studio.subdivision import triangulate, vertex_normals
from synthetic_studio.template import HeadTemplate, head_template

HEAD_CENTRE_FROM_EYES = np.array([0.0, -0.030, 0.020])  # about the mean of the five keypoints
GAZE_DISTANCE = 1.5  # metres; the eyes converge on a point in front of the face
INTERREFLECTION = 0.05  # light that reaches nostrils and the inside of the mouth by bouncing
# Light scatters under the skin: red furthest. Rounds of averaging over neighbours on the fine mesh.
SCATTER_ROUNDS = (10, 4, 2)


@dataclass(frozen=True)
class Surface:
    """A smooth closed part: its vertices, triangles, normals and baked light."""

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    irradiance: np.ndarray
    key_visibility: np.ndarray
    openness: np.ndarray


@dataclass(frozen=True)
class Head:
    """Everything that a camera can see of one identity, in the studio's frame (metres).

    Attributes:
        parameters: What the identity was made from, as JSON values.
        keypoints: The five canonical keypoints by name, ``[3]`` each.
        landmarks: Points on the surface by name, ``[3]`` each.
        surface: The skin and shirt at the finest level.
        skin: Colours and textures of the skin.
        eyeballs: "right" and "left", in the order of their geometry ids.
        eye_surfaces: Their surfaces.
        eye_colour: Pattern of the irises.
        strands: Scalp hair, brows, lashes and beard.
        ribbon_triangles: ``[T, 3]`` of the strands' ribbons.
        cards: Hair and brows of the user's own assets, which the scene does not have.
        scene: The ray caster; geometry ids 0 skin, 1 and 2 eyes, 3 strands.
    """

    parameters: dict[str, Any]
    keypoints: dict[str, np.ndarray]
    landmarks: dict[str, np.ndarray]
    surface: Surface
    skin: Skin
    eyeballs: dict[str, Eyeball]
    eye_surfaces: dict[str, Surface]
    eye_colour: EyeColour
    strands: Strands
    ribbon_triangles: np.ndarray
    cards: tuple[Cards, ...]
    scene: o3d.t.geometry.RaycastingScene


def build_head(seed: int, index: int, assets: Path | None = None) -> Head:
    """Build one identity of the studio.

    Args:
        seed: The studio's seed.
        index: The identity's number, from 0.
        assets: Unpacked MakeHuman assets of the user's own, or None for the built-in materials.
    """
    template = head_template()
    identity = sample_identity(seed, index)
    body = template.body(identity.phenotypes, identity.controls, identity.actions)
    seat = partial(_seat, upright=body[template.kept], identity=identity, template=template)
    vertices = seat(body[template.kept])
    dressing = dress(assets, identity, seed, body, seat)
    coarse = vertices[: template.skin_vertex_count]
    coarse_normals = vertex_normals(coarse, template.coarse_triangles)
    eye_midpoint = np.mean([template.eyeball(vertices, side)[0] for side in ("left", "right")], axis=0)

    rng = generator(seed, Stream.HAIR, index)
    grown = None if dressing.hair else grow_hair(identity, template, coarse, eye_midpoint, rng)
    facial = [
        *([] if dressing.eyebrows else [grow_eyebrows(identity, template, coarse, coarse_normals, rng)]),
        grow_eyelashes(identity, template, vertices, rng),
        *grow_beard(identity, template, coarse, coarse_normals, rng),
    ]
    fine = _shirt(template.refine(coarse), template)
    eyeballs = {side: _eyeball(template, vertices, side) for side in ("right", "left")}
    eye_meshes = {side: eyeball_mesh(ball) for side, ball in eyeballs.items()}
    casters = [ribbons(shadow_casters(grown[0]))] if grown else []
    casters += [dressing.hair.shadow()] if dressing.hair else []
    occluders = Occluders(
        raycasting_scene([(coarse, template.coarse_triangles), *eye_meshes.values()]),
        raycasting_scene(casters) if casters else None,
    )
    surface = _skin_surface(template, coarse, fine, occluders)
    short = [_lit_from_skin(part, surface) for part in facial]
    long = [_lit_hair(*grown, occluders)] if grown else []
    strands = concatenate(short + long)
    points = facemesh_landmarks(fine, template, eyeballs)
    ribbon_vertices, ribbon_triangles = ribbons(strands)
    return Head(
        parameters=identity.to_json() | dressing.to_json(),
        keypoints=keypoints(points),
        landmarks=points,
        surface=surface,
        skin=dressing.skin(make_skin(identity, generator(seed, Stream.SKIN, index))),
        eyeballs=eyeballs,
        eye_surfaces={
            side: _eye_surface(eyeballs[side], mesh, occluders) for side, mesh in eye_meshes.items()
        },
        eye_colour=dressing.eye_colour(eye_colour(identity, generator(seed, Stream.EYES, index))),
        strands=strands,
        ribbon_triangles=ribbon_triangles,
        cards=dressing.cards(surface, occluders),
        scene=raycasting_scene(
            [(fine, template.triangles), *eye_meshes.values(), (ribbon_vertices, ribbon_triangles)]
        ),
    )


def _seat(points: np.ndarray, upright: np.ndarray, identity: Identity, template: HeadTemplate) -> np.ndarray:
    """Move points ``[V, 3]`` of the head to where this subject holds it; ``upright`` are its kept vertices before."""
    eyes = 0.5 * (template.eyeball(upright, "left")[0] + template.eyeball(upright, "right")[0])
    turn = Rotation.from_euler("YXZ", [identity.yaw, identity.pitch, identity.roll])
    return turn.apply(points - (eyes + HEAD_CENTRE_FROM_EYES)) + np.array(identity.offset)


def _shirt(fine: np.ndarray, template: HeadTemplate) -> np.ndarray:
    """Lift the shirt off the skin, so that its collar has an edge."""
    normals = vertex_normals(fine, template.triangles)
    inside = smoothstep(0.002, -0.004, head_regions().above_neckline)
    return fine + 0.005 * inside[:, None] * normals


def _skin_surface(
    template: HeadTemplate,
    coarse: np.ndarray,
    fine: np.ndarray,
    occluders: Occluders,
) -> Surface:
    """Bake the light on the middle level, spread it to the finest, and let it scatter under the skin."""
    middle = template.levels[0].operator @ coarse
    baked = bake_surface(middle, vertex_normals(middle, triangulate(template.levels[0].quads)), occluders)
    up = template.levels[1].operator
    irradiance = np.repeat(np.maximum(up @ baked.irradiance, INTERREFLECTION)[:, None], 3, axis=1)
    for channel, rounds in enumerate(SCATTER_ROUNDS):
        for _ in range(rounds):
            irradiance[:, channel] = template.smoothing @ irradiance[:, channel]
    return Surface(
        vertices=fine,
        triangles=template.triangles,
        normals=vertex_normals(fine, template.triangles),
        irradiance=irradiance,
        key_visibility=np.clip(up @ baked.key_visibility, 0.0, 1.0),
        openness=np.clip(up @ baked.openness, 0.0, 1.0),
    )


def _eyeball(template: HeadTemplate, vertices: np.ndarray, side: str) -> Eyeball:
    centre, radius = template.eyeball(vertices, side)
    return Eyeball(centre, radius, unit(np.array([0.0, 0.0, GAZE_DISTANCE]) - centre))


def _eye_surface(ball: Eyeball, mesh: tuple[np.ndarray, np.ndarray], occluders: Occluders) -> Surface:
    vertices, triangles = mesh
    normals = (vertices - ball.centre) / ball.radius
    baked = bake_surface(vertices, normals, occluders)
    irradiance = np.repeat(baked.irradiance[:, None], 3, axis=1)
    return Surface(vertices, triangles, normals, irradiance, baked.key_visibility, baked.openness)


def _lit_hair(hair: Strands, guides: Strands, occluders: Occluders) -> Strands:
    guides = replace(guides, points=guides.points[:, ::2])  # light varies slowly along a strand
    light = bake_strands(guides.points.reshape(-1, 3), guides.tangents().reshape(-1, 3), occluders)
    return replace(hair, light=light_from_guides(hair, guides, light))


def _lit_from_skin(strands: Strands, surface: Surface) -> Strands:
    """Give short facial hair the light of the skin that it stands on."""
    _, nearest = cKDTree(surface.vertices).query(strands.points[:, 0])
    light = surface.irradiance[nearest].mean(axis=1)
    return replace(strands, light=np.repeat(light[:, None], strands.points.shape[1], axis=1))
