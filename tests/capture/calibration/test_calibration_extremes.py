"""Captures at the edge of what a calibration can do: the right rig, or an error that says what is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration_scene import Scene, SceneConfig, simulate
from preface.capture.calibration import CalibrationError, CalibrationOptions, calibrate_rig
from preface.capture.observations import Observations

SMALL = SceneConfig(cameras=4, frames=12, azimuth=40, width=1024, height=1536, focal=3400, outliers=0.05)
PLAIN = CalibrationOptions(camera_model="OPENCV", board_warp="off")


def focal_in_sigmas(scene: Scene, observations: Observations | None = None) -> np.ndarray:
    found = calibrate_rig(observations or scene.observations, PLAIN)
    true = np.array([camera.params[0] for camera in scene.cameras])
    focal = np.array([camera.params[0] for camera in found.cameras])
    return (focal - true) / found.uncertainty.standard_deviations[0][:, 0]


@pytest.mark.parametrize("tilt", [0, 1, 2, 3, 4, 5])
def test_a_nearly_parallel_board_gives_no_confident_focal_length(tilt):
    single = replace(SMALL, cameras=1, azimuth=0.01, frames=15, partial=0.0, tilt=tilt)
    scene = simulate(single, 0)
    if tilt < 3:
        with pytest.raises(CalibrationError, match=r"'C00'.*tilt the board"):
            calibrate_rig(scene.observations, PLAIN)
        return
    refusal = ""
    try:
        error = np.abs(focal_in_sigmas(scene)).max()
    except CalibrationError as caught:
        refusal, error = str(caught), 0.0
    assert error < 4
    assert not refusal or "tilt the board by" in refusal


def test_auto_refuses_a_parallel_board_too():
    single = replace(SMALL, cameras=1, azimuth=0.01, frames=15, partial=0.0, tilt=0)
    with pytest.raises(CalibrationError, match=r"tilt the board|only known to"):
        calibrate_rig(simulate(single, 0).observations, CalibrationOptions(folds=2))


def test_two_cameras_one_degree_apart():
    assert np.abs(focal_in_sigmas(simulate(replace(SMALL, cameras=2, azimuth=0.5), 0))).max() < 4


def test_a_focal_length_of_100000_pixels():
    long = replace(SMALL, focal=1e5, distance=7.4, width=4096, height=6144)
    assert np.abs(focal_in_sigmas(simulate(long, 0))).max() < 4


def test_millimetres_give_the_same_rig_as_metres():
    metres = simulate(SMALL, 0)
    seen = metres.observations
    a = calibrate_rig(seen, PLAIN)
    b = calibrate_rig(replace(seen, board_points=1000 * seen.board_points), PLAIN)
    for first, second in zip(a.cameras, b.cameras, strict=True):
        np.testing.assert_allclose(first.params, second.params, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(
        1000 * a.camera_from_rig.translation, b.camera_from_rig.translation, rtol=1e-6, atol=1e-4
    )


def test_a_board_whose_origin_is_1000_kilometres_away():
    scene = simulate(SMALL, 0)
    seen = scene.observations
    assert np.abs(focal_in_sigmas(scene, replace(seen, board_points=seen.board_points + 1e6))).max() < 4


def test_exact_corners_are_all_kept():
    scene = simulate(replace(SMALL, noise=0.0, outliers=0.0), 0)
    found = calibrate_rig(scene.observations, PLAIN)
    assert found.inliers.all()
    assert found.cameras[0].params[0] == pytest.approx(scene.cameras[0].params[0], rel=1e-6)


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_too_few_frames_are_refused(frames):
    seen = simulate(SMALL, 0).observations
    few = seen.subset(seen.frame < frames)
    with pytest.raises(CalibrationError, match=r"no camera saw the board|takes 3 or more"):
        calibrate_rig(few, PLAIN)


def test_identical_frames_count_once():
    seen = simulate(SMALL, 0).observations
    one = seen.subset(seen.frame == 0)
    same = replace(
        one,
        camera=np.tile(one.camera, 12),
        frame=np.repeat(np.arange(12), len(one)),
        point=np.tile(one.point, 12),
        pixels=np.tile(one.pixels, (12, 1)),
    )
    with pytest.raises(CalibrationError, match="12 frames, of which 1 are different"):
        calibrate_rig(same, PLAIN)


def test_a_camera_that_never_sees_the_board_is_named():
    seen = simulate(SMALL, 0).observations
    with pytest.raises(CalibrationError, match="camera 'C02': it sees the board in no frame"):
        calibrate_rig(seen.subset(seen.camera != 2), PLAIN)


def test_disconnected_cameras_are_named_with_the_nearest_pair():
    seen = simulate(replace(SMALL, frames=20), 0).observations
    left, even = seen.camera < 2, seen.frame % 2 == 0
    bridge = (seen.camera == 1) & (seen.frame == seen.frame[(seen.camera == 2) & ~even][0])
    apart = seen.subset((left & even) | (~left & ~even) | bridge)
    with pytest.raises(CalibrationError) as caught:
        calibrate_rig(apart, PLAIN)
    assert "2 groups" in str(caught.value)
    assert "'C00', 'C01'; 'C02', 'C03'" in str(caught.value)
    assert "with 1 shared frame;" in str(caught.value)


def test_a_camera_whose_frames_are_shifted_in_time_is_named():
    seen = simulate(SMALL, 0).observations
    frame = seen.frame.copy()
    frame[seen.camera == 2] = (frame[seen.camera == 2] + 1) % 12
    with pytest.raises(CalibrationError, match=r"; 'C02'\).*shifted in time|camera 'C02' .*shifted in time"):
        calibrate_rig(replace(seen, frame=frame), PLAIN)


def test_cameras_that_are_swapped_in_half_of_the_frames_are_named():
    seen = simulate(SMALL, 0).observations
    camera, half = seen.camera.copy(), seen.frame % 2 == 0
    camera[half & (seen.camera == 1)], camera[half & (seen.camera == 2)] = 2, 1
    with pytest.raises(CalibrationError, match=r"'C0[12]'.*'C0[12]'.*swapped"):
        calibrate_rig(replace(seen, camera=camera), PLAIN)


def test_a_lens_that_folds_inside_its_image_is_refused():
    strong = replace(SMALL, distortion=(-3.0, 0, 0, 0))
    with pytest.raises(CalibrationError, match=r"camera 'C0\d': .*folds inside"):
        calibrate_rig(simulate(strong, 0).observations, PLAIN)
