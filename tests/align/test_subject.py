"""A subject becomes a 3D face, and whatever cannot be used is left out with its reason."""

from dataclasses import replace

import numpy as np
import pytest
from cameras_around import LENS, arc, looking_at_origin, rig
from faces import EYE_DISTANCE, FACE, flipped, landmarks, of_pixels, swapped, view, views

from preface.align.errors import AlignmentError
from preface.align.landmarks import NoFace
from preface.align.options import AlignmentOptions
from preface.align.subject import align_subject

OPTIONS = AlignmentOptions()
ELSEWHERE = np.array([0.25, 0.1, -0.2])  # where another person stands


def noisy(poses, sigma=0.5, seed=0):
    return views(landmarks(), poses, sigma=sigma, rng=np.random.default_rng(seed))


def codes(subject):
    return [verdict.code for verdict in subject.views.values()]


def assert_excluded(subject, *said):
    for words in said:
        assert words in subject.excluded
    assert subject.cameras == ()
    assert not subject.keypoints.good.any()
    assert not subject.landmarks.ok.any()


def test_keypoints_are_where_the_face_is():
    poses = arc(7)
    subject = align_subject(noisy(poses), rig(poses), OPTIONS)
    assert subject.excluded is None
    assert subject.cameras == tuple(f"cam{i:02d}" for i in range(7))
    error = np.linalg.norm(subject.keypoints.positions - FACE, axis=-1)
    assert error.max() < 0.0004
    assert (error < 4 * np.sqrt(np.trace(subject.keypoints.covariance, axis1=1, axis2=2))).all()
    assert subject.landmarks.ok.all()
    assert subject.keypoints.eye_distance == pytest.approx(EYE_DISTANCE, abs=5e-4)


@pytest.mark.parametrize("noise", [0.5, 3.0])
def test_covariance_follows_the_noise_that_there_is_not_the_one_that_was_assumed(noise):
    poses, errors, predicted = arc(9), [], []
    for seed in range(12):
        found = {name: replace(v, sigma=np.ones(68)) for name, v in noisy(poses, noise, seed=seed).items()}
        keypoints = align_subject(found, rig(poses), OPTIONS).keypoints
        errors.append(((keypoints.positions - FACE) ** 2).sum(-1)[[0, 1, 2, 4]])  # single landmarks
        predicted.append(np.trace(keypoints.covariance, axis1=1, axis2=2)[[0, 1, 2, 4]])
    assert np.mean(predicted) == pytest.approx(np.mean(errors), rel=0.5)


def test_the_order_of_views_is_that_given_and_of_cameras_that_of_the_rig():
    poses = arc(4)
    found = dict(reversed(noisy(poses).items()))
    subject = align_subject(found, rig(poses), OPTIONS)
    assert list(subject.views) == list(found)
    assert subject.cameras == ("cam00", "cam01", "cam02", "cam03")


def test_float32_landmarks_are_as_good():
    poses = arc(5)
    found = noisy(poses)
    rounded = {
        name: replace(v, pixels=v.pixels.astype(np.float32), sigma=v.sigma.astype(np.float32))
        for name, v in found.items()
    }
    ours, theirs = (align_subject(f, rig(poses), OPTIONS) for f in (found, rounded))
    assert theirs.keypoints.positions.dtype == np.float64
    np.testing.assert_allclose(theirs.keypoints.positions, ours.keypoints.positions, atol=1e-6)


def test_a_camera_that_the_rig_lacks_is_left_out():
    poses = arc(5)
    found = noisy(poses)
    found["extra"] = found["cam00"]
    subject = align_subject(found, rig(poses), OPTIONS)
    assert subject.views["extra"].code == "not_in_rig"
    assert "the rig has no camera 'extra'" in subject.views["extra"].reason
    assert subject.excluded is None
    assert "extra" not in subject.cameras


def test_a_rig_without_any_of_the_cameras_excludes():
    poses = arc(3)
    found = {f"other{index}": v for index, v in enumerate(noisy(poses).values())}
    assert_excluded(
        align_subject(found, rig(poses), OPTIONS), "no view shows a face that a camera of the rig"
    )


def test_views_without_a_face_keep_their_reason():
    poses = arc(4)
    found = noisy(poses)
    found["cam02"] = NoFace("no face at 8 rotations")
    subject = align_subject(found, rig(poses), OPTIONS)
    assert subject.views["cam02"].code == "no_face"
    assert subject.views["cam02"].reason == "no face at 8 rotations"
    assert subject.excluded is None


