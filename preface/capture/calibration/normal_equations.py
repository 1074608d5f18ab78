"""Residuals, their analytic Jacobian, and the normal equations by blocks.

The board pose in a view depends on six numbers only, so that the Jacobian is formed for those (n + 6 + 2
columns per view), squared per view, and carried over to the camera's and the frame's pose by 6x6 adjoints.
Frames do not meet one another, hence leave by the Schur complement (Triggs et al., "Bundle Adjustment: a
Modern Synthesis", 2000, section 6.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from preface.capture.calibration.motion import Elimination, eliminate
from preface.capture.calibration.state import RigState, expansion
from preface.capture.calibration.views import BoardViews
from preface.geometry import lens
from preface.geometry.lens import INTRINSICS


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """J'J and J'r of a weighted problem, by head and frames.

    Attributes:
        head: [Nh, Nh].
        frames: [F, 6, 6].
        cross: [F, 6, Nh].
        head_gradient: [Nh].
        frame_gradient: [F, 6].
        moving: recovers the motion within frames from the rest, given a whole head; None without any.
    """

    head: np.ndarray
    frames: np.ndarray
    cross: np.ndarray
    head_gradient: np.ndarray
    frame_gradient: np.ndarray
    moving: _Moving | None = None

    def restricted(self, free: np.ndarray) -> NormalEquations:
        """Return the equations of the free entries of the head, by mask [Nh]."""
        return NormalEquations(
            self.head[np.ix_(free, free)],
            self.frames,
            self.cross[..., free],
            self.head_gradient[free],
            self.frame_gradient,
            self.moving,
        )

    def step(self, damping: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Solve for the step that Marquardt's damping allows.

        Returns:
            the step of the head, that of the frames, and the decrease of half the cost that a linear
            problem would show.

        Raises:
            numpy.linalg.LinAlgError: the damped system is not positive definite.
        """
        head_scale, frame_scale = _diagonal(self.head), _diagonal(self.frames)
        frames = self.frames + damping * frame_scale[..., None] * np.eye(6)
        head = self.head + np.diag(damping * head_scale)
        # Frames and head entries that nothing observes have no curvature at all: give them some.
        frames = frames + (np.einsum("fii->fi", self.frames) == 0)[..., None] * np.eye(6)
        head = head + np.diag(np.where(np.diag(self.head) == 0, 1.0, 0.0))
        eliminated = _solve_frames(
            frames, np.concatenate([self.cross, self.frame_gradient[..., None]], axis=-1)
        )
        by_head, by_gradient = eliminated[..., :-1], eliminated[..., -1]
        count = len(head)
        flat = self.cross.reshape(frames.shape[0] * 6, count)
        reduced = head - flat.T @ by_head.reshape(flat.shape)
        gradient = self.head_gradient - flat.T @ by_gradient.ravel()
        head_step = np.zeros(count)
        if count:
            scale = 1 / np.sqrt(_diagonal(head))
            scaled = reduced * scale[:, None] * scale
            np.linalg.cholesky(scaled)  # raises unless positive definite
            # Not scipy's cho_solve: its BLAS keeps threads of its own, and the two pools wait for each other.
            head_step = -scale * np.linalg.solve(scaled, scale * gradient)
        frame_step = -by_gradient - by_head @ head_step
        slope = head_step @ self.head_gradient + (frame_step * self.frame_gradient).sum()
        damped = head_step @ (head_scale * head_step) + (frame_scale * frame_step**2).sum()
        alone = self.moving.elimination.gain if self.moving else 0.0
        return head_step, frame_step, alone + float(0.5 * (damping * damped - slope))

    def view_step(self, head_step: np.ndarray, frame_step: np.ndarray) -> np.ndarray:
        """The step [V, 6] of the motion within frames beside steps of the whole head [Nh] and frames [F, 6]."""
        at = self.moving
        if at is None:
            raise ValueError("the board does not move within frames")
        rows = (at.of_head @ head_step[at.head_index][..., None])[..., 0]
        n = rows.shape[1] - 9
        rows[:, n : n + 6] += (at.of_frame @ frame_step[at.frame][..., None])[..., 0]
        return -at.elimination.constant - (at.elimination.by_rows @ rows[:, :-1, None])[..., 0]


class _Moving(NamedTuple):
    """The motion's elimination, and how a view's rows follow from head and frame (see `_adjoints`)."""

    elimination: Elimination
    of_head: np.ndarray
    of_frame: np.ndarray
    head_index: np.ndarray
    frame: np.ndarray


def _diagonal(matrix: np.ndarray) -> np.ndarray:
    """Diagonals [..., n] of [..., n, n], 1 where they are zero."""
    diagonal = np.einsum("...ii->...i", matrix)
    return np.where(diagonal > 0, diagonal, 1.0)


