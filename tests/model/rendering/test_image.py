"""Images of scenes whose every pixel is known: an opaque ball, and a model cut into strips of any size."""

import numpy as np
import pytest
import torch

from preface.geometry import Box, Camera, GeometryError, Rigid
from preface.model.configuration import ModelConfig, NetworkConfig
from preface.model.model import Level, PriorModel, Render
from preface.model.rendering.image import Space, render_image
from preface.model.rendering.paths import framing_camera, look_at

SPACE = Space(Box(np.array([-0.15, -0.2, -0.14]), np.array([0.15, 0.22, 0.16])), 1 / 0.21)
BALL, CENTER = 0.1, np.array([0.01, -0.02, 0.03])
COLOR = torch.tensor([0.2, 0.5, 0.8])


def ball(rays):
    """Render an opaque ball in float64: one sample per ray, where it is met."""
    o, d = rays.origins.double() / SPACE.scale, rays.directions.double()
    to_center = torch.from_numpy(CENTER) - o
    along = (to_center * d).sum(-1) / (d * d).sum(-1)
    nearest = ((o + along[:, None] * d - torch.from_numpy(CENTER)) ** 2).sum(-1)
    met = (nearest < BALL**2) & rays.hit[:, 0]
    t = along - (BALL**2 - nearest).clamp_min(0).sqrt() / d.norm(dim=-1)
    some = met.nonzero()[:, 0]
    normals = ((o + t[:, None] * d - torch.from_numpy(CENTER)) / BALL).float()[some]
    ends = torch.stack([t, t + 1e-3], dim=-1).float()[some] * SPACE.scale
    weights = torch.ones(len(some), 1)
    depth = torch.where(met, t.float() * SPACE.scale, rays.far[:, 0])
    rgb = met[:, None] * COLOR
    return Render(
        (Level(ends, ends, weights, weights),), rgb, met.float(), depth, depth, normals[:, None], None, some
    )


@pytest.fixture
def pose() -> Rigid:
    return look_at(np.array([0.4, 0.2, 0.8]), np.zeros(3))


@pytest.mark.parametrize("rays_at_a_time", [1, 7, 64, 1000, 10**6])
def test_a_ball_is_where_and_what_it_is(pose, rays_at_a_time):
    camera = Camera("OPENCV", 24, 36, [60.0, 61.0, 12.5, 17.0, -0.1, 0.05, 1e-3, -2e-3])
    image = render_image(ball, SPACE, camera, pose, rays_at_a_time=rays_at_a_time)
    seen = image.alpha > 0.5
    assert 50 < seen.sum() < seen.size
    # Back from depth to space: every point lies on the ball, and its normal points out of it.
    y, x = np.nonzero(seen)
    normalised, valid = camera.unproject(np.stack([x, y], -1) + 0.5)
    assert valid.all()
    depth = image.depth[seen].astype(np.float64)[:, None]
    points = pose.apply(np.concatenate([normalised * depth, depth], axis=1))
    np.testing.assert_allclose(np.linalg.norm(points - CENTER, axis=1), BALL, atol=2e-7)
    np.testing.assert_allclose(image.normals[seen], (points - CENTER) / BALL, atol=1e-5)
    np.testing.assert_allclose(image.rgb[seen], np.broadcast_to(COLOR, (len(x), 3)))
    assert np.isnan(image.depth[~seen]).all()
    assert np.isnan(image.normals[~seen]).all()
    assert (image.rgb[~seen] == 0).all()


def small_model(seed: int = 0) -> PriorModel:
    torch.manual_seed(seed)
    config = ModelConfig(
        latent=4, proposal=NetworkConfig(2, 8), nerf=NetworkConfig(3, 16), bottleneck=8, view_width=8, levels=4,
        samples=(8, 8),
    )  # fmt: skip
    return PriorModel(config, 2)


@pytest.mark.parametrize("rays_at_a_time", [1, 13, 16, 100, 5000])
def test_strips_of_any_size_give_one_image(pose, rays_at_a_time):
    model = small_model()
    camera = framing_camera(SPACE.box.half_sides, 0.95, 16, 24)

    def render(rays):
        with torch.no_grad():
            return model(rays, model.codes[:1], normals=True)

    whole = render_image(render, SPACE, camera, pose, rays_at_a_time=10**6)
    parts = render_image(render, SPACE, camera, pose, rays_at_a_time=rays_at_a_time)
    np.testing.assert_allclose(parts.rgb, whole.rgb, atol=2e-6)
    np.testing.assert_allclose(parts.alpha, whole.alpha, atol=2e-6)
    np.testing.assert_array_equal(np.isnan(parts.depth), np.isnan(whole.depth))


def test_a_camera_that_looks_away_sees_the_background_and_evaluates_nothing():
    model = small_model()
    away = look_at(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 2.0]))
    camera = Camera("PINHOLE", 8, 8, [10.0, 10.0, 4.0, 4.0])
    image = render_image(
        lambda rays: model(rays, model.codes[:1], background=0.25), SPACE, camera, away, rays_at_a_time=64
    )
    assert (image.rgb == 0.25).all()
    assert (image.alpha == 0).all()
    assert np.isnan(image.depth).all()


def test_a_camera_inside_the_box_and_one_far_away_give_finite_images():
    model = small_model()
    camera = Camera("PINHOLE", 6, 6, [6.0, 6.0, 3.0, 3.0])
    for center in (np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 100.0])):
        view = camera if center[2] < 1 else Camera("PINHOLE", 6, 6, [2000.0, 2000.0, 3.0, 3.0])
        pose = look_at(center, np.array([0.0, 0.0, -0.1]))
        image = render_image(lambda rays: model(rays, model.codes[:1]), SPACE, view, pose, rays_at_a_time=64)
        assert np.isfinite(image.rgb).all()
        assert ((image.alpha >= 0) & (image.alpha <= 1)).all()


def test_a_lens_that_folds_inside_the_image_is_refused(pose):
    folding = Camera("SIMPLE_RADIAL", 20, 20, [8.0, 10.0, 10.0, -0.5])
    with pytest.raises(GeometryError, match="folds inside the image"):
        render_image(ball, SPACE, folding, pose, rays_at_a_time=64)