def test_nobody_in_any_view_excludes():
    poses = arc(3)
    found = {f"cam{i:02d}": NoFace("no face") for i in range(3)}
    assert_excluded(align_subject(found, rig(poses), OPTIONS), "no view shows a face")


def test_a_subject_seen_by_one_camera_is_excluded():
    poses = arc(3)
    found = noisy(poses)
    found["cam00"] = found["cam01"] = NoFace("no face")
    subject = align_subject(found, rig(poses), OPTIONS)
    assert_excluded(
        subject, "fewer than two views", "cam02: is the only view of the face", "cam00, cam01: no face"
    )


def test_views_one_degree_apart_are_excluded():
    poses = [looking_at_origin(0), looking_at_origin(1)]
    assert_excluded(align_subject(noisy(poses), rig(poses), OPTIONS), "no two views agree")


def test_a_mirrored_view_is_named_and_left_out():
    poses = arc(5)
    found = noisy(poses)
    found["cam01"] = flipped(found["cam01"])
    subject = align_subject(found, rig(poses), OPTIONS)
    assert codes(subject) == ["agrees", "mirrored", "agrees", "agrees", "agrees"]
    assert "cam01" not in subject.cameras
    assert np.linalg.norm(subject.keypoints.positions - FACE, axis=-1).max() < 0.001


def test_left_and_right_exchanged_in_all_views_excludes():
    poses = arc(5)
    found = {name: swapped(v) for name, v in noisy(poses).items()}
    subject = align_subject(found, rig(poses), OPTIONS)
    assert "left and right are exchanged" in subject.excluded


def test_landmarks_on_another_person_are_left_out():
    poses = arc(7)
    found = noisy(poses)
    for index in (2, 5):
        found[f"cam{index:02d}"] = view(landmarks() + ELSEWHERE, poses[index])
    subject = align_subject(found, rig(poses), OPTIONS)
    assert [c for c, v in subject.views.items() if not v.used] == ["cam02", "cam05"]
    assert np.linalg.norm(subject.keypoints.positions - FACE, axis=-1).max() < 0.001


def test_a_keypoint_that_nobody_sees_is_missing_and_too_many_exclude():
    poses = arc(6)
    found = noisy(poses)
    for v in found.values():
        v.pixels[8] = np.nan
    subject = align_subject(found, rig(poses), OPTIONS)
    assert subject.keypoints.good.tolist() == [True, True, True, True, False]
    assert "fewer than two views" in subject.keypoints.reasons[4]
    assert subject.excluded is None
    for v in found.values():
        v.pixels[30] = np.nan
    assert "2 of the five keypoints are missing" in align_subject(found, rig(poses), OPTIONS).excluded


def test_a_keypoint_on_which_the_views_contradict_each_other_is_missing():
    poses, rng = arc(7), np.random.default_rng(1)
    found = noisy(poses)
    for v in found.values():
        v.pixels[30] += rng.normal(0, 60, 2)
    subject = align_subject(found, rig(poses), OPTIONS)
    assert subject.keypoints.good.tolist() == [True, True, False, True, True]
    assert subject.keypoints.reasons[2] == "too few views agree on where it is"
    assert all(verdict.left_out == ("nose_tip",) for verdict in subject.views.values())


def test_a_rig_of_other_images_does_not_make_a_face():
    """The cameras of another image size: here twice as large, as after halving the images."""
    poses = arc(6)
    large = LENS.resized(2 * LENS.width, 2 * LENS.height)
    subject = align_subject(noisy(poses), rig(poses, large), OPTIONS)
    assert subject.excluded is not None


def test_schemes_must_not_be_mixed():
    poses = arc(3)
    found = noisy(poses)
    wrong = of_pixels(np.zeros((478, 2)))
    found["cam01"] = replace(wrong, scheme="facemesh478")
    with pytest.raises(AlignmentError, match="of the schemes facemesh478, ibug68"):
        align_subject(found, rig(poses), OPTIONS)


def test_landmarks_must_be_as_many_as_the_scheme_has():
    poses = arc(3)
    found = noisy(poses)
    found["cam01"] = of_pixels(np.ones((67, 2)))
    with pytest.raises(AlignmentError, match=r"'cam01' has \(67, 2\) pixels .* ibug68 has 68"):
        align_subject(found, rig(poses), OPTIONS)
