"""Covariances against a dense inverse, against simulation, and under changes of the gauge."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration_scene import KEYPOINTS, SceneConfig, exact_pixels, noisy_again, simulate
from preface.capture.calibration.adjustment import minimise
from preface.capture.calibration.covariance import gauge_motions, points_by_head, uncertainty
from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.normal_equations import linearise, normal_equations
from preface.capture.calibration.state import RigState, free_head
from preface.capture.calibration.views import stack_views
from preface.geometry import Rigid

CONFIG = SceneConfig(cameras=3, frames=10, azimuth=35, width=1024, height=1536, focal=3400)


def solved(config: SceneConfig = CONFIG, seed: int = 0) -> tuple:
    scene = simulate(config, seed)
    views, _ = stack_views(scene.observations)
    params = np.stack([camera.params for camera in scene.cameras])
    boards = scene.rig_from_board @ Rigid(np.eye(3), views.center)
    state = RigState("OPENCV", params, scene.camera_from_rig, boards, np.zeros(2))
    return scene, views, state, free_head(state)


def test_covariance_is_the_inverse_of_the_dense_normal_matrix():
    scene, views, state, free = solved()
    known = uncertainty(views, state, views.seen, free, scene.observations.camera_ids, sigma=0.2)
    equations = normal_equations(
        views, state, linearise(views, state)[1], views.seen.astype(float)
    ).restricted(free)
    count = free.sum()
    dense = np.zeros((count + 6 * views.frames,) * 2)
    dense[:count, :count] = equations.head
    dense[count:, :count] = equations.cross.reshape(-1, count)
    dense[:count, count:] = dense[count:, :count].T
    for frame in range(views.frames):
        block = slice(count + 6 * frame, count + 6 * frame + 6)
        dense[block, block] = equations.frames[frame]
    seen = np.diag(dense) > 0
    scale = np.where(seen, 1 / np.sqrt(np.where(seen, np.diag(dense), 1)), 0)
    scaled = dense * np.outer(scale, scale) + np.diag(~seen * 1.0)
    inverse = 0.2**2 * np.linalg.inv(scaled) * np.outer(scale, scale)
    np.testing.assert_allclose(known.head[np.ix_(free, free)], inverse[:count, :count], rtol=1e-4, atol=1e-16)
    for frame in range(views.frames):
        block = slice(count + 6 * frame, count + 6 * frame + 6)
        np.testing.assert_allclose(known.boards[frame], inverse[block, block], rtol=1e-4, atol=1e-16)


@pytest.mark.parametrize("datum", ["cameras", "boards"])
def test_free_datum_does_not_depend_on_which_camera_comes_first(datum):
    scene, views, state, free = solved()
    names = scene.observations.camera_ids
    known = uncertainty(views, state, views.seen, free, names, sigma=0.2).under(datum)
    other_free = free.copy()
    n = state.params.shape[1]
    poses = 3 * n
    other_free[poses : poses + 6], other_free[poses + 12 : poses + 18] = True, False
    other = uncertainty(views, state, views.seen, other_free, names, sigma=0.2).under(datum)
    np.testing.assert_allclose(known.centers(), other.centers(), rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(known.camera(0), other.camera(0), rtol=1e-3, atol=1e-14)


def test_predicted_deviations_are_those_of_a_simulation():
    scene, views, state, free = solved()
    exact = replace(scene, observations=replace(scene.observations, pixels=exact_pixels(scene)))
    changes, runs = [], 80
    for run in range(runs):
        again, _ = stack_views(noisy_again(exact, 1000 + run).observations)
        found, _ = minimise(again, state, again.seen, free, tolerance=1e-7)
        changes.append(
            np.concatenate(
                [
                    (found.params - state.params).ravel(),
                    (found.camera_from_rig.translation - state.camera_from_rig.translation)[1:].ravel(),
                ]
            )
        )
    known = uncertainty(
        views, state, views.seen, free, scene.observations.camera_ids, sigma=scene.config.noise
    )
    params, _, translation = known.standard_deviations
    predicted = np.concatenate([params.ravel(), translation[1:].ravel()])
    ratio = predicted / np.sqrt(np.mean(np.square(changes), axis=0))
    # 80 runs know a standard deviation to 8%.
    assert np.median(ratio) == pytest.approx(1, abs=0.1)
    assert (np.abs(ratio - 1) < 0.3).all()


def test_keypoints_do_not_feel_a_motion_of_the_whole_rig_but_follow_it():
    scene, _, state, _ = solved()
    visible = np.ones((len(KEYPOINTS), 3), bool)
    by_head, _ = points_by_head(state, scene.keypoints, visible)
    turn, shift = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.2, -0.3])
    moved = by_head @ gauge_motions(state) @ np.concatenate([turn, shift])
    np.testing.assert_allclose(moved, np.cross(turn, scene.keypoints) + shift, atol=1e-9)


def test_points_that_one_camera_sees_are_unknown():
    scene, views, state, free = solved()
    known = uncertainty(views, state, views.seen, free, scene.observations.camera_ids)
    visible = np.zeros((len(KEYPOINTS), 3), bool)
    visible[:, 1] = True
    _, noise = known.points(scene.keypoints, visible, 0.2)
    assert np.isinf(np.diagonal(noise, axis1=1, axis2=2)).all()


def test_projection_uncertainty_is_least_where_boards_were_seen():
    scene, views, state, free = solved()
    known = uncertainty(views, state, views.seen, free, scene.observations.camera_ids).under("boards")
    pixels = np.array([[512.0, 768.0], [5.0, 5.0]])
    near = np.sqrt(np.trace(known.pixels(1, pixels, 1.0), axis1=-2, axis2=-1))
    far = np.sqrt(np.trace(known.pixels(1, pixels, 20.0), axis1=-2, axis2=-1))
    assert near[0] < 0.3
    assert near[0] < near[1]
    assert (far > near).all()


def test_correlation_of_intrinsics_is_one_on_the_diagonal():
    scene, views, state, free = solved()
    known = uncertainty(views, state, views.seen, free, scene.observations.camera_ids)
    correlation = known.intrinsics_correlation(2)
    np.testing.assert_allclose(np.diag(correlation), 1)
    assert (np.abs(correlation) <= 1 + 1e-9).all()


def test_two_cameras_cannot_hold_a_rig_still():
    scene, views, state, free = solved(replace(CONFIG, cameras=2))
    known = uncertainty(views, state, views.seen, free, scene.observations.camera_ids)
    with pytest.raises(CalibrationError, match="datum: fewer than three cameras"):
        known.under("cameras")
