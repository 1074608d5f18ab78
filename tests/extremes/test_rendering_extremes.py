"""Images at the limits: cameras, boxes, densities, codes and sizes where rendering could fail.

Fog of one density and one colour fills the box in most of these, since what a pixel sees of it is known in closed
form for every camera: with a chord of length L, opacity 1 - exp(-density L), the fog's colour in that share, and half
of the light lost ln 2 / density behind the entrance.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from preface.geometry import Box, Camera, GeometryError, Rigid
from preface.model.configuration import ModelConfig, NetworkConfig
from preface.model.model import PriorModel
from preface.model.rendering.image import RenderedImage, Space, render_image
from preface.model.rendering.mesh import extract_mesh, model_field, voxel_side
from preface.model.rendering.paths import framing_camera, look_at
from preface.model.rendering.shortcuts import QUALITIES, accelerate

BOX = Box(np.array([-0.15, -0.2, -0.14]), np.array([0.15, 0.22, 0.16]))
SPACE = Space(BOX, 1 / 0.21)
FOG = np.array([0.2, 0.5, 0.8])
DENSITY = 8.0  # per metre: a chord of 30 cm keeps a tenth of the light
CONFIG = ModelConfig(
    latent=4,
    proposal=NetworkConfig(1, 8),
    nerf=NetworkConfig(2, 8),
    bottleneck=4,
    view_width=4,
    view_levels=1,
    levels=4,
    samples=(16, 16),
    code_std=1.0,
)


def model_of(latent: int = 4, identities: int = 2, **changes) -> PriorModel:
    torch.manual_seed(0)
    return PriorModel(dataclasses.replace(CONFIG, latent=latent, **changes), identities)


def raw_density(per_metre: float, scale: float) -> float:
    """What the networks have to say for a density: the inverse of softplus(raw - 1)."""
    density = per_metre / scale
    return 1 + density + math.log(-math.expm1(-density)) if density else -math.inf


def fog(per_metre: float = DENSITY, space: Space = SPACE, color: np.ndarray = FOG) -> PriorModel:
    """A model that says the same everywhere, in one round: a second would leave out where little light arrives."""
    model = model_of(samples=(16,))
    with torch.no_grad():
        for network in (model.proposal, model.nerf):
            network.density.weight.zero_()
            network.density.code_weight.zero_()
            network.density.bias.fill_(raw_density(per_metre, space.scale))
        model.nerf.color.weight.zero_()
        model.nerf.color.bias.copy_(torch.logit(torch.from_numpy(color + 0.001) / 1.002).float())
    return model


def picture(
    model: PriorModel,
    camera: Camera,
    pose: Rigid,
    space: Space = SPACE,
    at_a_time: int = 500,
    code: torch.Tensor | None = None,
    normals: bool = False,
    background: float = 0.0,
) -> RenderedImage:
    code = model.codes[:1].detach() if code is None and model.config.latent else code

    def render(rays):
        with torch.no_grad():
            return model(rays, code, background=background, normals=normals)

    return render_image(render, space, camera, pose, rays_at_a_time=at_a_time)


def chords(camera: Camera, pose: Rigid, box: Box = BOX) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entrance and length of each pixel's ray in the box, metres, and the cosine to the axis; all [H, W].

    A pinhole in float64, ray by ray and plane by plane.
    """
    fx, fy, cx, cy = camera.params
    found = np.zeros((camera.height, camera.width, 3))
    for row, column in np.ndindex(camera.height, camera.width):
        ray = np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0])
        direction = pose.rotation @ ray / np.linalg.norm(ray)
        enter, leave = 0.0, math.inf
        for axis in range(3):
            for plane, sign in ((box.minimum[axis], -1), (box.maximum[axis], 1)):
                outside, speed = sign * (pose.translation[axis] - plane), sign * direction[axis]
                if speed > 0:
                    leave = min(leave, -outside / speed)
                elif speed < 0:
                    enter = max(enter, -outside / speed)
                elif outside > 0:
                    leave = -math.inf
        found[row, column] = enter, max(leave - enter, 0.0), 1 / np.linalg.norm(ray)
    return found[..., 0], found[..., 1], found[..., 2]


def require_fog(
    image: RenderedImage, camera: Camera, pose: Rigid, space: Space = SPACE, tolerance: float = 2e-5
) -> np.ndarray:
    """The image is that of the fog; returns the opacities that it should have."""
    entrance, length, cosine = chords(camera, pose, space.box)
    alpha = -np.expm1(-DENSITY * length)
    np.testing.assert_allclose(image.alpha, alpha, atol=tolerance)
    np.testing.assert_allclose(image.rgb, alpha[..., None] * FOG, atol=tolerance)
    opaque = alpha > 0.5 + tolerance
    half = (entrance + math.log(2) / DENSITY) * cosine
    # Between two ends of an interval, depth is linear in the light lost.
    np.testing.assert_allclose(image.depth[opaque], half[opaque], atol=np.max(length) / 32, rtol=1e-5)
    assert np.isnan(image.depth[alpha < 0.5 - tolerance]).all()
    return alpha


