"""Cameras and faces of made-up photographs whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from people import Shoot, shoot

from preface.align.photos import PhotoAlignment, PhotoOptions, align_photos
from preface.align.photos.trust import SCALE
from preface.align.photos.views import HARDLY, rests_on
from preface.geometry import fit_similarity
from preface.geometry.transforms import Rigid


def keypoint_errors(found: PhotoAlignment, truth: Shoot) -> np.ndarray:
    """Shares of the eye distance, after a similarity."""
    return fit_similarity(truth.keypoints, found.keypoints).residuals / truth.eyes


def turn_between(a: Rigid, b: Rigid) -> np.ndarray:
    return (a @ b.inverse).rotation


def angle(rotation: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))


@pytest.fixture(scope="module")
def three() -> tuple[Shoot, PhotoAlignment]:
    truth = shoot((-25, 0, 25))
    return truth, align_photos(truth.views)


def test_three_photographs_give_keypoints_within_three_per_cent(three):
    truth, found = three
    assert keypoint_errors(found, truth).max() < 0.03


def test_turns_between_cameras_are_right_to_a_degree_or_two(three):
    truth, found = three
    poses = [found.rig.cameras[name].camera_from_rig for name in found.views]
    for i, j in ((0, 1), (1, 2), (0, 2)):
        wrong = turn_between(poses[i], poses[j]).T @ turn_between(truth.poses[i], truth.poses[j])
        assert angle(wrong) < 2.0


def test_focal_length_lies_within_three_of_its_deviations(three):
    truth, found = three
    focal = next(said for said in found.trust if said.what == "focal length")
    assert abs(np.log(focal.value / truth.camera.params[0])) < 3 * focal.deviation / focal.value


def test_the_frame_is_the_faces_own(three):
    _, found = three
    right, left, nose, _, chin = found.keypoints
    assert left[0] > 0 > right[0]
    assert right[1] > 0 > chin[1]
    assert nose[2] > right[2]
    assert np.abs(found.keypoints.mean(axis=0)).max() < 0.01
    for camera in found.rig.cameras.values():
        assert camera.camera_from_rig.inverse.translation[2] > 0.1


def test_the_size_of_the_face_is_stated_with_a_deviation_that_covers_the_truth(three):
    truth, found = three
    scale = next(said for said in found.trust if said.what == SCALE)
    assert scale.source == "expectation"
    assert abs(scale.value / 1e3 - truth.eyes) < 3 * scale.deviation / 1e3


def test_a_covariance_of_each_camera_stands_in_the_rig(three):
    _, found = three
    for camera in found.rig.cameras.values():
        covariance = np.array(camera.covariance)
        assert np.allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > -1e-12 * covariance.max()
        assert np.allclose(np.sqrt(np.diag(covariance))[-3:], camera.standard_deviations.translation)


def test_one_photograph_still_yields_a_camera_and_says_what_it_does_not_know():
    truth = shoot((10,), seed=3)
    found = align_photos(truth.views)
    focal = next(said for said in found.trust if said.what == "focal length")
    distance = next(said for said in found.trust if said.what == "distance of photo0")
    assert focal.source == "expectation"
    assert distance.deviation / distance.value > 0.1
    assert distance.rests_on == HARDLY
    wrong = found.rig.cameras["photo0"].camera_from_rig.rotation.T @ truth.poses[0].rotation
    assert angle(wrong) < 6.0


def test_exif_makes_focal_length_and_distance_known():
    truth = shoot((10,), seed=3, exif=0.8 * 1600)
    found = align_photos(truth.views)
    focal = next(said for said in found.trust if said.what == "focal length")
    assert focal.source == "exif"
    assert focal.deviation / focal.value < 0.051
    distance = next(said for said in found.trust if said.what == "distance of photo0")
    assert distance.rests_on == "photographs"
    assert abs(focal.value / (0.8 * 1600) - 1) < 0.15


@pytest.mark.parametrize(
    ("source", "value", "deviation", "expected"),
    [
        ("photographs", -500.0, 51.0, HARDLY),
        ("photographs", -500.0, 49.0, "photographs"),
        ("photographs", None, 2.0, "photographs"),
        ("photographs", None, None, "photographs"),
        ("expectation", 500.0, 400.0, "expectation"),
    ],
)
def test_a_loose_number_hardly_rests_on_the_photographs(source, value, deviation, expected):
    assert rests_on(source, value, deviation) == expected


@pytest.mark.parametrize("exif", [40.0, 18_000.0])
def test_wildly_wrong_exif_is_ignored_with_a_warning(exif):
    truth = shoot((-20, 20), seed=2, exif=exif)
    found = align_photos(truth.views)
    assert any("EXIF" in warning and "ignored" in warning for warning in found.warnings)
    focal = next(said for said in found.trust if said.what == "focal length")
    assert abs(np.log(focal.value / truth.camera.params[0])) < 0.7


def test_a_known_distance_of_keypoints_sets_the_scale():
    truth = shoot((-20, 20), seed=1)
    known = ("right_eye_outer", "left_eye_outer", truth.eyes)
    found = align_photos(truth.views, options=PhotoOptions(known_distance=known))
    assert np.linalg.norm(found.keypoints[0] - found.keypoints[1]) == pytest.approx(truth.eyes, rel=1e-9)
    scale = next(said for said in found.trust if said.what == SCALE)
    assert scale.source == "given"
    assert scale.deviation == pytest.approx(1.0, rel=0.05)  # the millimetre of the distance itself


def test_a_known_distance_of_cameras_sets_the_scale():
    truth = shoot((-20, 20), seed=1)
    apart = np.linalg.norm(truth.poses[0].inverse.translation - truth.poses[1].inverse.translation)
    found = align_photos(truth.views, options=PhotoOptions(known_distance=("photo0", "photo1", float(apart))))
    centres = [camera.camera_from_rig.inverse.translation for camera in found.rig.cameras.values()]
    assert np.linalg.norm(centres[0] - centres[1]) == pytest.approx(apart, rel=1e-9)


def test_photographs_of_another_size_of_the_same_camera_share_the_lens():
    truth = shoot((-20, 20), seed=4)
    half = truth.views[1]
    marks = replace(half.landmarks, pixels=half.landmarks.pixels / 2, sigma=half.landmarks.sigma / 2)
    small = replace(half, landmarks=marks, width=half.width // 2, height=half.height // 2)
    found = align_photos([truth.views[0], small])
    full = align_photos(truth.views)
    assert np.abs(found.keypoints - full.keypoints).max() < 1e-4
    a, b = found.rig.cameras.values()
    assert a.camera.params[0] == pytest.approx(2 * b.camera.params[0])


def test_the_result_does_not_depend_on_chance():
    truth = shoot((15,), seed=5)
    first, second = align_photos(truth.views), align_photos(truth.views)
    assert np.array_equal(first.points, second.points)
