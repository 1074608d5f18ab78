"""The fast normal equations against the obvious ones: numerical derivatives, stacked row by row."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration_scene import SceneConfig, simulate
from preface.capture.calibration.motion import Motion, turned
from preface.capture.calibration.normal_equations import linearise, normal_equations, residuals
from preface.capture.calibration.state import RigState, expansion, free_head
from preface.capture.calibration.views import BoardViews, stack_views
from preface.geometry import CAMERA_MODELS, Rigid, lens

COEFFICIENTS = {
    "k": -0.1,
    "k1": -0.1,
    "k2": 0.3,
    "p1": 2e-3,
    "p2": -1e-3,
    "k3": -0.2,
    "k4": 0.1,
    "k5": 0.2,
    "k6": 0.1,
}


def problem(model: str) -> tuple[BoardViews, RigState]:
    scene = simulate(SceneConfig(cameras=3, frames=4, azimuth=30, width=1024, height=1536, focal=3400), 1)
    views, _ = stack_views(scene.observations)
    intrinsics = np.stack([camera.intrinsics for camera in scene.cameras])
    intrinsics[:, 4:] = 0
    params = intrinsics @ np.linalg.pinv(expansion(model)).T
    for index, name in enumerate(CAMERA_MODELS[model]):
        params[:, index] += COEFFICIENTS.get(name, 0)
    boards = scene.rig_from_board @ Rigid(np.eye(3), views.center)
    return views, RigState(model, params, scene.camera_from_rig, boards, np.array([1e-3, -2e-3]))


def numerical_jacobian(views: BoardViews, state: RigState) -> np.ndarray:
    """[V, P, 2, Nh + 6F] by central differences, each unknown stepped by about a millionth of a pixel's worth."""
    columns = []
    size = state.head_size
    by_head = np.abs(np.concatenate([np.tile(np.ones(state.params.shape[1]), len(state.params))]))
    for index in range(size + 6 * views.frames):
        step = 1e-6 if index >= by_head.size else 1e-5
        name = CAMERA_MODELS[state.model][index % state.params.shape[1]] if index < by_head.size else ""
        if name in ("f", "fx", "fy", "cx", "cy"):
            step = 1e-2
        change = np.zeros(size + 6 * views.frames)
        change[index] = step
        head, tail = change[:size], change[size:].reshape(-1, 6)
        ahead = residuals(views, state.moved(head, tail))
        behind = residuals(views, state.moved(-head, -tail))
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_normal_equations_equal_those_of_numerical_derivatives(model):
    views, state = problem(model)
    weights = views.seen * np.random.default_rng(0).random(views.seen.shape)
    _, rows = linearise(views, state)
    fast = normal_equations(views, state, rows, weights)

    dense = numerical_jacobian(views, state)
    hessian = np.einsum("vp,vpij,vpik->jk", weights, dense, dense)
    gradient = np.einsum("vp,vpi,vpij->j", weights, residuals(views, state), dense)
    scale = np.sqrt(np.where(np.diag(hessian) > 0, np.diag(hessian), 1))
    size = state.head_size
    tail = np.zeros((6 * views.frames, 6 * views.frames))
    for frame in range(views.frames):
        block = slice(6 * frame, 6 * frame + 6)
        tail[block, block] = fast.frames[frame]
    cross = fast.cross.reshape(-1, size)
    whole = np.block([[fast.head, cross.T], [cross, tail]])
    np.testing.assert_allclose(whole / np.outer(scale, scale), hessian / np.outer(scale, scale), atol=1e-6)
    found = np.concatenate([fast.head_gradient, fast.frame_gradient.ravel()])
    np.testing.assert_allclose(found / scale, gradient / scale, atol=1e-5)


def test_jacobian_by_intrinsics_is_that_of_the_lens():
    views, state = problem("FULL_OPENCV")
    _, rows = linearise(views, state)
    poses = state.camera_from_board(views)
    shape = views.points + np.pad((views.bow @ state.warp)[:, None], ((0, 0), (2, 0)))
    points = np.einsum("vij,pj->vpi", poses.rotation, shape) + poses.translation[:, None]
    intrinsics = state.intrinsics
    radius = lens.monotonic_radius(intrinsics)
    _, expected = lens.projection_jacobians(
        intrinsics[views.camera, None], radius[views.camera, None], points
    )
    np.testing.assert_allclose(np.moveaxis(rows[:, :12], (1, 2), (3, 2)), expected, rtol=1e-9, atol=1e-12)


def test_undamped_step_solves_the_whole_system():
    views, state = problem("OPENCV")
    _, rows = linearise(views, state)
    free = np.ones(state.head_size, bool)
    free[state.camera_slice(0)[-6:]] = False
    equations = normal_equations(views, state, rows, views.seen.astype(float)).restricted(free)
    head, tail, _ = equations.step(0.0)
    cross = np.einsum("fih,h->fi", equations.cross, head)
    np.testing.assert_allclose(
        cross + np.einsum("fij,fj->fi", equations.frames, tail),
        -equations.frame_gradient,
        atol=1e-6 * np.abs(equations.frame_gradient).max(),
    )
    np.testing.assert_allclose(
        equations.head @ head + np.einsum("fih,fi->h", equations.cross, tail),
        -equations.head_gradient,
        atol=1e-6 * np.abs(equations.head_gradient).max(),
    )


def test_steps_with_a_board_that_moves_in_each_view_are_those_of_the_whole_dense_problem():
    views, state = problem("OPENCV")
    rng = np.random.default_rng(1)
    rest = state.camera_from_board_at_rest(views)
    offsets = rng.normal(size=(len(views), 6)) * np.repeat((2e-3, 1e-3), 3)
    motion = Motion.between(views, rest, turned(rest, offsets))
    motion = motion.weighed(views, np.ones(len(views), bool), sigma=0.3)
    state = replace(state, motion=motion)
    free = free_head(state, warp=True)
    residual, rows = linearise(views, state)
    equations = normal_equations(views, state, rows, views.seen.astype(float))
    head, tail, ahead = equations.restricted(free).step(0.0)
    whole = np.zeros(state.head_size)
    whole[free] = head
    by_view = equations.view_step(whole, tail)

    used = np.bincount(views.frame, minlength=views.frames) > 0
    rigid = numerical_jacobian(views, state)[views.seen].reshape(-1, state.head_size + 6 * views.frames)
    columns = []
    for index in range(6 * len(views)):
        step = np.zeros(6 * len(views))
        step[index] = 1e-6
        there = [
            residuals(views, replace(state, motion=motion.moved(views, s.reshape(-1, 6))))
            for s in (step, -step)
        ]
        columns.append(((there[0] - there[1]) / 2e-6)[views.seen].ravel())
    keep = np.concatenate([free, np.repeat(used, 6)])
    prior = np.sqrt(motion.weights(views)).ravel()
    dense = np.block(
        [
            [rigid[:, keep], np.stack(columns, axis=-1)],
            [np.zeros((len(prior), keep.sum())), np.diag(prior)],
        ]
    )
    right = np.concatenate([residual[views.seen].ravel(), prior * motion.steps(views).ravel()])
    scale = 1 / np.linalg.norm(dense, axis=0)
    expected = -scale * np.linalg.lstsq(dense * scale, right, rcond=None)[0]
    found = np.concatenate([head, tail[used].ravel(), by_view.ravel()])
    np.testing.assert_allclose(found / scale, expected / scale, atol=2e-4 * np.abs(expected / scale).max())
    gained = (right**2).sum() - ((right + dense @ found) ** 2).sum()
    assert 2 * ahead == pytest.approx(gained, rel=1e-4)