def _solve_frames(frames: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve symmetric 6x6 systems after scaling their unlike units away."""
    scale = 1 / np.sqrt(_diagonal(frames))
    scaled = frames * scale[..., None] * scale[..., None, :]
    return scale[..., None] * (np.linalg.inv(scaled) @ (scale[..., None] * right))


def board_shape(views: BoardViews, warp: np.ndarray) -> np.ndarray:
    """The warped board's points [P, 3] about its middle."""
    shape = views.points.copy()
    shape[:, 2] += views.bow @ warp
    return shape


def residuals(views: BoardViews, state: RigState) -> np.ndarray:
    """Projected minus measured pixels [V, P, 2]; NaN behind a camera or past its lens's fold."""
    return _evaluate(views, state).residual


@lens.quietly
def linearise(views: BoardViews, state: RigState) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals [V, P, 2], and rows [V, n + 9, 2, P]: their derivatives by params, board pose and warp,
    and the residuals once more.

    The same numbers as `lens.projection_jacobians` and the chain rule give, written column by column.
    """
    at = _evaluate(views, state)
    fx, fy = at.intrinsics[..., 0], at.intrinsics[..., 1]
    n = state.params.shape[1]
    rows = np.zeros((len(views), n + 9, 2, len(views.points)))
    for intrinsic, param in np.argwhere(expansion(state.model)):
        by_x, by_y = _by_intrinsic(INTRINSICS[intrinsic], at)
        rows[:, param, 0] += by_x
        rows[:, param, 1] += by_y
    x_per_z, y_per_z = fx / at.z, fy / at.z
    by_point = (
        (x_per_z * at.lens.xx, x_per_z * at.lens.xy),
        (y_per_z * at.lens.xy, y_per_z * at.lens.yy),
    )
    qx, qy, qz = (at.turned[:, i] for i in range(3))
    for row, (by_x, by_y) in enumerate(by_point):
        by_z = -(by_x * at.x + by_y * at.y)
        # A turn w about the board's middle moves a point by w x q, hence a pixel by w . (q x row).
        rows[:, n, row] = qy * by_z - qz * by_y
        rows[:, n + 1, row] = qz * by_x - qx * by_z
        rows[:, n + 2, row] = qx * by_y - qy * by_x
        rows[:, n + 3, row], rows[:, n + 4, row], rows[:, n + 5, row] = by_x, by_y, by_z
        nx, ny, nz = (at.normal[:, i, None] for i in range(3))
        raised = by_x * nx + by_y * ny + by_z * nz
        rows[:, n + 6, row] = raised * views.bow[:, 0]
        rows[:, n + 7, row] = raised * views.bow[:, 1]
    rows[:, n + 8] = np.moveaxis(at.residual, -1, 1)
    return at.residual, rows


class _Evaluated(NamedTuple):
    """Everything about [V, P] points that residuals and derivatives share."""

    intrinsics: np.ndarray  # [V, 1, 12]
    turned: np.ndarray  # [V, 3, P], the board about its middle along the camera's axes
    normal: np.ndarray  # [V, 3], the board's z there
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    lens: lens.Distorted
    residual: np.ndarray  # [V, P, 2]


@lens.quietly
def _evaluate(views: BoardViews, state: RigState) -> _Evaluated:
    poses = state.camera_from_board(views)
    turned = poses.rotation @ board_shape(views, state.warp).T
    x, y, z = (turned[:, i] + poses.translation[:, i, None] for i in range(3))
    x, y = x / z, y / z
    intrinsics = state.intrinsics
    radius = lens.monotonic_radius(intrinsics)[views.camera, None]
    intrinsics = intrinsics[views.camera, None]
    seen = lens.distort(intrinsics, x, y)
    fx, fy, cx, cy = (intrinsics[..., i] for i in range(4))
    projected = np.stack([fx * seen.x + cx, fy * seen.y + cy], axis=-1)
    valid = (z > 0) & (x * x + y * y < radius * radius)
    projected[~valid] = np.nan
    return _Evaluated(intrinsics, turned, poses.rotation[:, :, 2], x, y, z, seen, projected - views.pixels)


def _by_intrinsic(name: str, at: _Evaluated) -> tuple[np.ndarray | float, np.ndarray | float]:
    """Derivatives of both pixel coordinates [V, P] by one of the twelve intrinsics."""
    fx, fy = at.intrinsics[..., 0], at.intrinsics[..., 1]
    x, y = at.x, at.y
    if name in ("fx", "fy", "cx", "cy"):
        entries = {"fx": (at.lens.x, 0.0), "fy": (0.0, at.lens.y), "cx": (1.0, 0.0), "cy": (0.0, 1.0)}
        return entries[name]
    u = x * x + y * y
    if name == "p1":
        return 2 * fx * x * y, fy * (u + 2 * y * y)
    if name == "p2":
        return fx * (u + 2 * x * x), 2 * fy * x * y
    k1, k2, k3, k4, k5, k6 = (at.intrinsics[..., i] for i in (4, 5, 8, 9, 10, 11))
    power = u ** (1 + (int(name[1]) - 1) % 3)
    if at.intrinsics[..., 9:].any():
        denominator = 1 + u * (k4 + u * (k5 + u * k6))
        power = power / denominator
        if name in ("k4", "k5", "k6"):
            power = -power * (1 + u * (k1 + u * (k2 + u * k3))) / denominator
    elif name in ("k4", "k5", "k6"):
        power = -power * (1 + u * (k1 + u * (k2 + u * k3)))
    return fx * x * power, fy * y * power


def normal_equations(
    views: BoardViews, state: RigState, rows: np.ndarray, weights: np.ndarray
) -> NormalEquations:
    """Gather J'WJ and J'Wr from the rows of `linearise` with weights [V, P]; those of weight 0 may be NaN."""
    if not np.isfinite(rows[:, -1]).all():
        rows = np.where(weights[:, None, None] > 0, rows, 0.0)
    rows = (rows * np.sqrt(weights)[:, None, None]).reshape(*rows.shape[:2], -1)
    squared = rows @ np.swapaxes(rows, -1, -2)  # [V, n + 9, n + 9]

    cameras, n = state.params.shape
    of_head, of_frame = _adjoints(views, state)
    index = _head_index(views, cameras, n)
    moving = None
    if state.motion:
        squared, elimination = eliminate(views, state.motion, squared, slice(n, n + 6))
        moving = _Moving(elimination, of_head, of_frame, index, views.frame)
    by_head = np.swapaxes(of_head, -1, -2) @ squared  # [V, n + 8, n + 9]
    by_frame = np.swapaxes(of_frame, -1, -2) @ squared[:, n : n + 6]  # [V, 6, n + 9]
    size = state.head_size
    head, gradient = np.zeros((size, size)), np.zeros(size)
    frames, cross = np.zeros((views.frames, 6, 6)), np.zeros((views.frames, 6, size))
    frame_gradient = np.zeros((views.frames, 6))
    np.add.at(head, (index[:, :, None], index[:, None, :]), by_head @ of_head)
    np.add.at(gradient, index, by_head[..., -1])
    np.add.at(frames, views.frame, by_frame[..., n : n + 6] @ of_frame)
    six = np.arange(6)[:, None]
    np.add.at(cross, (views.frame[:, None, None], six, index[:, None, :]), by_frame @ of_head)
    np.add.at(frame_gradient, views.frame, by_frame[..., -1])
    return NormalEquations(head, frames, cross, gradient, frame_gradient, moving)


def _adjoints(views: BoardViews, state: RigState) -> tuple[np.ndarray, np.ndarray]:
    """How a view's unknowns (params, board pose, warp, and the residual) follow from head and frame.

    Returns:
        [V, n + 9, n + 8] by the head's entries of this view, and [V, 6, 6] of the board pose by the frame's.
    """
    rotation = state.camera_from_rig.rotation[views.camera]
    lever = np.einsum("vij,vj->vi", rotation, state.rig_from_board.translation[views.frame])
    n = state.params.shape[1]
    head = np.zeros((len(views), n + 9, n + 8))
    head[:, : n + 8] = np.eye(n + 8)
    head[:, n + 3 : n + 6, n : n + 3] = -cross_matrix(lever)
    frame = np.zeros((len(views), 6, 6))
    frame[:, :3, :3] = frame[:, 3:, 3:] = rotation
    if state.motion:
        turns = state.motion.turns(views)
        head[:, n : n + 3, n : n + 3] = turns
        frame[:, :3, :3] = turns @ rotation
    return head, frame


def _head_index(views: BoardViews, cameras: int, n: int) -> np.ndarray:
    """Where the columns of a view's Jacobian stand in the head, [V, n + 8]."""
    camera = views.camera[:, None]
    warp = np.broadcast_to(cameras * (n + 6) + np.arange(2), (len(views), 2))
    return np.concatenate([camera * n + np.arange(n), cameras * n + 6 * camera + np.arange(6), warp], axis=1)


def cross_matrix(vectors: np.ndarray) -> np.ndarray:
    """Return [..., 3, 3] with matrix @ x = vector x x."""
    matrix = np.zeros((*vectors.shape, 3))
    x, y, z = (vectors[..., i] for i in range(3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix
