"""The studio's cameras: where they stand, what lenses they have, and how the rig drifts between takes.

The rig frame is the studio frame: metres, right-handed, x to the subject's left, y up, z out of the face, the
mean of the five keypoints near the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid
from synthetic_studio.config import DriftConfig
from synthetic_studio.streams import Stream, generator

# The middle of a head with its hair and the top of its neck, which every camera looks at: the keypoints lie
# on the face, the head is behind and above them.
HEAD_CENTRE = np.array([0.0, 0.02, -0.07])
# The lenses are defined on this sensor and resized exactly to the resolution asked for.
SENSOR = (4096, 6144)
# Field of view of about 0.29 x 0.43 m at the head: a head of 0.27 m with hair takes 62% of the height.
FOCAL_PER_METRE = 14200.0
DISTANCE = 1.0

# Azimuth (to the subject's left) and elevation in degrees, the most useful views of a smaller rig first.
PLACES = (
    (0, 2),
    (-45, 4),
    (45, 4),
    (0, 33),
    (-22, -2),
    (22, -2),
    (-30, 25),
    (30, 25),
    (-28, -21),
    (28, -21),
    (0, -25),
    (-80, 5),
    (80, 5),
)


@dataclass(frozen=True)
class StudioCamera:
    """One camera of the studio in one take."""

    id: str
    camera: Camera
    camera_from_rig: Rigid


def camera_id(index: int) -> str:
    """Name of a camera in files: cam00, cam01, ..."""
    return f"cam{index:02d}"


def nominal_rig(views: int, size: tuple[int, int], seed: int) -> list[StudioCamera]:
    """The cameras as the rig was built, for images of `size` (width, height)."""
    return [
        StudioCamera(camera_id(index), _lens(index, size, seed), _placement(index, seed))
        for index in range(views)
    ]


def take_rig(nominal: list[StudioCamera], drift: DriftConfig, seed: int, take: int) -> list[StudioCamera]:
    """The cameras in one take: each has wandered from its nominal place, independently of all other takes.

    Displacements and rotation vectors are isotropic Gaussians whose RMS lengths are those of `drift`.
    """
    return [_drifted(camera, drift, seed, take, index) for index, camera in enumerate(nominal)]


def _drifted(nominal: StudioCamera, drift: DriftConfig, seed: int, take: int, index: int) -> StudioCamera:
    shift, turn = generator(seed, Stream.DRIFT, take, index).standard_normal((2, 3)) / np.sqrt(3)
    rotation = Rotation.from_rotvec(turn * np.radians(drift.rotation_degrees)).as_matrix()
    moved_from_nominal = Rigid(rotation, shift * drift.translation_mm / 1000)
    return StudioCamera(nominal.id, nominal.camera, moved_from_nominal @ nominal.camera_from_rig)


def _placement(index: int, seed: int) -> Rigid:
    """camera_from_rig of a camera that looks at the head from about a metre, with a tripod's inaccuracies."""
    random = generator(seed, Stream.PLACEMENT, index)
    azimuth, elevation = np.radians(np.array(_place(index)) + random.uniform(-1.5, 1.5, 2))
    distance = DISTANCE * random.uniform(0.97, 1.03)
    target = HEAD_CENTRE + random.uniform(-0.004, 0.004, 3)
    roll = np.radians(random.uniform(-1.5, 1.5))
    direction = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    centre = HEAD_CENTRE + distance * direction
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    rotation = Rotation.from_rotvec([0, 0, roll]).as_matrix() @ level
    return Rigid(rotation, -rotation @ centre)


def _place(index: int) -> tuple[float, float]:
    """Azimuth and elevation; from the fourteenth on, cameras fill the middle (R2 sequence, Roberts 2018)."""
    if index < len(PLACES):
        return PLACES[index]
    step = index - len(PLACES) + 1
    across, up = (0.5 + step * 0.7548776662466927) % 1, (0.5 + step * 0.5698402909980532) % 1
    return -60 + 120 * across, -25 + 60 * up


def _lens(index: int, size: tuple[int, int], seed: int) -> Camera:
    """The camera's own focal length, principal point and distortion, on a sensor cut to the image's shape."""
    random = generator(seed, Stream.LENS, index)
    focal = FOCAL_PER_METRE * DISTANCE * random.uniform(0.98, 1.02)
    stretch = 1 + random.uniform(-2e-4, 2e-4)
    centre = np.array(SENSOR) * (0.5 + random.uniform(-0.01, 0.01, 2))
    k1, k2 = random.uniform(-0.1, 0.05), random.uniform(-0.05, 0.05)
    p1, p2 = random.normal(0, 4e-4, 2).clip(-1e-3, 1e-3)
    params = np.array([focal, focal * stretch, *centre, k1, k2, p1, p2])
    camera = _at_resolution(params, size)
    camera.require_unfolded()
    return camera


def _at_resolution(params: np.ndarray, size: tuple[int, int]) -> Camera:
    """The lens on the smallest sensor of the image's shape that contains SENSOR, resized to the image.

    A shape other than 2:3 thus keeps square pixels and the whole head, and sees more at two of its sides.
    """
    (width, height), (sensor_width, sensor_height) = size, SENSOR
    scale = max(sensor_width / width, sensor_height / height)
    wide, tall = round(width * scale), round(height * scale)
    moved = params.copy()
    moved[2:4] += (wide - sensor_width) / 2, (tall - sensor_height) / 2
    return Camera("OPENCV", wide, tall, moved).resized(width, height)