def pinhole(width: int, height: int, focal: float) -> Camera:
    return Camera("PINHOLE", width, height, np.array([focal, focal, width / 2, height / 2]))


FRONT = look_at(np.array([0.0, 0.01, 1.0]), BOX.center)
CAMERAS = {
    "from the front": (pinhole(8, 12, 24.0), FRONT, 2e-5),
    "inside the box": (pinhole(7, 7, 4.0), look_at(np.array([0.02, 0.03, 0.05]), np.zeros(3)), 2e-5),
    "inside the box, looking almost all around": (
        pinhole(9, 9, 0.4),
        look_at(np.array([0.02, 0.03, 0.05]), np.zeros(3)),
        2e-5,
    ),
    "on a face of the box, looking in": (
        pinhole(6, 6, 5.0),
        look_at(np.array([0.0, 0.0, 0.16]), np.array([0.0, 0.02, 0.0])),
        2e-5,
    ),
    "on a face of the box, looking out": (
        pinhole(6, 6, 5.0),
        look_at(np.array([0.01, 0.0, 0.16]), np.array([0.01, 0.05, 1.0])),
        2e-5,
    ),
    "100 m away": (pinhole(8, 12, 2400.0), look_at(np.array([30.0, 0.0, 95.4]), BOX.center), 1e-3),
    "with the box behind it": (pinhole(6, 6, 5.0), look_at(np.array([0.0, 0.0, 1.0]), np.full(3, 2.0)), 0.0),
    "grazing a face": (
        pinhole(5, 5, 400.0),
        look_at(np.array([0.1499, 0.0, 1.0]), np.array([0.1499, 0.0, 0.0])),
        1e-4,
    ),
    "one pixel for the whole head": (pinhole(1, 1, 1.0), FRONT, 2e-5),
    "a lens shifted off its image": (
        Camera("PINHOLE", 6, 6, np.array([900.0, 900.0, -100.0, 40.0])),
        look_at(np.array([-0.12, 0.0, 1.0]), np.array([-0.12, 0.0, 0.0])),
        2e-5,
    ),
    "pixels a hundred times as wide as high": (
        Camera("PINHOLE", 5, 40, np.array([2.0, 200.0, 2.5, 20.0])),
        FRONT,
        2e-5,
    ),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_fog_in_the_box_is_seen_as_thick_as_it_is_from_every_camera(name):
    camera, pose, tolerance = CAMERAS[name]
    alpha = require_fog(picture(fog(), camera, pose), camera, pose, tolerance=tolerance)
    assert (alpha.max() > 0) == (name not in ("with the box behind it", "on a face of the box, looking out"))


@pytest.mark.parametrize("quality", ["draft", "balanced"])
@pytest.mark.parametrize("per_metre", [0.0, 1e4], ids=["nothing", "a wall"])
def test_shortcuts_see_nothing_and_walls_from_every_camera_as_the_full_render_does(quality, per_metre):
    model = fog(per_metre)
    render = accelerate(model, model.codes[0].detach(), SPACE, QUALITIES[quality])
    for name, (camera, pose, _) in CAMERAS.items():
        full = picture(model, camera, pose)
        short = render_image(render, SPACE, camera, pose, rays_at_a_time=500)
        # Samples with at most a hundredth of the light may be left out, of which a wall has one or two.
        np.testing.assert_allclose(short.rgb, full.rgb, atol=2e-2, err_msg=name)
        np.testing.assert_allclose(short.alpha, full.alpha, atol=2e-2, err_msg=name)
        np.testing.assert_array_equal(np.isnan(short.depth), np.isnan(full.depth), err_msg=name)


@pytest.mark.parametrize("row", [0, 2047, 4095])
def test_a_row_of_a_4096_pixel_image_is_the_fog_in_pieces_of_any_size(row):
    # The row alone, by moving the principal point: the other 4095 are as it.
    full = framing_camera(BOX.half_sides, 1.0, 4096, 4096)
    fx, fy, cx, cy = full.params
    camera = Camera("PINHOLE", 4096, 1, np.array([fx, fy, cx, cy - row]))
    model = fog()
    pieces = picture(model, camera, FRONT, at_a_time=1000)
    assert require_fog(pieces, camera, FRONT).max() > 0.5
    whole = picture(model, camera, FRONT, at_a_time=4096)
    np.testing.assert_allclose(pieces.rgb, whole.rgb, atol=1e-6)


@pytest.mark.parametrize(
    ("per_metre", "opacity"),
    [(0.0, 0.0), (1e-30, 0.0), (1e-6, None), (1e4, 1.0), (1e30, 1.0)],
)
def test_fog_of_any_density_is_finite_and_as_opaque_as_it_is(per_metre, opacity):
    camera, pose, _ = CAMERAS["from the front"]
    entrance, length, cosine = chords(camera, pose)
    image = picture(fog(per_metre), camera, pose, normals=True)
    met = length > 0.01
    expected = -np.expm1(-per_metre * length) if opacity is None else np.where(met, opacity, 0.0)
    np.testing.assert_allclose(image.alpha[met], expected[met], rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(image.rgb[met], expected[met][:, None] * FOG, rtol=1e-4, atol=1e-12)
    if opacity == 1.0:  # a wall: light ends where it enters, within an interval
        np.testing.assert_allclose(image.depth[met], (entrance * cosine)[met], atol=0.3 / 16)
    else:
        assert np.isnan(image.depth).all()
    # Fog has no surface, however dense it is, and a normal is length one or not at all.
    assert np.isnan(image.normals).all()


@pytest.mark.parametrize("side", [1e-4, 1e3])
def test_a_box_of_any_size_holds_the_fog_that_is_put_in_it(side):
    space = Space(Box(-np.array([0.6, 1.0, 0.8]) * side, np.array([0.6, 1.0, 0.8]) * side), 1 / side)
    pose = look_at(np.array([0.0, 0.0, 4.0]) * side, np.zeros(3))
    camera = pinhole(6, 8, 12.0)
    image = picture(fog(DENSITY / side, space), camera, pose, space)
    _, length, _ = chords(camera, pose, space.box)
    np.testing.assert_allclose(image.alpha, -np.expm1(-DENSITY / side * length), atol=2e-5)


def test_a_box_as_thin_as_a_sheet_is_seen_through_by_its_thickness():
    space = Space(Box(np.array([-0.2, -0.2, -5e-5]), np.array([0.2, 0.2, 5e-5])), 5.0)
    camera, pose = pinhole(8, 8, 16.0), look_at(np.array([0.3, 0.1, 0.6]), np.zeros(3))
    require_fog(picture(fog(space=space), camera, pose, space), camera, pose, space)


@pytest.mark.parametrize("factor", [1e3, 1e9, 1e30])
def test_a_code_far_outside_the_training_distribution_gives_an_image_of_colours(factor):
    model = model_of()
    camera, pose, _ = CAMERAS["from the front"]
    image = picture(model, camera, pose, code=factor * model.codes[:1].detach(), normals=True)
    assert np.isfinite(image.rgb).all()
    assert ((image.rgb >= -0.0011) & (image.rgb <= 1.0011)).all()
    assert ((image.alpha >= 0) & (image.alpha <= 1)).all()
    # In the limit the code alone decides: the networks are homogeneous, and the outputs saturate.
    _, length, _ = chords(camera, pose)
    if factor > 1e6:
        met = image.alpha[length > 0.05]
        assert ((met < 1e-3) | (met > 1 - 1e-3)).all()


def test_a_code_that_is_not_a_number_is_seen_in_the_image_and_only_where_the_model_is():
    model = model_of()
    camera, pose, _ = CAMERAS["from the front"]
    image = picture(model, camera, pose, code=torch.full((1, 4), torch.nan), background=0.5)
    _, length, _ = chords(camera, pose)
    assert np.isnan(image.rgb[length > 0]).all()
    assert (image.rgb[length == 0] == 0.5).all()
    assert np.isnan(image.depth).all()


@pytest.mark.parametrize("identities", [0, 1])
def test_a_model_without_codes_and_a_prior_of_one_identity_render(identities):
    model = model_of(4 * identities, identities)
    camera, pose, _ = CAMERAS["from the front"]
    image = picture(model, camera, pose)
    _, length, _ = chords(camera, pose)
    assert (image.alpha[length > 0.01] > 0).all()
    assert (image.alpha[length == 0] == 0).all()


@pytest.mark.parametrize("at_a_time", [15, 16, 17])
def test_a_view_of_16_pixels_does_not_depend_on_how_it_is_cut(at_a_time):
    model, camera = model_of(), framing_camera(BOX.half_sides, 1.0, 16, 16)
    whole = picture(model, camera, FRONT, at_a_time=10**6)
    parts = picture(model, camera, FRONT, at_a_time=at_a_time)
    np.testing.assert_allclose(parts.rgb, whole.rgb, atol=2e-6)
    np.testing.assert_allclose(parts.alpha, whole.alpha, atol=2e-6)


def test_a_camera_that_is_not_anywhere_is_refused():
    with pytest.raises(GeometryError):
        look_at(np.array([0.0, np.nan, 1.0]), np.zeros(3))
    with pytest.raises(GeometryError):
        look_at(np.zeros(3), np.zeros(3))


def test_a_box_full_of_density_has_the_box_as_its_surface():
    side = voxel_side(SPACE, 12)
    mesh = extract_mesh(model_field(fog(1e4), fog().codes[0].detach(), side), SPACE, 12)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), BOX.minimum, atol=side / SPACE.scale)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), BOX.maximum, atol=side / SPACE.scale)
    corners = mesh.vertices[mesh.triangles]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    expected = np.prod(2 * BOX.half_sides)
    assert expected <= volume < 1.5 * expected  # closed, turned outwards, half a voxel or so outside
