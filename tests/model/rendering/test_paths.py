"""Cameras on paths look at the head, upright, from where they should be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from preface.geometry import GeometryError
from preface.model.rendering.paths import framing_camera, look_at, on_sphere, orbit

TARGET = np.array([0.01, -0.02, 0.03])


@given(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4), st.floats(0.1, 100))
def test_a_camera_sees_its_target_in_the_middle_and_up_above(azimuth, elevation, distance):
    pose = on_sphere(TARGET, azimuth, elevation, distance)
    seen = pose.inverse.apply(np.stack([TARGET, TARGET + np.array([0, 0.01, 0])]))
    np.testing.assert_allclose(seen[0], [0, 0, distance], atol=1e-9 * distance)
    assert abs(seen[1, 0]) < 1e-9 * distance
    assert seen[1, 1] < 0  # y of cameras is down


def test_the_front_is_along_z_and_positive_azimuth_is_the_subjects_left():
    np.testing.assert_allclose(on_sphere(TARGET, 0, 0, 1).translation, TARGET + np.array([0, 0, 1]))
    assert on_sphere(TARGET, 0.5, 0, 1).translation[0] > TARGET[0]
    assert on_sphere(TARGET, 0, 0.5, 1).translation[1] > TARGET[1]


@pytest.mark.parametrize("azimuth", [0.5, 4.0])
def test_an_orbit_is_closed_and_keeps_its_distance(azimuth):
    poses = orbit(TARGET, 12, 0.8, azimuth, 0.2)
    centers = np.stack([pose.translation for pose in poses])
    np.testing.assert_allclose(np.linalg.norm(centers - TARGET, axis=1), 0.8)
    steps = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    assert steps[-1] < 2 * np.median(steps)


@given(st.floats(-3.1, 3.1), st.integers(10, 300), st.integers(10, 300))
def test_the_framing_camera_fits_the_height_of_the_boxs_middle(azimuth, width, height):
    half = np.array([0.15, 0.2, 0.16])
    camera = framing_camera(half, 1.0, width, height)
    ends = np.array([[0, 0.2, 0], [0, -0.2, 0]])
    pixels, valid = camera.project(on_sphere(np.zeros(3), azimuth, 0, 1.0).inverse.apply(ends))
    assert valid.all()
    np.testing.assert_allclose(pixels, [[width / 2, 0], [width / 2, height]], atol=1e-9 * height)


def test_what_cannot_be_is_refused():
    with pytest.raises(GeometryError, match="upright"):
        look_at(TARGET + np.array([0, 1, 0]), TARGET)
    with pytest.raises(GeometryError, match="upright"):
        look_at(TARGET, TARGET)
    with pytest.raises(GeometryError, match="distance"):
        on_sphere(TARGET, 0, 0, 0.0)
    with pytest.raises(GeometryError, match="frames"):
        orbit(TARGET, 0, 1, 1, 1)
    with pytest.raises(GeometryError, match="move it away"):
        framing_camera(np.ones(3), 1.0, 10, 10)
