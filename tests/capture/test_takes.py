"""Several takes: one rig each, one model for all, and an honest account of what moved."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preface.capture.calibration import CalibrationError, CalibrationOptions, Candidate
from preface.capture.takes import calibrate_takes, drift, keypoints_between, middle_of_boards, settled
from preface.geometry import Rigid

PLAIN = CalibrationOptions("PINHOLE", "off")


def with_pose(calibration, camera, change):
    """The calibration with one camera moved: change takes old to new camera coordinates."""
    rotation = calibration.camera_from_rig.rotation.copy()
    translation = calibration.camera_from_rig.translation.copy()
    moved = change @ Rigid(rotation[camera], translation[camera])
    rotation[camera], translation[camera] = moved.rotation, moved.translation
    return replace(calibration, camera_from_rig=Rigid(rotation, translation))


def test_nothing_drifts_between_a_take_and_itself(small_calibration):
    for camera in drift(small_calibration, small_calibration):
        assert camera.center < 1e-9
        assert camera.rotation < 1e-7
        assert camera.pixels < 1e-6
        assert camera.focal == 0


def test_another_rig_frame_is_no_drift(small_calibration):
    frame = Rigid(Rotation.from_rotvec([0.3, -1.0, 0.2]).as_matrix(), np.array([5.0, -3.0, 1.0]))
    elsewhere = replace(small_calibration, camera_from_rig=small_calibration.camera_from_rig @ frame.inverse)
    assert max(camera.center for camera in drift(small_calibration, elsewhere)) < 1e-8


def test_the_camera_that_was_knocked_is_named(small_calibration):
    knocked = with_pose(
        small_calibration, 1, Rigid(Rotation.from_rotvec([0, 0.02, 0]).as_matrix(), np.array([0.004, 0, 0]))
    )
    found = {camera.camera: camera for camera in drift(small_calibration, knocked)}
    worst = max(found.values(), key=lambda camera: camera.pixels)
    assert worst.camera == "C01"
    assert worst.rotation == pytest.approx(0.02, rel=0.5)
    assert worst.pixels > 10  # 0.02 rad and 4 mm at 1 m, seen with 2000 px
    assert worst.center_deviation < 0.002


def test_a_zoom_shows_as_focal_length(small_calibration):
    lenses = list(small_calibration.cameras)
    lenses[2] = replace(lenses[2], params=lenses[2].params * [1.01, 1.01, 1, 1])
    found = drift(small_calibration, replace(small_calibration, cameras=tuple(lenses)))
    assert [camera.focal for camera in found] == pytest.approx([0, 0, 0.01])


def test_takes_without_a_common_camera_have_no_drift(small_calibration):
    renamed = replace(small_calibration.observations, camera_ids=("X", "Y", "Z"))
    assert drift(small_calibration, replace(small_calibration, observations=renamed)) == []


def test_takes_keep_their_order_and_agree(small_scene):
    observations = small_scene.observations
    takes = {
        "morning": observations.subset(observations.frame < 13),
        "noon": observations,
        "evening": observations.subset((observations.frame > 0) & (observations.frame < 14)),
    }
    found = calibrate_takes(takes, PLAIN)
    assert list(found) == ["morning", "noon", "evening"]
    for camera in drift(found["morning"], found["evening"]):
        assert camera.center < 4 * camera.center_deviation
        assert camera.pixels < 1


def test_an_error_names_the_take(small_scene):
    observations = small_scene.observations
    takes = {"good": observations, "short": observations.subset(observations.frame < 2)}
    with pytest.raises(CalibrationError, match=r"^take 'short': camera 'C0\d'"):
        calibrate_takes(takes, PLAIN)


def test_what_the_first_take_chose_holds_for_the_others(small_calibration):
    row = {"parameters": 1, "training_rms": 1.0, "held_out_rms": 1.0, "excess": 0.0, "standard_error": 0.0}
    table = (
        Candidate("PINHOLE", False, refused="", chosen=False, **row),
        Candidate("RADIAL", True, refused="", chosen=True, **row),
    )
    options = settled(CalibrationOptions(), replace(small_calibration, selection=table))
    assert (options.camera_model, options.board_warp) == ("RADIAL", "on")
    assert settled(PLAIN, small_calibration) == PLAIN


def test_the_head_is_expected_where_the_boards_were_and_faces_the_cameras(small_scene, small_calibration):
    keypoints = keypoints_between(small_calibration)
    middle = middle_of_boards(small_calibration)
    assert np.linalg.norm(middle - small_scene.keypoints.mean(axis=0)) < 0.15
    nose, chin = keypoints[2], keypoints[4]
    centers = small_calibration.camera_from_rig.inverse.translation
    assert (np.linalg.norm(centers - nose, axis=1) < np.linalg.norm(centers - middle, axis=1)).all()
    first = small_calibration.camera_from_rig.rotation[0]
    assert (first @ (chin - nose))[1] > 0  # below it in the image
    left_eye, right_eye = keypoints[1], keypoints[0]
    assert (first @ (left_eye - right_eye))[0] > 0  # the subject's left is at the right of the image
