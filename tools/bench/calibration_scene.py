"""Simulated sightings of a calibration board by a rig, with its truth: the reference problem and variants.

The reference: 13 cameras of 4096x6144 pixels and about 13,500 px focal length stand at 1 m on the sphere
about a head, spread over 120 degrees; a board of 10x7 corners, 22 mm apart, is held in 40 poses there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from preface.capture.observations import Observations
from preface.geometry import Camera, Rigid

# The five keypoints of an average head about its middle, metres: outer eyes, nose tip, mouth, chin.
KEYPOINTS = np.array(
    [[-0.045, 0.03, 0.0], [0.045, 0.03, 0.0], [0, -0.01, 0.04], [0, -0.045, 0.02], [0, -0.085, 0.0]]
)


@dataclass(frozen=True)
class SceneConfig:
    """What to simulate.

    Attributes:
        cameras, frames: how many.
        width, height, focal: pixels.
        distance: of the cameras from the head, metres.
        azimuth: the cameras stand within this many degrees to either side.
        columns, rows, spacing: of the board's corners; spacing in metres.
        tilt: the board leans by up to this many degrees from a random camera's line of sight.
        bow: how far the board's middle bulges along x and along y, metres.
        noise: standard deviation of each coordinate, pixels.
        outliers: share of sightings that are wrong by 3 to 300 pixels.
        partial: share of views in which part of the board is hidden.
        distortion: k1, k2, p1, p2; varied by a fifth from camera to camera.
        aspect: standard deviation of fy/fx - 1 from camera to camera.
        lag: each view is taken this much too early or late (standard deviation), seconds; 0 for cameras that
            are triggered together. Boards move at up to `speed` and turn at up to `spin`.
        speed: metres per second.
        spin: radians per second.
    """

    cameras: int = 13
    frames: int = 40
    width: int = 4096
    height: int = 6144
    focal: float = 13500.0
    distance: float = 1.0
    azimuth: float = 60.0
    columns: int = 10
    rows: int = 7
    spacing: float = 0.022
    tilt: float = 40.0
    bow: tuple[float, float] = (0.0, 0.0)
    noise: float = 0.2
    outliers: float = 0.0
    partial: float = 0.3
    distortion: tuple[float, float, float, float] = (-0.1, 0.05, 3e-4, -2e-4)
    aspect: float = 1e-3
    lag: float = 0.0
    speed: float = 0.15
    spin: float = 0.5


@dataclass(frozen=True, eq=False)
class Scene:
    """Sightings and the truth behind them.

    Attributes:
        config: what was asked for.
        observations: the sightings; the board's frame has its origin at a corner.
        cameras: C lenses.
        camera_from_rig: C poses; the rig's frame is the first camera's.
        rig_from_board: F poses.
        outlier: [M], sightings that are wrong.
        keypoints: [5, 3], in the rig's frame.
    """

    config: SceneConfig
    observations: Observations
    cameras: tuple[Camera, ...]
    camera_from_rig: Rigid
    rig_from_board: Rigid
    outlier: np.ndarray
    keypoints: np.ndarray


def simulate(config: SceneConfig, seed: int) -> Scene:
    """Draw a rig, board poses and noise; the same for the same arguments."""
    rng = np.random.default_rng(seed)
    cameras = tuple(_camera(config, rng) for _ in range(config.cameras))
    camera_from_head = _ring(config, rng)
    head_from_board = _boards(config, camera_from_head, rng)
    points = board_points(config)
    first = Rigid(camera_from_head.rotation[0], camera_from_head.translation[0])
    camera_from_rig, rig_from_board = camera_from_head @ first.inverse, first @ head_from_board
    bowed = points.copy()
    middle = points[:, :2].mean(axis=0)
    bowed[:, 2] = (1 - ((points[:, :2] - middle) / np.abs(middle)) ** 2) @ config.bow

    rows, pixels = [], []
    for c, camera in enumerate(cameras):
        camera_from_board = (
            Rigid(camera_from_rig.rotation[c], camera_from_rig.translation[c]) @ rig_from_board
        )
        for f in range(config.frames):
            pose = Rigid(camera_from_board.rotation[f], camera_from_board.translation[f])
            if config.lag:
                pose = _elsewhen(pose, middle, config, rng)
            projected, seen = camera.project(pose.apply(bowed))
            seen &= ((projected > 0) & (projected < (config.width, config.height))).all(axis=1)
            towards = pose.translation + pose.rotation @ np.append(middle, 0)
            facing = pose.rotation[:, 2] @ towards > 0.5 * np.linalg.norm(towards)
            if rng.random() < config.partial:
                seen &= (points[:, :2] - middle) @ _direction(rng) < rng.uniform(0, 0.08 * np.ptp(points))
            if facing and seen.sum() >= 12:
                rows += [(c, f, p) for p in np.flatnonzero(seen)]
                pixels.append(projected[seen])
    index = np.array(rows, np.int32).reshape(-1, 3)
    exact = np.concatenate(pixels) if pixels else np.zeros((0, 2))
    noisy, outlier = _disturbed(exact, config, rng)
    observations = Observations(
        camera_ids=tuple(f"C{c:02d}" for c in range(config.cameras)),
        image_sizes=((config.width, config.height),) * config.cameras,
        frame_ids=tuple(f"F{f:03d}" for f in range(config.frames)),
        board_points=points,
        camera=index[:, 0],
        frame=index[:, 1],
        point=index[:, 2],
        pixels=noisy,
    )
    return Scene(
        config, observations, cameras, camera_from_rig, rig_from_board, outlier, first.apply(KEYPOINTS)
    )


def noisy_again(scene: Scene, seed: int) -> Scene:
    """The same rig and boards with other noise, for Monte Carlo."""
    rng = np.random.default_rng(seed)
    noisy, outlier = _disturbed(exact_pixels(scene), scene.config, rng)
    return replace(scene, observations=replace(scene.observations, pixels=noisy), outlier=outlier)


def exact_pixels(scene: Scene) -> np.ndarray:
    """Where the sightings would be without noise and outliers, [M, 2]."""
    seen = scene.observations
    points = board_points(scene.config)
    middle = points[:, :2].mean(axis=0)
    points[:, 2] = (1 - ((points[:, :2] - middle) / np.abs(middle)) ** 2) @ scene.config.bow
    exact = np.zeros((len(seen), 2))
    for c, camera in enumerate(scene.cameras):
        mine = seen.camera == c
        frame = seen.frame[mine]
        board = Rigid(scene.rig_from_board.rotation[frame], scene.rig_from_board.translation[frame])
        pose = Rigid(scene.camera_from_rig.rotation[c], scene.camera_from_rig.translation[c]) @ board
        exact[mine] = camera.project(pose.apply(points[seen.point[mine]]))[0]
    return exact


def board_points(config: SceneConfig) -> np.ndarray:
    """The board's corners row by row, [P, 3] metres, the first at the origin."""
    x, y = np.meshgrid(np.arange(config.columns), np.arange(config.rows))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1) * config.spacing


