"""Cards: what is seen through and behind textured, half transparent triangles."""

import numpy as np
import pytest

from preface.capture.images import write_png
from synthetic_studio.cards import MAX_LAYERS, CardLayers, Cards, recolour
from synthetic_studio.textures import read_texture, sample

FOOTPRINT = 1e-4
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)


def sheet(z, colour, alpha, light=(1.0, 1.0), clearance=1.0):
    """A 2 m x 2 m sheet across the z axis, of one colour, that faces -z."""
    vertices = np.array([[-1, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]], float)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    texture = np.empty((4, 4, 4), np.float32)
    texture[:] = (*(alpha * np.array(colour)), alpha)
    return Cards(
        vertices,
        triangles,
        UV[triangles],
        texture,
        normals=np.tile([0.0, 0.0, -1.0], (4, 1)),
        light=np.tile(light, (4, 1)),
        clearance=np.full(4, clearance),
    )


def look(sheets, solid_depth=np.inf, solid=(0.0, 0.0, 0.0)):
    """Radiance and coverage along the z axis from the origin, and the depth and normal of what is seen."""
    layers = CardLayers(tuple(sheets))
    ray = np.array([[0.1, 0.2, 0, 0, 0, 1]], np.float32)
    covered = np.float32([np.isfinite(solid_depth)])
    depth = np.array([solid_depth])
    radiance, coverage = layers.over(ray, depth, np.float32([solid]), covered, FOOTPRINT)
    seen = np.where(np.isfinite(depth), depth, np.nan)
    normals = np.where(np.isfinite(depth)[:, None], [[0.0, 0.0, -1.0]], np.nan)
    depth, normals = layers.first_surface(ray, seen, normals, FOOTPRINT)
    return radiance[0], coverage[0], depth[0], normals[0]


def alone(colour, alpha, light=(1.0, 1.0)):
    """The premultiplied radiance of one sheet."""
    return look([sheet(1.0, colour, alpha, light)])[0]


RED, BLUE, WHITE = (0.4, 0.02, 0.02), (0.02, 0.02, 0.4), np.array([0.8, 0.8, 0.8])


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_sheets_are_composited_from_front_to_back_whatever_their_order(order):
    sheets = [sheet(1.0, RED, 0.6), sheet(2.0, BLUE, 0.3)]
    radiance, coverage, _, _ = look([sheets[k] for k in order], solid_depth=3.0, solid=WHITE)
    expected = alone(RED, 0.6) + 0.4 * alone(BLUE, 0.3) + 0.4 * 0.7 * WHITE
    np.testing.assert_allclose(radiance, expected, rtol=1e-5)
    assert coverage == pytest.approx(1.0)


def test_before_nothing_the_coverage_is_what_the_sheets_hold_back():
    _, coverage, _, _ = look([sheet(1.0, RED, 0.6), sheet(2.0, BLUE, 0.3)])
    assert coverage == pytest.approx(1 - 0.4 * 0.7, abs=1e-6)


def test_what_lies_behind_a_solid_surface_is_not_seen():
    radiance, coverage, depth, _ = look([sheet(2.0, RED, 1.0)], solid_depth=1.5, solid=WHITE)
    np.testing.assert_allclose(radiance, WHITE, rtol=1e-6)
    assert (coverage, depth) == (1.0, 1.5)


def test_a_ray_past_all_sheets_sees_what_is_there():
    layers = CardLayers((sheet(1.0, RED, 1.0),))
    ray = np.array([[5, 5, 0, 0, 0, 1]], np.float32)
    radiance, coverage = layers.over(ray, np.array([2.0]), np.float32([WHITE]), np.float32([1]), FOOTPRINT)
    np.testing.assert_array_equal(radiance, np.float32([WHITE]))
    assert coverage == 1.0


@pytest.mark.parametrize(
    ("alphas", "seen"), [((0.6, 0.6), 1.0), ((0.4, 0.4), 2.0), ((0.2, 0.2), 3.0), ((0.47, 0.1), 2.0)]
)
def test_the_depth_is_where_half_of_the_light_is_held_back(alphas, seen):
    sheets = [sheet(1.0 + k, RED, alpha) for k, alpha in enumerate(alphas)]
    _, _, depth, normal = look(sheets, solid_depth=3.0)
    assert depth == pytest.approx(seen, abs=1e-6)
    np.testing.assert_allclose(normal, [0, 0, -1], atol=1e-6)


