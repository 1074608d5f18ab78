"""A detector that errs by the direction of the view is corrected, and what remains decides what a view is good for."""

from dataclasses import replace

import numpy as np
import pytest
from cameras_around import LENS, arc, looking_at_origin, rig, stack

from preface.align.keypoints import CANONICAL_KEYPOINTS, FACEMESH478
from preface.align.landmark_bias import POWERS, LandmarkBias, expect, pixel_shifts, shipped_bias
from preface.align.landmarks import ViewLandmarks, box_around
from preface.align.options import AlignmentOptions
from preface.align.subject import align_subject
from preface.geometry import Camera, Rigid, Similarity

SIZE = 0.09  # metres between the outer eye corners
FACE = SIZE * shipped_bias().points
FIVE = FACEMESH478.keypoint_pixels(FACE)
UNIT = Similarity(1.0, np.eye(3), np.zeros(3))


def made_up(slide=0.06):
    """Landmarks that slide towards the camera's right as the face turns; vaguer from the side, most of all noses."""
    coefficients = np.zeros((478, 2, len(POWERS)))
    coefficients[:, 0, POWERS.index((1, 0))] = slide
    coefficients[:, 1, POWERS.index((0, 0))] = 0.01
    variances = np.tile([0.005**2, 0.01**2, 0.0, 0.0], (478, 1))
    variances[1, 1] = 0.1**2
    return LandmarkBias("made-up", "facemesh478", shipped_bias().points, coefficients, variances, np.ones(2))


def marked(pose, slide=0.06, camera=LENS):
    """What that detector makes of the face, one landmark after the other, by words instead of arrays."""
    centre = pose.inverse.translation
    towards = centre / np.linalg.norm(centre)
    right = np.cross([0, 1, 0], towards)
    right = right / np.linalg.norm(right)
    up = np.cross(towards, right)
    pixels = []
    for point in FACE:
        wrong = point + SIZE * (slide * towards[0] * right + 0.01 * up)
        pixels.append(camera.project(pose.apply(wrong[None]))[0][0])
    pixels = np.array(pixels)
    count = len(pixels)
    return ViewLandmarks("facemesh478", pixels, np.full(count, 0.3), np.ones(count), box_around(pixels))


def views(poses, slide=0.06):
    return {f"cam{index:02d}": marked(pose, slide) for index, pose in enumerate(poses)}


def errors(subject):
    return np.linalg.norm(subject.keypoints.positions - FIVE, axis=-1) / SIZE


def test_a_known_bias_is_taken_out():
    poses = arc(7)
    found = views(poses)
    as_found = align_subject(found, rig(poses), AlignmentOptions())
    corrected = align_subject(found, rig(poses), AlignmentOptions(), made_up())
    assert np.nanmax(errors(as_found)) > 0.03
    assert errors(corrected).max() < 0.003
    assert corrected.cameras == tuple(found)
    for name, pose in zip(found, poses, strict=True):
        true, _ = LENS.project(pose.apply(FIVE))
        added = corrected.views[name].correction
        np.testing.assert_allclose(found[name].keypoints + added, true, atol=0.003 * SIZE * 3550)
    assert all(verdict.correction is None for verdict in as_found.views.values())


def test_a_view_does_not_contribute_what_it_is_not_good_for():
    poses = arc(9)
    subject = align_subject(views(poses), rig(poses), AlignmentOptions(), made_up())
    left_out = {name for verdict in subject.views.values() for name in verdict.left_out}
    assert left_out == {"nose_tip"}
    assert subject.keypoints.views[CANONICAL_KEYPOINTS.index("nose_tip")] == 3
    for name in ("cam00", "cam08"):
        assert subject.views[name].left_out == ("nose_tip",)
        assert subject.views[name].reason == "used without nose_tip, which other views show better"
    assert subject.views["cam04"].code == "agrees"


def test_poor_views_take_part_where_the_good_ones_look_from_one_side():
    poses = [looking_at_origin(angle) for angle in (-45, -4, 0, 4, 45)]
    subject = align_subject(views(poses), rig(poses), AlignmentOptions(), made_up())
    assert all(verdict.code == "agrees" for verdict in subject.views.values())


def test_the_correction_does_not_depend_on_frame_unit_or_roll():
    poses = arc(5)
    centres = np.array([pose.inverse.translation for pose in poses])
    here = expect(made_up(), FIVE, centres)
    moved = Similarity.from_quaternion(1e3, [0.5, 0.5, -0.5, 0.5], [1e3, -2e3, 500.0])
    there = expect(made_up(), moved.apply(FIVE), moved.apply(centres))
    np.testing.assert_allclose(there.offsets, 1e3 * here.offsets @ moved.rotation.T, atol=1e-9)
    np.testing.assert_allclose(there.deviations, 1e3 * here.deviations, rtol=1e-9)
    pinhole = Camera("PINHOLE", 1000, 1000, np.array([2000.0, 2000.0, 500.0, 500.0]))
    roll = Rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
    upright = pixel_shifts(here, stack(poses, pinhole))
    rolled = pixel_shifts(here, stack([roll @ pose for pose in poses], pinhole))
    np.testing.assert_allclose(rolled, upright @ roll.rotation[:2, :2].T, atol=1e-9)


def test_landmarks_of_another_scheme_are_left_as_they_are():
    poses = arc(5)
    found = views(poses)
    plain = align_subject(found, rig(poses), AlignmentOptions())
    other = align_subject(found, rig(poses), AlignmentOptions(), replace(made_up(), scheme="ibug68"))
    np.testing.assert_array_equal(other.keypoints.positions, plain.keypoints.positions)


@pytest.mark.parametrize(
    "keypoints",
    [
        np.full((5, 3), np.nan),
        np.where(np.arange(5)[:, None] < 2, FIVE, np.nan),
        np.zeros((5, 3)),
        np.arange(5)[:, None] * [0.01, 0.02, 0.0],
    ],
    ids=["none", "two", "one place", "a line"],
)
def test_keypoints_that_are_no_face_say_nothing(keypoints):
    assert expect(made_up(), keypoints, np.array([[0.0, 0.0, 1.0]])) is None


def test_the_shipped_bias_is_that_of_mirrored_faces_too():
    bias = shipped_bias()
    directions = np.random.default_rng(0).normal(size=(50, 3)) * (0.5, 0.3, 0.1) + (0, 0, 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    mirrored = bias.across(directions * (-1, 1, 1))[:, FACEMESH478.mirror] * (-1, 1)
    np.testing.assert_allclose(mirrored, bias.across(directions), atol=2e-3)
    np.testing.assert_allclose(
        bias.deviations(directions * (-1, 1, 1))[:, FACEMESH478.mirror],
        bias.deviations(directions),
        rtol=0.02,
    )


def test_beyond_the_directions_that_were_seen_offsets_stay_and_doubt_grows():
    bias = shipped_bias()
    x = np.array([0.84, 0.9, 0.97])
    aside = np.stack([x, np.zeros(3), np.sqrt(1 - x**2)], axis=-1)
    offsets = bias.across(aside)
    np.testing.assert_allclose(offsets[1:], offsets[:1].repeat(2, axis=0), atol=1e-12)
    nose = bias.deviations(aside)[:, 1]
    assert (np.diff(nose) > 0).all()
    assert np.isfinite(bias.across(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]))).all()
