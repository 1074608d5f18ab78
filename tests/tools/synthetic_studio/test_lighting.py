"""Baked light against scenes whose answer is known."""

import numpy as np
import open3d as o3d
import pytest

from synthetic_studio.lighting import HAIR_EXTINCTION, Occluders, bake_strands, bake_surface, studio_lights

FAR_AWAY = np.array([[50.0, 0, 0], [51, 0, 0], [50, 1, 0]])


def scene(vertices: np.ndarray, triangles: np.ndarray) -> o3d.t.geometry.RaycastingScene:
    built = o3d.t.geometry.RaycastingScene(nthreads=1)
    built.add_triangles(vertices.astype(np.float32), np.asarray(triangles, dtype=np.uint32))
    return built


def plate(height: float) -> o3d.t.geometry.RaycastingScene:
    """A square of 40 m at some height over the origin, facing down and up alike."""
    corners = np.array([[-20.0, height, -20], [20, height, -20], [20, height, 20], [-20, height, 20]])
    return scene(corners, np.array([[0, 1, 2], [0, 2, 3]]))


OPEN = Occluders(scene(FAR_AWAY, np.array([[0, 1, 2]])), None)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.6, 0.0, -0.8)])
def test_an_open_surface_gets_the_cosine_sum_of_all_lights(normal):
    lights = studio_lights()
    baked = bake_surface(np.zeros((1, 3)), np.array([normal]), OPEN)
    expected = (np.maximum(lights.directions @ np.array(normal), 0.0) * lights.weights).sum()
    np.testing.assert_allclose(baked.irradiance, expected, rtol=1e-12)
    np.testing.assert_allclose(baked.openness, 1.0)


def test_a_white_surface_that_faces_the_cameras_is_not_overexposed():
    baked = bake_surface(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), OPEN)
    assert 0.7 < baked.irradiance[0] < 1.1


def test_a_roof_takes_all_light_from_above_and_none_from_below():
    up, down = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, -1.0, 0.0]])
    roofed = Occluders(plate(0.5), None)
    at = np.zeros((1, 3))
    assert bake_surface(at, up, roofed).irradiance[0] < 0.05 * bake_surface(at, up, OPEN).irradiance[0]
    assert bake_surface(at, down, roofed).irradiance[0] == bake_surface(at, down, OPEN).irradiance[0]


def test_hair_lets_light_through_by_beers_law():
    up = np.array([[0.0, 1.0, 0.0]])
    one = bake_surface(np.zeros((1, 3)), up, Occluders(OPEN.solid, plate(0.5)))
    free = bake_surface(np.zeros((1, 3)), up, OPEN)
    np.testing.assert_allclose(one.key_visibility / free.key_visibility, np.exp(-HAIR_EXTINCTION), rtol=1e-6)


def test_a_strand_along_the_light_is_darker_than_one_across_it():
    key = studio_lights().directions[studio_lights().is_key].mean(axis=0)
    key /= np.linalg.norm(key)
    across = np.cross(key, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    along, crosswise = bake_strands(np.zeros((2, 3)), np.stack([key, across]), OPEN)
    assert along < crosswise
