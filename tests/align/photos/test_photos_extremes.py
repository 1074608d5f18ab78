"""Photographs that should not be believed, and scenes at the edge of what can be known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from people import HEIGHT, WIDTH, person, shoot, view

from preface.align.errors import AlignmentError
from preface.align.keypoints import FACEMESH478
from preface.align.photos import PhotoOptions, align_photos
from preface.align.photos.face import face_prior
from preface.align.photos.initial import ViewProblemError, first_pose
from preface.align.photos.noise import Observations
from preface.align.photos.projection import Scene, linearise, project
from preface.align.photos.trust import SCALE
from preface.capture.rig import Rig, RigCamera
from preface.geometry import fit_similarity


def finite(found) -> bool:
    numbers = [found.points, found.covariance, found.keypoints, found.keypoint_covariance]
    numbers += [np.array(camera.covariance) for camera in found.rig.cameras.values()]
    return all(np.isfinite(values).all() for values in numbers)


def errors(found, truth) -> np.ndarray:
    return fit_similarity(truth.keypoints, found.keypoints).residuals / truth.eyes


def test_two_photographs_one_degree_apart_are_no_worse_than_their_deviations_say():
    truth = shoot((0, 1), seed=6)
    found = align_photos(truth.views)
    assert finite(found)
    deviation = np.sqrt(np.trace(found.keypoint_covariance, axis1=1, axis2=2)) / truth.eyes
    assert (errors(found, truth) < 3 * deviation).all()
    focal = next(said for said in found.trust if said.what == "focal length")
    assert focal.deviation / focal.value > 0.1


def test_missing_landmarks_are_filled_in_with_a_larger_deviation():
    truth = shoot((-15, 15), seed=7)
    views = []
    for photo in truth.views:
        pixels = photo.landmarks.pixels.copy()
        pixels[::2] = np.nan
        pixels[152] = np.nan  # the chin
        views.append(view(photo.id, pixels))
    whole, found = align_photos(truth.views), align_photos(views)
    assert finite(found)
    assert errors(found, truth).max() < 0.05
    assert np.trace(found.keypoint_covariance[4]) > np.trace(whole.keypoint_covariance[4])
    assert np.isnan(found.residuals[:, 152]).all()
    assert not found.inliers[:, 152].any()


def test_half_of_the_landmarks_of_one_view_may_be_wrong():
    truth = shoot((-20, 20), seed=8)
    random = np.random.default_rng(0)
    pixels = truth.views[1].landmarks.pixels.copy()
    wrong = random.permutation(478)[:239]
    pixels[wrong] = random.uniform([0, 0], [WIDTH, HEIGHT], (239, 2))
    found = align_photos([truth.views[0], view("photo1", pixels)])
    assert found.views == ("photo0", "photo1")
    assert errors(found, truth).max() < 0.04
    far = np.linalg.norm(pixels - truth.views[1].landmarks.pixels, axis=1) > 100
    assert not found.inliers[1][far].any()
    assert found.inliers[0].mean() > 0.95


def test_swapped_labels_are_named_and_left_out():
    truth = shoot((-15, 0, 15), seed=9)
    swapped = view("photo1", truth.views[1].landmarks.pixels[FACEMESH478.mirror])
    found = align_photos([truth.views[0], swapped, truth.views[2]])
    assert found.views == ("photo0", "photo2")
    assert "left and right" in found.excluded["photo1"]


def test_a_mirrored_photograph_is_named_and_left_out():
    truth = shoot((-25, -8, 10, 25), seed=21)
    pixels = truth.views[1].landmarks.pixels[FACEMESH478.mirror] * [-1, 1] + [WIDTH, 0]
    found = align_photos([truth.views[0], view("photo1", pixels), *truth.views[2:]])
    assert set(found.excluded) == {"photo1"}
    assert "mirrored" in found.excluded["photo1"]


def test_landmarks_that_are_no_face_are_left_out():
    truth = shoot((-15,), seed=9)
    noise = np.random.default_rng(1).uniform([0, 0], [WIDTH, HEIGHT], (478, 2))
    found = align_photos([*truth.views, view("noise", noise)])
    assert "no face" in found.excluded["noise"]


def test_faces_without_size_are_left_out():
    truth = shoot((0,), seed=9)
    around = truth.views[0].landmarks.pixels - 600
    found = align_photos([*truth.views, view("point", 600 + 0 * around), view("tiny", 600 + 1e-3 * around)])
    assert "pixels" in found.excluded["tiny"]
    assert "pixels" in found.excluded["point"]


def test_landmarks_on_a_line_are_no_photograph_of_a_face():
    truth = shoot((0,), seed=9)
    pixels = truth.views[0].landmarks.pixels.copy()
    pixels[:, 0] = 600.0
    with pytest.raises(AlignmentError, match="no photograph can be used"):
        align_photos([view("line", pixels)])


def test_a_huge_focal_length_is_orthographic_and_nothing_overflows():
    truth = shoot((-20, 20), seed=10, focal=80.0, distance=50.0)
    found = align_photos(truth.views)
    assert finite(found)
    assert errors(found, truth).max() < 0.06
    focal = next(said for said in found.trust if said.what == "focal length")
    assert focal.value > 1.2 * HEIGHT


def test_no_usable_photograph_is_an_error_that_says_why():
    nothing = view("empty", np.full((478, 2), np.nan))
    with pytest.raises(AlignmentError, match=r"empty: only 0 of 478 landmarks"):
        align_photos([nothing])
    with pytest.raises(AlignmentError, match="there are none"):
        align_photos([])


def test_wrong_arguments_are_named():
    truth = shoot((0,), seed=9)
    with pytest.raises(AlignmentError, match="not all different"):
        align_photos([truth.views[0], truth.views[0]])
    with pytest.raises(AlignmentError, match="known_distance"):
        align_photos(truth.views, options=PhotoOptions(known_distance=("nose_tip", "ear", 0.1)))
    with pytest.raises(AlignmentError, match="known_distance"):
        align_photos(truth.views, options=PhotoOptions(known_distance=("nose_tip", "chin", float("nan"))))
    other = replace(truth.views[0], landmarks=replace(truth.views[0].landmarks, scheme="ibug68"))
    with pytest.raises(AlignmentError, match="facemesh478"):
        align_photos([other])


def rig_of(truth, unit: float = 1.0) -> Rig:
    cameras = {
        photo.id: RigCamera.at(truth.camera, replace(pose, translation=pose.translation / unit))
        for photo, pose in zip(truth.views, truth.poses, strict=True)
    }
    return Rig("given", cameras)


def test_given_metric_cameras_are_kept_and_the_face_is_triangulated_in_their_frame():
    truth = shoot((-20, 0, 20), seed=11)
    found = align_photos(truth.views, rig_of(truth), PhotoOptions(metric_cameras=True))
    assert np.abs(found.keypoints - truth.keypoints).max() < 0.002
    assert (found.from_photographs == 1).all()
    for name, camera in found.rig.cameras.items():
        assert camera == rig_of(truth).cameras[name]


def test_given_cameras_of_arbitrary_unit_get_their_scale_from_the_face():
    truth = shoot((-20, 0, 20), seed=11)
    found = align_photos(truth.views, rig_of(truth, unit=37.0))
    assert errors(found, truth).max() < 0.03
    scale = next(said for said in found.trust if said.what == SCALE)
    assert abs(scale.value / 1e3 - truth.eyes) < 3 * scale.deviation / 1e3


def test_metric_cameras_in_millimetres_are_warned_of():
    truth = shoot((-20, 20), seed=11)
    found = align_photos(truth.views, rig_of(truth, unit=1e-3), PhotoOptions(metric_cameras=True))
    assert any("metre" in warning for warning in found.warnings)


def test_one_photograph_with_a_given_camera_is_matched_against_the_expected_face():
    truth = shoot((10,), seed=11)
    found = align_photos(truth.views, rig_of(truth))
    assert (found.from_photographs < 1).all()
    assert np.isfinite(found.points).all()
    assert errors(found, truth).max() < 0.06


def test_given_cameras_of_another_name_or_size_are_named():
    truth = shoot((-20, 20), seed=11)
    rig = rig_of(truth)
    del rig.cameras["photo1"]  # type: ignore[attr-defined]
    found = align_photos(truth.views, rig)
    assert "none of this name" in found.excluded["photo1"]
    wrong = [replace(truth.views[0], width=WIDTH // 2, height=HEIGHT // 2)]
    with pytest.raises(AlignmentError, match="calibrated at"):
        align_photos(wrong, rig)


@given(
    log_focal=st.floats(-0.5, 14),
    distortion=st.floats(-0.05, 0.05),
    seed=st.integers(0, 10**6),
)
@settings(max_examples=25, deadline=None)
def test_derivatives_of_the_projection_are_those_of_differences(log_focal, distortion, seed):
    random = np.random.default_rng(seed)
    points = random.normal(0, 0.06, (5, 3))
    rotation = fit_similarity(np.eye(3), random.normal(size=(3, 3))).target_from_source.rotation
    placement = np.array([[0.1, -0.2, np.log(1.5)]])
    scene = Scene(log_focal, distortion, rotation[None], placement, np.zeros(0))
    linear = linearise(scene, points)
    steps = 1e-6 * np.eye(8)
    for column, step in enumerate(steps):
        slope = (project(scene.moved(step), points) - project(scene.moved(-step), points)) / 2e-6
        claimed = linear.by_lens[..., column] if column < 2 else linear.by_pose[..., column - 2]
        assert np.abs(slope - claimed).max() < 1e-6
    for axis in range(3):
        moved = 1e-6 * np.eye(3)[axis]
        slope = (project(scene, points + moved) - project(scene, points - moved)) / 2e-6
        assert np.abs(slope - linear.by_point[..., axis]).max() < 1e-6


@given(seed=st.integers(0, 10**6), azimuth=st.floats(-40, 40))
@settings(max_examples=10, deadline=None)
def test_the_first_pose_of_anybody_is_near_and_its_swapped_labels_are_refused(seed, azimuth):
    truth = shoot((azimuth,), seed=seed, noise=1.0)
    image = (truth.views[0].landmarks.pixels - [WIDTH / 2, HEIGHT / 2]) / HEIGHT
    pose = first_pose(face_prior().mean, image, HEIGHT)
    cosine = (np.trace(pose.rotation.T @ truth.poses[0].rotation) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 20
    with pytest.raises(ViewProblemError, match="left and right"):
        first_pose(face_prior().mean, image[FACEMESH478.mirror], HEIGHT)


def test_the_expected_face_is_symmetric_and_of_human_size():
    mean = face_prior().mean
    assert np.abs(mean - mean[FACEMESH478.mirror] * [-1, 1, 1]).max() < 1e-6
    pupils = [np.linalg.norm(person(seed)[473] - person(seed)[468]) for seed in range(30)]
    assert np.mean(pupils) == pytest.approx(0.0634, abs=0.002)  # Dodgson 2004: 63.36 mm, deviation 3.83 mm
    assert 0.0025 < np.std(pupils) < 0.006


def test_unseen_landmarks_are_those_without_pixels():
    image = np.zeros((1, 3, 2))
    image[0, 1, 0] = np.nan
    assert Observations(image, np.ones((1, 3)), np.ones((1, 3))).seen.tolist() == [[True, False, True]]
