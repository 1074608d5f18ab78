"""A simulated calibration and its truth: the problem, its start, its errors, and the least errors possible.

The bound is the covariance of the normal equations at the truth over the sightings that are no outliers, with
the true noise. Rigs have no frame of their own: an estimate is turned and shifted, but not scaled, so that its
camera centres lie nearest to the true ones, and the bound is taken under the same condition. Keypoints are
triangulated from exact images.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from bench.calibration_scene import Scene, SceneConfig, simulate
from preface.capture.calibration.adjustment import Adjusted, adjust_robustly
from preface.capture.calibration.covariance import Uncertainty, points_by_head, uncertainty
from preface.capture.calibration.initial import calibrate_alone
from preface.capture.calibration.spanning_tree import assemble
from preface.capture.calibration.state import RigState, free_head
from preface.capture.calibration.views import BoardViews, stack_views
from preface.geometry import Camera, Rigid, fit_similarity, lens

FIGURES = ("camera centre", "focal length", "keypoints")


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene, arranged for the solver."""

    scene: Scene
    views: BoardViews
    view_of: np.ndarray
    warp: bool

    @property
    def truth(self) -> RigState:
        """The true state."""
        boards = self.scene.rig_from_board @ Rigid(np.eye(3), self.views.center)
        params = np.stack([camera.params for camera in self.scene.cameras])
        return RigState("OPENCV", params, self.scene.camera_from_rig, boards, np.array(self.scene.config.bow))

    @property
    def good(self) -> np.ndarray:
        """Sightings [V, P] that are no outliers."""
        mask = np.zeros_like(self.views.seen)
        mask[self.view_of, self.scene.observations.point] = ~self.scene.outlier
        return mask


@dataclass(frozen=True, eq=False)
class Start:
    """Where a joint solve starts."""

    views: BoardViews
    state: RigState
    trusted: np.ndarray
    seconds: float


def problem(config: SceneConfig, seed: int, warp: bool = False) -> Problem:
    """Simulate and arrange."""
    scene = simulate(config, seed)
    return Problem(scene, *stack_views(scene.observations), warp)


def start(given: Problem) -> Start:
    """Everything before the joint solve."""
    began = time.perf_counter()
    seen = given.scene.observations
    alone = calibrate_alone(given.views, seen.camera_ids, seen.image_sizes, {})
    state, trusted = assemble(alone, seen.camera_ids, seen.image_sizes)
    return Start(alone.views, state.as_model("OPENCV"), trusted, time.perf_counter() - began)


def solve(given: Problem, begin: Start) -> tuple[Adjusted, float]:
    """The joint solve, and its wall time."""
    began = time.perf_counter()
    free = free_head(begin.state, warp=given.warp)
    found = adjust_robustly(begin.views, begin.state, begin.trusted, free)
    return found, time.perf_counter() - began


def bound(given: Problem) -> Uncertainty:
    """The Cramer-Rao bound over the good sightings, the camera centres held still."""
    state = given.truth
    free = free_head(state, warp=given.warp)
    ids = given.scene.observations.camera_ids
    return uncertainty(given.views, state, given.good, free, ids, sigma=given.scene.config.noise).under(
        "cameras"
    )


def bound_squares(given: Problem) -> np.ndarray:
    """Mean squared errors [3] that the bound allows, in the order of `FIGURES`."""
    known = bound(given)
    points = given.scene.keypoints
    visible = np.ones((len(points), len(given.scene.cameras)), bool)
    by_head, _ = points_by_head(known.state, points, visible)
    keypoints = by_head @ known.head @ np.swapaxes(by_head, -1, -2)
    focal = known.standard_deviations[0][:, :2] / known.state.params[:, :2]
    return np.array([_mean_trace(known.centers()), (focal**2).mean(), _mean_trace(keypoints)])


def squared_errors(given: Problem, state: RigState) -> np.ndarray:
    """Mean squared errors [3] against truth, metres² or relative, in the order of `FIGURES`."""
    truth = given.truth
    centers, true_centers = (s.camera_from_rig.inverse.translation for s in (state, truth))
    align = fit_similarity(centers, true_centers, fixed_scale=1.0).target_from_source
    focal = state.params[:, :2] / truth.params[:, :2] - 1
    found = triangulated(truth, state, given.scene.keypoints)
    return np.array(
        [
            ((align.apply(centers) - true_centers) ** 2).sum(-1).mean(),
            (focal**2).mean(),
            ((align.apply(found) - given.scene.keypoints) ** 2).sum(-1).mean(),
        ]
    )


def triangulated(truth: RigState, state: RigState, points: np.ndarray) -> np.ndarray:
    """Where a rig sees points [N, 3] whose images are exact: Gauss-Newton from the true places."""
    exact = []
    for params, pose in zip(truth.params, _each(truth.camera_from_rig), strict=True):
        exact.append(Camera("OPENCV", 1, 1, params).project(pose.apply(points))[0])
    found = points.copy()
    for _ in range(10):
        normal, gradient = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for params, pose, pixels in zip(state.params, _each(state.camera_from_rig), exact, strict=True):
            camera = Camera("OPENCV", 1, 1, params)
            radius = np.asarray(camera.monotonic_radius)
            by_point, _ = lens.projection_jacobians(camera.intrinsics, radius, pose.apply(found))
            by_point = by_point @ pose.rotation
            residual = camera.project(pose.apply(found))[0] - pixels
            normal += np.swapaxes(by_point, -1, -2) @ by_point
            gradient += (np.swapaxes(by_point, -1, -2) @ residual[..., None])[..., 0]
        found = found - np.linalg.solve(normal, gradient[..., None])[..., 0]
    return found


def _each(poses: Rigid) -> list[Rigid]:
    return [Rigid(r, t) for r, t in zip(poses.rotation, poses.translation, strict=True)]


def _mean_trace(covariances: np.ndarray) -> float:
    return float(np.trace(covariances, axis1=-2, axis2=-1).mean())
