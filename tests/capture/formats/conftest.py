"""Rigs to write and read: cameras of several models and sizes around a head at the origin."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preface.capture.rig import Rig, RigCamera
from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid

LENSES = {
    "PINHOLE": [1250.25, 1249.5, 320.125, 243.7],
    "SIMPLE_RADIAL": [1300.1, 300.3, 250.9, -0.0712345678901234],
    "RADIAL": [1180.0, 321.0, 239.0, -0.08, 0.021],
    "OPENCV": [1300.1, 1299.7, 318.3, 241.9, -0.0812345, 0.0213, 1 / 3000, -1 / 7000],
    "FULL_OPENCV": [1301.7, 1300.3, 331.3, 229.9, 0.11, -0.02, 3e-4, -2e-4, 0.005, 0.17, -0.011, 0.002],
}


def pose(index):
    """A camera 1 m away that looks at the origin, with a little roll."""
    rotation = Rotation.from_euler("yxz", [20 * index - 35, 7 * index - 8, 3 + 5 * index], degrees=True)
    return Rigid(rotation.as_matrix(), np.array([0.011 * index, -0.02, 1.03 + 0.1 * index]))


def rig_of(*lenses):
    cameras = {f"cam.{i}-{lens.model}": RigCamera.at(lens, pose(i)) for i, lens in enumerate(lenses)}
    return Rig("take1", cameras)


@pytest.fixture
def rig():
    """Up to k3: what OpenCV's usual five coefficients hold."""
    k3 = Camera("FULL_OPENCV", 640, 480, np.array([*LENSES["OPENCV"], 0.0123, 0, 0, 0]))
    return rig_of(*(Camera(m, 640, 480, np.array(LENSES[m])) for m in list(LENSES)[:4]), k3)


@pytest.fixture
def full_rig():
    """Every camera model."""
    return rig_of(*(Camera(m, 640, 480, np.array(params)) for m, params in LENSES.items()))


@pytest.fixture
def pinhole_rig():
    """Without distortion, different intrinsics and sizes."""
    wide = Camera("PINHOLE", 800, 480, np.array([1251.0, 1251.0, 400.3, 239.1]))
    return rig_of(Camera("PINHOLE", 640, 480, np.array(LENSES["PINHOLE"])), wide)