def test_thin_hair_before_nothing_has_no_depth():
    _, coverage, depth, normal = look([sheet(1.0, RED, 0.3)])
    assert coverage == pytest.approx(0.3, abs=1e-6)
    assert np.isnan(depth)
    assert np.isnan(normal).all()


def test_layers_past_the_last_one_are_left_out_but_not_what_is_behind_them():
    sheets = [sheet(1.0 + 0.01 * k, RED, 0.1) for k in range(MAX_LAYERS + 5)]
    _, coverage, _, _ = look(sheets)
    assert coverage == pytest.approx(1 - 0.9**MAX_LAYERS, abs=1e-5)


def test_each_side_shows_its_own_light():
    turned = sheet(1.0, RED, 1.0, light=(0.2, 0.9))
    front = look([turned])[0]
    away = Cards(**{**turned.__dict__, "normals": -turned.normals})
    back = look([away])[0]
    np.testing.assert_allclose(back / front, 0.9 / 0.2, rtol=1e-4)
    # The normal that is seen always points to the camera.
    np.testing.assert_allclose(look([away])[3], [0, 0, -1], atol=1e-6)


def test_nothing_is_seen_of_cards_that_would_hide_the_face():
    _, coverage, depth, _ = look([sheet(1.0, RED, 1.0, clearance=-0.05)])
    assert coverage == 0.0
    assert np.isnan(depth)


def test_recolouring_moves_the_mean_and_keeps_the_pattern():
    random = np.random.default_rng(0)
    texture = np.concatenate(
        [random.uniform(0.1, 0.3, (32, 32, 1)) * [1.0, 0.8, 0.6], random.uniform(0, 1, (32, 32, 1))], axis=2
    ).astype(np.float32)
    wanted = np.array([0.30, 0.19, 0.085])
    result = recolour(texture, wanted)
    np.testing.assert_array_equal(result[..., 3], texture[..., 3])
    mean = result[..., :3].sum((0, 1)) / result[..., 3].sum()
    np.testing.assert_allclose(mean, wanted, rtol=0.02)
    opaque = texture[..., 3] > 0.5
    straight = result[opaque][:, 1] / result[opaque][:, 3]
    assert np.corrcoef(straight, texture[opaque][:, 1])[0, 1] > 0.99


def test_a_black_texture_takes_any_colour():
    black = np.zeros((8, 8, 4), np.float32)
    black[..., 3] = 1.0
    np.testing.assert_allclose(
        recolour(black, np.array([0.5, 0.4, 0.3]))[0, 0], [0.5, 0.4, 0.3, 1], rtol=1e-5
    )


def test_textures_are_decoded_to_linear_light(tmp_path):
    bytes_ = np.array([[[0, 10, 188, 128]]], np.uint8)
    write_png(tmp_path / "a.png", bytes_)
    # 188 is half of the light (0.5029), and 10 lies on the linear part, 10 / 255 / 12.92.
    np.testing.assert_allclose(
        read_texture(tmp_path / "a.png")[0, 0], [0, 0.003035, 0.5029, 128 / 255], atol=1e-4
    )
    write_png(tmp_path / "grey.png", np.full((2, 2, 1), 65535, np.uint16))
    np.testing.assert_array_equal(read_texture(tmp_path / "grey.png"), np.ones((2, 2, 4)))


def test_sampling_hits_texel_centres_and_repeats_beyond_the_borders():
    texture = np.arange(12, dtype=np.float32).reshape(3, 4, 1)
    columns, rows = np.meshgrid((np.arange(4) + 0.5) / 4, (np.arange(3) + 0.5) / 3)
    place = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    for shift in ((0, 0), (1, 0), (-2, 3)):
        np.testing.assert_allclose(sample(texture, place + shift)[:, 0], np.arange(12), atol=1e-3)
    assert sample(texture, np.zeros((0, 2))).shape == (0, 1)
