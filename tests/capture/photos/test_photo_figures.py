"""The plot of where photographs were taken from stays legible, however many there are."""

import numpy as np
import pytest

from preface.capture.calibration_figures import photographs_in_space
from preface.geometry import Camera, Rigid

CAMERA = Camera("PINHOLE", 300, 400, (500, 500, 150, 200))


def cameras_at(centers):
    """Poses that look along -z, the image upright."""
    rotation = np.tile(np.diag([1.0, -1.0, -1.0]), (len(centers), 1, 1))
    return Rigid(rotation, -np.einsum("cij,cj->ci", rotation, centers))


def drawn_names(axis):
    return [text.get_text() for text in axis.texts]


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).normal(0, 0.1, (9000, 3))


def test_photographs_that_stand_apart_are_all_named(points):
    centers = np.array([(x, 0.3 * x, 1.0) for x in (-0.8, -0.4, 0.0, 0.4, 0.8)])
    names = [f"P{index}" for index in range(5)]
    above, side = photographs_in_space(names, [CAMERA] * 5, cameras_at(centers), points, "m").axes
    assert drawn_names(above) == names
    assert drawn_names(side) == names
    assert above.get_xlabel() == "right (m)"


def test_of_photographs_from_one_place_one_is_named(points):
    centers = np.tile([0.0, 0.0, 1.0], (50, 1)) + np.random.default_rng(1).normal(0, 1e-3, (50, 3))
    names = [f"P{index}" for index in range(50)]
    figure = photographs_in_space(names, [CAMERA] * 50, cameras_at(centers), points, "arbitrary unit")
    for axis in figure.axes:
        assert drawn_names(axis) == ["P0"]
        assert "arbitrary unit" in axis.get_ylabel()


def test_a_large_cloud_is_thinned(points):
    figure = photographs_in_space(["P"], [CAMERA], cameras_at(np.array([[0, 0, 1.0]])), points, "m")
    cloud = figure.axes[0].lines[0].get_xdata()
    assert 1000 < len(cloud) <= 4000
