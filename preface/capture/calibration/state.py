"""The unknowns of a calibration, and the order in which they stand in a step.

    head = (parameters of camera 0, of camera 1, ...; poses of camera 0, 1, ...; the two warp parameters)
    tail = (pose of the board in frame 0, 1, ...)

and, where cameras are not simultaneous, how far the board had moved in each view (see `motion`).

A pose has six: a rotation vector (radians) about the axes of the target frame, then the translation
(metres): R <- Exp(w) R, t <- t + d.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from preface.capture.calibration.motion import Motion, turned
from preface.capture.calibration.views import BoardViews
from preface.geometry.cameras import CAMERA_MODELS, Camera
from preface.geometry.transforms import Rigid


@cache
def expansion(model: str) -> np.ndarray:
    """Return the matrix [12, n] that turns a model's parameters into the intrinsics of `geometry.lens`."""
    ones = np.ones(len(CAMERA_MODELS[model]))
    base = Camera(model, 1, 1, ones).intrinsics
    columns = [Camera(model, 1, 1, ones + unit).intrinsics - base for unit in np.eye(len(ones))]
    matrix = np.stack(columns, axis=-1)
    matrix.setflags(write=False)
    return matrix


@dataclass(frozen=True, eq=False)
class RigState:
    """C cameras of one model, F board poses.

    Attributes:
        model: a key of `CAMERA_MODELS`.
        params: [C, n].
        camera_from_rig: C poses.
        rig_from_board: F poses, of the board about its middle (see `BoardViews`).
        warp: [2] metres, how far the board's middle line bows along x and along y.
        motion: of the board between the views of a frame; None where cameras are simultaneous.
    """

    model: str
    params: np.ndarray
    camera_from_rig: Rigid
    rig_from_board: Rigid
    warp: np.ndarray
    motion: Motion | None = None

    @property
    def intrinsics(self) -> np.ndarray:
        """Of `geometry.lens`, [C, 12]."""
        return self.params @ expansion(self.model).T

    @property
    def head_size(self) -> int:
        """Number of unknowns that are not board poses."""
        return self.params.size + 6 * len(self.params) + 2

    def camera_slice(self, camera: int) -> np.ndarray:
        """Where a camera's parameters and pose stand in the head, [n + 6]."""
        cameras, n = self.params.shape
        pose = cameras * n + 6 * camera
        return np.concatenate([np.arange(camera * n, camera * n + n), np.arange(pose, pose + 6)])

    def head_name(self, index: int, camera_ids: tuple[str, ...]) -> str:
        """Name one entry of the head for a message."""
        cameras, n = self.params.shape
        if index < cameras * n:
            return f"{CAMERA_MODELS[self.model][index % n]} of camera '{camera_ids[index // n]}'"
        index -= cameras * n
        if index < 6 * cameras:
            part = "rotation" if index % 6 < 3 else "position"
            return f"the {part} of camera '{camera_ids[index // 6]}'"
        return "the board's warp"

    def as_model(self, model: str) -> RigState:
        """Return the nearest parameters of another model."""
        params = self.intrinsics @ np.linalg.pinv(expansion(model)).T
        return replace(self, model=model, params=params)

    def moved(self, head: np.ndarray, tail: np.ndarray) -> RigState:
        """Take a step: head [Nh], tail [F, 6]."""
        cameras, n = self.params.shape
        poses = head[cameras * n : -2].reshape(cameras, 6)
        return replace(
            self,
            params=self.params + head[: cameras * n].reshape(cameras, n),
            camera_from_rig=turned(self.camera_from_rig, poses),
            rig_from_board=turned(self.rig_from_board, tail),
            warp=self.warp + head[-2:],
        )

    def camera_from_board(self, views: BoardViews) -> Rigid:
        """The board's pose in each view, V poses."""
        rigid = self.camera_from_board_at_rest(views)
        return rigid if self.motion is None else self.motion.apply(views, rigid)

    def camera_from_board_at_rest(self, views: BoardViews) -> Rigid:
        """The pose in each view [V] that its frame gives the board, motion apart."""
        camera = Rigid(
            self.camera_from_rig.rotation[views.camera], self.camera_from_rig.translation[views.camera]
        )
        board = Rigid(self.rig_from_board.rotation[views.frame], self.rig_from_board.translation[views.frame])
        return camera @ board


def free_head(
    state: RigState, fixed: tuple[str, ...] = (), poses: bool = True, warp: bool = False
) -> np.ndarray:
    """Say which unknowns of the head a solve may change, [Nh]; the first camera's pose is the rig frame.

    Args:
        state: for its sizes.
        fixed: names of camera parameters that stay as they are.
        poses: whether the other cameras' poses change.
        warp: whether the board's warp changes.
    """
    cameras = len(state.params)
    params = np.array([name not in fixed for name in CAMERA_MODELS[state.model]])
    pose = np.repeat(np.arange(cameras) > 0, 6) & poses
    return np.concatenate([np.tile(params, cameras), pose, (warp, warp)])