def _camera(config: SceneConfig, rng: np.random.Generator) -> Camera:
    size = np.array([config.width, config.height])
    focal = config.focal * (1 + 0.01 * rng.normal()) * np.array([1, 1 + config.aspect * rng.normal()])
    center = size / 2 + 0.01 * size * rng.normal(size=2)
    distortion = np.array(config.distortion) * (1 + 0.2 * rng.normal(size=4))
    return Camera("OPENCV", config.width, config.height, np.concatenate([focal, center, distortion]))


def _ring(config: SceneConfig, rng: np.random.Generator) -> Rigid:
    """camera_from_head: spread over azimuth, at alternating heights, looking at the head."""
    azimuth = np.radians(np.linspace(-1, 1, config.cameras) * config.azimuth)
    height = np.radians(np.resize([0.0, 25.0, -20.0], config.cameras) * min(config.azimuth / 30, 1))
    center = np.stack(
        [np.sin(azimuth) * np.cos(height), np.sin(height), np.cos(azimuth) * np.cos(height)], -1
    )
    center = config.distance * (center + 0.02 * rng.normal(size=center.shape) * min(config.azimuth / 30, 1))
    forward = -center / np.linalg.norm(center, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Rigid(rotation, -np.einsum("cij,cj->ci", rotation, center))


def _boards(config: SceneConfig, camera_from_head: Rigid, rng: np.random.Generator) -> Rigid:
    """head_from_board: each board leans from the line of sight of one camera, somewhere about the head."""
    rotation, translation = [], []
    middle = board_points(config).mean(axis=0)
    for frame in range(config.frames):
        facing = camera_from_head.rotation[rng.permutation(config.cameras)[frame % config.cameras]].T
        lean = np.radians(config.tilt) * np.sqrt(rng.random()) * np.append(_direction(rng), 0)
        roll = Rotation.from_rotvec([0, 0, np.radians(rng.uniform(-30, 30))])
        turned = facing @ (Rotation.from_rotvec(lean) * roll).as_matrix()
        reach = np.array([0.23 * config.width, 0.2 * config.height, 0.33 * config.width])
        reach *= config.distance / config.focal
        rotation.append(turned)
        translation.append(rng.uniform(-1, 1, 3) * reach - turned @ middle)
    return Rigid(np.array(rotation), np.array(translation))


def _elsewhen(pose: Rigid, middle: np.ndarray, config: SceneConfig, rng: np.random.Generator) -> Rigid:
    """Where the board is a random time before or after; its motion has any direction, seen from any camera."""
    late = config.lag * rng.normal()
    velocity, spin = rng.normal(size=(2, 3))
    velocity *= config.speed * rng.random() / np.linalg.norm(velocity)
    spin *= config.spin * rng.random() / np.linalg.norm(spin)
    about = np.append(middle, 0)
    turned = Rotation.from_rotvec(late * spin).as_matrix() @ pose.rotation
    return Rigid(turned, pose.apply(about) + late * velocity - turned @ about)


def _disturbed(
    exact: np.ndarray, config: SceneConfig, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Add noise everywhere, and an error of 3 to 300 pixels (each size as likely) to the outliers."""
    noisy = exact + config.noise * rng.normal(size=exact.shape)
    outlier = rng.random(len(exact)) < config.outliers
    angle, size = rng.uniform(0, 2 * np.pi, len(exact)), 3 * 100 ** rng.random(len(exact))
    wrong = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * size[:, None]
    return np.where(outlier[:, None], exact + wrong, noisy), outlier


def _direction(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])
