"""How well a calibration is known: covariances from the final normal equations, and what follows from them.

A rig can be turned and shifted as a whole without changing any image (the gauge). Its covariance therefore
depends on what is held still, the datum:

- "first camera": the rig's frame is that camera's; what `rig.json` stores. All uncertainty of that camera
  shows up in the others.
- "cameras": the rig is turned and shifted for the least sum of squared motions of the camera centres.
- "boards": the same for the boards' corners over all frames, thus for the volume that was calibrated.

The last two are free of the gauge: no camera is special. (The S-transform of Baarda, 1973.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.normal_equations import (
    NormalEquations,
    board_shape,
    cross_matrix,
    linearise,
    normal_equations,
)
from preface.capture.calibration.state import RigState, expansion
from preface.capture.calibration.views import BoardViews
from preface.geometry import lens
from preface.geometry.cameras import CAMERA_MODELS

Datum = Literal["first camera", "cameras", "boards"]
# Below this share of its uncoupled curvature, a direction's curvature is rounding.
SINGULAR = 1e-11


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariances of a calibration under one datum.

    Attributes:
        state: where the problem was linearised.
        sigma: standard deviation of each pixel coordinate, estimated from the residuals.
        head: [Nh, Nh], in the order of `RigState`; zero where an unknown was held fixed.
        boards: [F, 6, 6], of each board pose with the first camera as datum.
        shift: [6, Nh] and shift_noise [6, 6]: turn and shift of all boards that errors of the head, and those
            of the board poses themselves, amount to.
        datum: what is held still in `head`.
    """

    state: RigState
    sigma: float
    head: np.ndarray
    boards: np.ndarray
    shift: np.ndarray
    shift_noise: np.ndarray
    datum: Datum = "first camera"

    def camera(self, index: int) -> np.ndarray:
        """Covariance [n + 6, n + 6] of one camera: params, rotation (radians), translation (metres)."""
        where = self.state.camera_slice(index)
        return self.head[np.ix_(where, where)]

    @cached_property
    def standard_deviations(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of params [C, n], rotations [C, 3] (radians) and translations [C, 3] (metres)."""
        cameras, n = self.state.params.shape
        deviation = np.sqrt(np.maximum(np.diag(self.head), 0))
        poses = deviation[cameras * n : -2].reshape(cameras, 6)
        return deviation[: cameras * n].reshape(cameras, n), poses[:, :3], poses[:, 3:]

    @property
    def warp(self) -> np.ndarray:
        """Covariance [2, 2] of the board's warp, metres²."""
        return self.head[-2:, -2:]

    def intrinsics_correlation(self, index: int) -> np.ndarray:
        """Correlation [n, n] of one camera's parameters; 0 beside a parameter that was held fixed."""
        n = self.state.params.shape[1]
        covariance = self.camera(index)[:n, :n]
        deviation = np.sqrt(np.diag(covariance))
        scale = np.divide(1.0, deviation, out=np.zeros(n), where=deviation > 0)
        return covariance * scale[:, None] * scale

    def under(self, datum: Datum) -> Uncertainty:
        """Return the covariance of the head under another datum; only from the first camera's.

        Raises:
            CalibrationError: fewer than three cameras, or cameras in a line, cannot hold a rig still.
        """
        if self.datum != "first camera":
            raise ValueError(f"datum: already {self.datum!r}; ask the original")
        if datum == "first camera":
            return self
        gauge = gauge_motions(self.state)
        shift, noise = self.shift, self.shift_noise
        if datum == "cameras":
            shift, noise = _shift_of_centers(self.state), np.zeros((6, 6))
        project = np.eye(len(self.head)) - gauge @ shift
        head = project @ self.head @ project.T + gauge @ noise @ gauge.T
        return replace(self, head=head, datum=datum)

    def centers(self) -> np.ndarray:
        """Covariance [C, 3, 3] of the camera centres, metres²."""
        by_head = centers_by_head(self.state)
        return by_head @ self.head @ np.swapaxes(by_head, -1, -2)

    def points(
        self, points: np.ndarray, visible: np.ndarray, pixel_noise: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict the covariance of points that are triangulated by least squares.

        Args:
            points: [N, 3], rig frame, metres: keypoints, say, within the head's volume.
            visible: [N, C], which cameras see them.
            pixel_noise: standard deviation of their image coordinates, pixels.

        Returns:
            covariances [N, 3, 3] that the calibration and that the noise contribute; they add up. Infinite
            where fewer than two cameras see a point.
        """
        by_head, by_noise = points_by_head(self.state, points, visible)
        return by_head @ self.head @ np.swapaxes(by_head, -1, -2), pixel_noise**2 * by_noise

    def pixels(self, camera: int, pixels: np.ndarray, distance: float) -> np.ndarray:
        """Covariance of where a point appears that stands at a pixel and a distance, [..., 2, 2] pixels².

        The point is at rest in the rig's frame under this datum ("boards" is the one to ask for), so that an
        intrinsic error which the camera's pose makes up for there does not count. Far outside the calibrated
        distances it counts, as it should (mrcal's projection uncertainty). NaN where the lens sees nothing.
        """
        intrinsics = self.state.intrinsics[camera]
        radius = lens.monotonic_radius(intrinsics)
        normalised, _, valid = lens.unproject(intrinsics, radius, np.asarray(pixels, float))
        directions = np.concatenate([normalised, np.ones_like(normalised[..., :1])], axis=-1)
        points = distance * directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        points = np.where(valid[..., None], points, (0.0, 0.0, distance))
        by_camera = _pixel_by_camera(self.state, camera, points)
        covariance = by_camera @ self.camera(camera) @ np.swapaxes(by_camera, -1, -2)
        return np.where(valid[..., None, None], covariance, np.nan)


def uncertainty(
    views: BoardViews,
    state: RigState,
    used: np.ndarray,
    free: np.ndarray,
    camera_ids: tuple[str, ...],
    sigma: float | None = None,
) -> Uncertainty:
    """Derive covariances from the normal equations at a solution.

    Args:
        views, state, used, free: what the last least-squares solve ran over.
        camera_ids: for messages.
        sigma: the noise in pixels where it is known; estimated from the residuals otherwise.

    Raises:
        CalibrationError: the sightings leave a direction open; names the parameter that leans on it most.
    """
    residual, rows = linearise(views, state)
    equations = normal_equations(views, state, rows, used.astype(float))
    frames_used = np.bincount(views.frame, used.sum(axis=1), views.frames) > 0
    if sigma is None:
        unknowns = free.sum() + 6 * frames_used.sum() + _freedom_of_motion(views, equations, used)
        excess = 2 * used.sum() - unknowns
        if excess <= 0:
            raise CalibrationError(
                f"frames: {2 * used.sum()} coordinates for {unknowns:.0f} unknowns; "
                "show the board in more frames, or use a simpler camera model"
            )
        sigma = float(np.sqrt((residual[used] ** 2).sum() / excess))
    head = np.zeros((len(free), len(free)))
    head[np.ix_(free, free)], by_head = _inverse(equations.restricted(free), state, free, camera_ids)
    eliminated = np.zeros((views.frames, 6, len(free)))
    eliminated[..., free] = by_head
    inverse = _inverse_frames(equations.frames)
    boards = inverse + eliminated @ head @ np.swapaxes(eliminated, -1, -2)
    weights = _shift_of_boards(views, state, used)
    shift = -np.einsum("fij,fjk->ik", weights, eliminated)
    noise = np.einsum("fij,fjk,flk->il", weights, inverse, weights)
    square = sigma**2
    return Uncertainty(state, sigma, square * head, square * boards, shift, square * noise)


def _freedom_of_motion(views: BoardViews, equations: NormalEquations, used: np.ndarray) -> float:
    """How many unknowns the motion within frames amounts to beside the poses of the frames."""
    if equations.moving is None:
        return 0.0
    views_of_frame = np.bincount(views.frame, used.any(axis=1), views.frames)[views.frame]
    # Of K views with poses of their own, one takes its frame's place.
    beyond = 1 - 1 / np.maximum(views_of_frame, 1)
    return float((equations.moving.elimination.freedom * beyond * used.any(axis=1)).sum())


def _inverse(
    equations: NormalEquations, state: RigState, free: np.ndarray, camera_ids: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse of the Schur complement, and V^-1 W [F, 6, N]."""
    by_head = _inverse_frames(equations.frames) @ equations.cross
    count = len(equations.head)
    flat = equations.cross.reshape(-1, count)
    reduced = equations.head - flat.T @ by_head.reshape(-1, count)
    diagonal = np.diag(equations.head)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = reduced * scale[:, None] * scale
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    if values[0] < SINGULAR:
        index = int(np.flatnonzero(free)[np.argmax(np.abs(vectors[:, 0]))])
        raise CalibrationError(
            f"{state.head_name(index, camera_ids)}: the boards do not determine it; tilt the board by 20 to "
            "40 degrees in several directions, cover the whole image, or use a simpler camera model"
        )
    inverse = (vectors / values) @ vectors.T
    return inverse * scale[:, None] * scale, by_head


def _inverse_frames(frames: np.ndarray) -> np.ndarray:
    """Invert [F, 6, 6]; zero for frames without sightings."""
    diagonal = np.einsum("fii->fi", frames)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = frames * scale[..., None] * scale[..., None, :]
    empty = (diagonal == 0).all(axis=1)
    scaled[empty] = np.eye(6)
    inverse = np.linalg.inv(scaled) * scale[..., None] * scale[..., None, :]
    inverse[empty] = 0
    return inverse


def gauge_motions(state: RigState) -> np.ndarray:
    """How the head changes when the rig's frame turns by w and shifts by d: X' = X + w x X + d, [Nh, 6]."""
    cameras, n = state.params.shape
    motions = np.zeros((cameras, 6, 6))
    motions[:, :3, :3] = motions[:, 3:, 3:] = -state.camera_from_rig.rotation
    return np.concatenate([np.zeros((cameras * n, 6)), motions.reshape(-1, 6), np.zeros((2, 6))])


def _motion_by_gauge(points: np.ndarray) -> np.ndarray:
    """Derivative [..., 3, 6] of points by w and d of w x X + d."""
    return np.concatenate([-cross_matrix(points), np.broadcast_to(np.eye(3), (*points.shape, 3))], axis=-1)


def centers_by_head(state: RigState) -> np.ndarray:
    """Derivative [C, 3, Nh] of the camera centres -R't."""
    cameras, n = state.params.shape
    back = np.swapaxes(state.camera_from_rig.rotation, -1, -2)
    by_pose = -np.concatenate([back @ cross_matrix(state.camera_from_rig.translation), back], axis=-1)
    by_head = np.zeros((cameras, 3, state.head_size))
    for camera in range(cameras):
        by_head[camera][:, state.camera_slice(camera)[n:]] = by_pose[camera]
    return by_head


def _shift_of_centers(state: RigState) -> np.ndarray:
    """Turn and shift [6, Nh] of all camera centres, in the least-squares sense."""
    by_gauge = _motion_by_gauge(state.camera_from_rig.inverse.translation).reshape(-1, 6)
    scale = 1 / np.maximum(np.linalg.norm(by_gauge, axis=0), 1e-300)
    if np.linalg.cond(by_gauge * scale) > 1e6:
        raise CalibrationError(
            "datum: fewer than three cameras, or cameras in a line, cannot hold a rig still; use 'boards'"
        )
    return np.linalg.pinv(by_gauge) @ centers_by_head(state).reshape(-1, state.head_size)


def _shift_of_boards(views: BoardViews, state: RigState, used: np.ndarray) -> np.ndarray:
    """Weights [F, 6, 6] by which the errors of board poses make up a turn and shift of all boards."""
    seen = np.bincount(views.frame, used.sum(axis=1), views.frames) > 0
    turned = board_shape(views, state.warp) @ np.swapaxes(state.rig_from_board.rotation, -1, -2)
    points = turned + state.rig_from_board.translation[:, None]
    by_gauge = _motion_by_gauge(points) * seen[:, None, None, None]
    normal = np.einsum("fpij,fpik->jk", by_gauge, by_gauge)
    return np.linalg.solve(normal, np.einsum("fpij,fpik->fjk", by_gauge, _motion_by_gauge(turned)))


def _pixel_by_camera(state: RigState, camera: int, points: np.ndarray) -> np.ndarray:
    """Derivative [..., 2, n + 6] of the pixels of points [..., 3] (camera frame) by params and pose."""
    intrinsics = state.intrinsics[camera]
    by_point, by_intrinsics = lens.projection_jacobians(intrinsics, lens.monotonic_radius(intrinsics), points)
    about = points - state.camera_from_rig.translation[camera]  # a pose turns R X, not R X + t
    return np.concatenate(
        [by_intrinsics @ expansion(state.model), by_point @ -cross_matrix(about), by_point], axis=-1
    )


def points_by_head(state: RigState, points: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate least-squares triangulation by the head.

    Args:
        points: [N, 3], rig frame.
        visible: [N, C].

    Returns:
        [N, 3, Nh], and the covariance [N, 3, 3] for measurements of one pixel's standard deviation; zero and
        infinite where fewer than two cameras see a point.
    """
    normal, mixed = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, state.head_size))
    count = np.zeros(len(points), int)
    radius = lens.monotonic_radius(state.intrinsics)
    for camera in range(len(state.params)):
        rotation = state.camera_from_rig.rotation[camera]
        in_camera = points @ rotation.T + state.camera_from_rig.translation[camera]
        _, valid = lens.project(state.intrinsics[camera], radius[camera], in_camera)
        valid &= visible[:, camera]
        by_point, _ = lens.projection_jacobians(state.intrinsics[camera], radius[camera], in_camera)
        by_camera = _pixel_by_camera(state, camera, in_camera)
        by_rig_point = np.where(valid[:, None, None], by_point @ rotation, 0.0)
        by_camera = np.where(valid[:, None, None], by_camera, 0.0)
        normal += np.swapaxes(by_rig_point, -1, -2) @ by_rig_point
        mixed[..., state.camera_slice(camera)] += np.swapaxes(by_rig_point, -1, -2) @ by_camera
        count += valid
    enough = count >= 2
    normal[~enough] = np.eye(3)
    covariance = np.where(enough[:, None, None], np.linalg.inv(normal), np.diag([np.inf] * 3))
    by_head = -np.linalg.solve(normal, mixed)
    by_head[~enough] = 0
    return by_head, covariance


def parameter_names(model: str) -> tuple[str, ...]:
    """Names of a camera's rows in `Uncertainty.camera`."""
    pose = tuple(f"{part}_{axis}" for part in ("rotation", "translation") for axis in "xyz")
    return (*CAMERA_MODELS[model], *pose)
