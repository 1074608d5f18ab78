"""Where the board is held in each frame of a take, and where its corners then are in the images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from preface.capture.finding import MARKER_PIXELS
from preface.geometry.transforms import Rigid
from synthetic_studio.config import BoardConfig, StudioConfig
from synthetic_studio.patterns import BoardPattern
from synthetic_studio.rig import DISTANCE, HEAD_CENTRE, StudioCamera, nominal_rig
from synthetic_studio.streams import Stream, generator

# The board's middle stays within this box (half sides, metres) about the head's: partly out of some frames.
REACH = np.array([0.09, 0.13, 0.12])
# Largest roll of the board, in degrees.
ROLL = 30.0
# A board seen head-on: its x to the subject's left, its y down, its back towards the head.
RIG_FROM_FACING_BOARD = np.diag([1.0, -1.0, -1.0])
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def board_pose(config: BoardConfig, pattern: BoardPattern, seed: int, take: int, frame: int) -> Rigid:
    """rig_from_board in one frame of a take.

    The normal tilts from straight ahead by up to `config.tilt` degrees, in directions that the golden angle
    spreads over the frames, so that the cameras at the sides see the board too.
    """
    random = generator(seed, Stream.BOARD_POSES, take, frame)
    # The root spreads the normals evenly over the solid angle.
    tilt = np.radians(config.tilt) * np.sqrt(random.uniform(0, 1))
    direction = frame * GOLDEN_ANGLE + random.uniform(-0.3, 0.3)
    tilted = Rotation.from_rotvec(tilt * np.array([np.cos(direction), np.sin(direction), 0]))
    rolled = Rotation.from_rotvec([0, 0, np.radians(random.uniform(-ROLL, ROLL))])
    rotation = (tilted * rolled).as_matrix() @ RIG_FROM_FACING_BOARD
    middle = HEAD_CENTRE + random.uniform(-REACH, REACH)
    return Rigid(rotation, middle - rotation @ np.append(pattern.extent / 2, 0))


def markers_in_words(config: StudioConfig) -> list[str]:
    """How large the board's markers are in the images, and what to do if they are too small to calibrate from.

    Nothing for a chessboard, which has none.
    """
    pattern = BoardPattern.from_config(config.board)
    if not pattern.marker:
        return []
    focal = nominal_rig(1, config.size, config.seed)[0].camera.intrinsics[0]
    pixels = focal * pattern.marker / DISTANCE
    lines = [f"markers             {pixels:>10.1f} pixels along the side of each, seen head-on"]
    if pixels < MARKER_PIXELS:
        width, height = (math.ceil(side * MARKER_PIXELS / pixels) for side in config.size)
        lines.append(
            f"The cameras can hardly be calibrated: boards are found from {MARKER_PIXELS} pixels per marker on. Choose "
            f"a --resolution from {width}x{height} on, or fewer --board.squares with a larger --board.square-mm."
        )
    return lines


@dataclass(frozen=True)
class SeenCorners:
    """True corners of a board in one image: continuous pixels [N, 2] and whether each is to be seen [N]."""

    pixels: np.ndarray
    visible: np.ndarray


def seen_corners(pattern: BoardPattern, rig_from_board: Rigid, camera: StudioCamera) -> SeenCorners:
    """Project the corners of a board; visible are those in the image whose surface faces the camera."""
    camera_from_board = camera.camera_from_rig @ rig_from_board
    pixels, valid = camera.camera.project(camera_from_board.apply(pattern.corners))
    towards = camera_from_board.inverse.translation - pattern.corners
    slope = pattern.slope(pattern.corners[:, :2])
    # The viewer's side is that of negative z: the normal there is (dz/dx, dz/dy, -1).
    facing = (slope * towards[:, :2]).sum(axis=1) - towards[:, 2] > 0
    size = (camera.camera.width, camera.camera.height)
    inside = ((pixels > 0) & (pixels < size)).all(axis=1)
    return SeenCorners(np.where(valid[:, None], pixels, np.nan), valid & facing & inside)
