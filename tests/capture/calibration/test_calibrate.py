"""What `calibrate_rig` promises: the truth within its own uncertainty, outliers named, models chosen."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bench.calibration_scene import Scene, SceneConfig, simulate
from preface.capture.calibration import Calibration, CalibrationError, CalibrationOptions, calibrate_rig
from preface.capture.rig import read_rig, write_rig

SMALL = SceneConfig(cameras=4, frames=12, azimuth=40, width=1024, height=1536, focal=3400, outliers=0.05)
PLAIN = CalibrationOptions(camera_model="OPENCV", board_warp="off")


@cache
def solved(config: SceneConfig = SMALL, options: CalibrationOptions = PLAIN) -> tuple[Scene, Calibration]:
    scene = simulate(config, 0)
    return scene, calibrate_rig(scene.observations, options)


def params_in_sigmas(scene: Scene, found: Calibration) -> np.ndarray:
    true = np.stack([camera.params for camera in scene.cameras])
    params = np.stack([camera.params for camera in found.cameras])
    return (params - true) / found.uncertainty.standard_deviations[0]


def test_parameters_and_poses_are_within_their_uncertainty():
    scene, found = solved()
    assert np.abs(params_in_sigmas(scene, found)).max() < 4
    _, rotation, translation = found.uncertainty.standard_deviations
    shift = found.camera_from_rig.translation - scene.camera_from_rig.translation
    assert (np.abs(shift[1:]) < 4.5 * translation[1:]).all()
    np.testing.assert_allclose(shift[0], 0, atol=1e-12)
    assert not rotation[0].any()


def test_noise_is_estimated():
    scene, found = solved()
    assert found.uncertainty.sigma == pytest.approx(scene.config.noise, rel=0.05)


def test_every_outlier_is_left_out_and_good_corners_are_kept():
    scene, found = solved()
    assert not (found.inliers & scene.outlier).any()
    assert (~found.inliers & ~scene.outlier).sum() <= 0.002 * len(scene.outlier)


def test_board_poses_are_those_of_the_boards_own_origin():
    scene, found = solved()
    for index, frame in enumerate(scene.observations.frame_ids):
        if frame in found.rig_from_board:
            error = found.rig_from_board[frame].translation - scene.rig_from_board.translation[index]
            assert np.linalg.norm(error) < 0.01


def test_residuals_are_those_of_the_result():
    _, found = solved()
    seen = found.observations
    for camera in range(len(found.cameras)):
        mine = np.flatnonzero(seen.camera == camera)[::37]
        for index in mine:
            pose = found.rig_from_board[seen.frame_ids[seen.frame[index]]]
            point = pose.apply(seen.board_points[seen.point[index]])
            in_camera = (
                found.camera_from_rig.rotation[camera] @ point + found.camera_from_rig.translation[camera]
            )
            pixel, _ = found.cameras[camera].project(in_camera)
            np.testing.assert_allclose(found.residuals[index], pixel - seen.pixels[index], atol=1e-6)


def test_rig_artefact_is_written_and_read(tmp_path):
    _, found = solved()
    write_rig(tmp_path / "rig.json", found.rig("take-1"))
    rig = read_rig(tmp_path / "rig.json")
    assert list(rig.cameras) == list(found.observations.camera_ids)
    assert rig.held_out_reprojection_error == found.held_out
    first = rig.cameras["C01"]
    assert len(first.covariance) == 14
    assert first.reprojection_error.rms == pytest.approx(0.28, rel=0.1)


def test_held_out_error_exceeds_the_training_error_slightly():
    _, found = solved()
    assert found.reprojection_rms < found.held_out.rms < 1.15 * found.reprojection_rms


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((0, 0, 0, 0), {"PINHOLE", "SIMPLE_RADIAL"}),
        ((-0.3, 0, 0, 0), {"SIMPLE_RADIAL"}),
        ((-0.2, 0.1, 4e-3, -4e-3), {"OPENCV"}),
    ],
)
def test_auto_chooses_the_simplest_sufficient_model(distortion, model):
    config = replace(SMALL, distortion=distortion, azimuth=25, aspect=0.0)
    _, found = solved(config, CalibrationOptions(folds=3))
    assert found.cameras[0].model in model
    assert not found.board_warp.any()
    assert len(found.selection) == 10
    assert sum(candidate.chosen for candidate in found.selection) == 1


def test_auto_bends_a_bowed_board():
    config = replace(SMALL, bow=(1e-3, 5e-4), azimuth=25)
    scene, found = solved(config, CalibrationOptions(camera_model="OPENCV", folds=3))
    assert found.board_warp == pytest.approx(config.bow, abs=5e-5)
    assert np.abs(params_in_sigmas(scene, found)).max() < 4


def test_half_of_the_corners_may_be_wrong():
    scene, found = solved(replace(SMALL, outliers=0.5, frames=20))
    assert not (found.inliers & scene.outlier).any()
    assert np.abs(params_in_sigmas(scene, found)).max() < 4.5


WAVED = SceneConfig(
    cameras=4,
    frames=40,
    width=1280,
    height=720,
    focal=900,
    columns=4,
    rows=5,
    spacing=0.05,
    noise=0.05,
    lag=0.04,
)


def test_a_rig_that_is_triggered_together_shows_no_motion():
    scene, found = solved()
    assert found.sigma_alone == pytest.approx(scene.config.noise, rel=0.05)
    assert found.motion is None
    assert not found.warnings
    assert np.array_equal(found.residuals, found.residuals_at_rest, equal_nan=True)


def test_cameras_that_are_not_simultaneous_are_calibrated_all_the_same():
    scene, found = solved(WAVED)
    assert "same instant" in found.warnings[0]
    assert found.motion is not None
    turn, shift = found.motion
    # Speeds are spread evenly up to their maximum, along three axes.
    assert shift == pytest.approx(WAVED.lag * WAVED.speed / 3, rel=0.4)
    assert turn == pytest.approx(WAVED.lag * WAVED.spin / 3, rel=0.4)
    assert found.uncertainty.sigma == pytest.approx(WAVED.noise, rel=0.1)
    assert found.reprojection_rms == pytest.approx(WAVED.noise * np.sqrt(2), rel=0.1)
    assert found.reprojection_rms_at_rest > 5 * found.reprojection_rms
    assert np.abs(params_in_sigmas(scene, found)).max() < 4.5
    shift = found.camera_from_rig.translation - scene.camera_from_rig.translation
    assert (np.abs(shift[1:]) < 4.5 * found.uncertainty.standard_deviations[2][1:]).all()


def test_motion_within_frames_is_written_with_the_rig():
    _, found = solved(WAVED)
    motion = found.rig("take-1").metadata["motion_within_frames"]
    assert (motion["rotation"], motion["translation"]) == found.motion
    assert motion["reprojection_rms_at_rest"] == found.reprojection_rms_at_rest


def test_a_lens_that_would_fold_in_unseen_corners_loses_a_coefficient():
    config = SceneConfig(
        cameras=3,
        frames=24,
        azimuth=30,
        width=1280,
        height=720,
        focal=700,
        columns=4,
        rows=5,
        spacing=0.03,
        noise=0.1,
        distortion=(0.05, 0, 0, 0),
        distance=0.9,
        tilt=45,
    )
    scene = simulate(config, 0)
    seen = scene.observations
    in_the_middle = np.linalg.norm(seen.pixels - np.array((640, 360)), axis=1) < 230
    found = calibrate_rig(seen.subset(in_the_middle), PLAIN)
    assert not any(camera.folds_inside_image() for camera in found.cameras)
    held = np.array([camera.params[5] == 0 for camera in found.cameras])
    assert held.tolist() == [False, True, False]
    assert np.array_equal(found.uncertainty.standard_deviations[0][:, 5] == 0, held)
    focal = np.stack([camera.params[:2] for camera in scene.cameras])
    error = np.stack([camera.params[:2] for camera in found.cameras]) - focal
    assert (np.abs(error) < 4 * found.uncertainty.standard_deviations[0][:, :2]).all()


def test_a_calibration_that_starts_from_another_take_gives_the_same_rig():
    scene, cold = solved()
    warm = calibrate_rig(scene.observations, PLAIN, cold)
    sigmas = cold.uncertainty.standard_deviations[0]
    for one, other, sigma in zip(cold.cameras, warm.cameras, sigmas, strict=True):
        assert (np.abs(one.params - other.params) < 0.02 * sigma).all()


def test_lenses_of_another_take_are_dropped_where_they_contradict():
    scene, cold = solved()
    zoomed = tuple(
        replace(camera, params=camera.params * np.array([2, 2, 1, 1, 1, 1, 1, 1])) for camera in cold.cameras
    )
    warm = calibrate_rig(scene.observations, PLAIN, replace(cold, cameras=zoomed))
    assert np.abs(params_in_sigmas(scene, warm)).max() < 4


def test_unknown_model_is_refused():
    with pytest.raises(CalibrationError, match=r"camera_model: 'FISHEYE'.*OPENCV"):
        CalibrationOptions(camera_model="FISHEYE")


def test_pycolmap_agrees():
    pytest.importorskip("pycolmap")
    _, own = solved()
    _, other = solved(SMALL, replace(PLAIN, backend="pycolmap"))
    deviation = own.uncertainty.standard_deviations
    for mine, theirs, sigma in zip(own.cameras, other.cameras, deviation[0], strict=True):
        assert (np.abs(mine.params - theirs.params) < 0.05 * sigma).all()
    shift = np.abs(own.camera_from_rig.translation - other.camera_from_rig.translation)[1:]
    assert (shift < 0.05 * deviation[2][1:]).all()
    assert np.array_equal(own.inliers, other.inliers)
