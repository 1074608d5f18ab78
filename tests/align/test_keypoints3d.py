"""Keypoints carry the covariance that repeated measurements have, however landmarks err together."""

import numpy as np
import pytest
from cameras_around import arc, see, stack
from faces import landmarks

from preface.align.keypoints import CANONICAL_KEYPOINTS, IBUG68, Scheme
from preface.align.keypoints3d import form_keypoints, inside_out
from preface.align.options import AlignmentOptions
from preface.align.triangulation import Triangulation, triangulate

SIGMA, DRAWS = 2.0, 600
# The landmarks that make keypoints, and no others.
MEMBERS = [index for name in CANONICAL_KEYPOINTS for index in IBUG68.keypoints[name]]
SIX = Scheme(
    "six",
    6,
    {name: tuple(MEMBERS.index(i) for i in IBUG68.keypoints[name]) for name in CANONICAL_KEYPOINTS},
    np.array([1, 0, 2, 3, 4, 5]),
)
MOUTH = CANONICAL_KEYPOINTS.index("mouth_center")


def picked(found, index):
    return Triangulation(**{name: array[index] for name, array in vars(found).items()})


@pytest.mark.parametrize("correlation", [0.0, 0.6, 1.0])
def test_predicted_covariance_is_that_of_repeated_measurements(correlation):
    rng, poses = np.random.default_rng(0), arc(5)
    points = landmarks()
    points[62] += (0.002, 0.004, 0.001)  # the lips stand apart
    clean = see(points[MEMBERS], poses)
    shared = rng.normal(0, SIGMA, (DRAWS, 1, 5, 2))
    own = rng.normal(0, SIGMA, (DRAWS, 6, 5, 2))
    pixels = clean + np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * own
    found = triangulate(stack(poses), pixels, SIGMA)
    options = AlignmentOptions(landmark_correlation=correlation)
    sigmas = np.full((6, 5), SIGMA)
    keypoints = [form_keypoints(SIX, stack(poses), picked(found, i), sigmas, options) for i in range(DRAWS)]
    complete = [k for k in keypoints if k.good.all()]
    assert len(complete) > 0.97 * DRAWS
    for index in range(5):
        true = np.cov(np.array([k.positions[index] for k in complete]).T)
        predicted = np.mean([k.covariance[index] for k in complete], axis=0)
        assert np.trace(predicted) == pytest.approx(np.trace(true), rel=0.15)
        np.testing.assert_allclose(
            np.sqrt(np.linalg.eigvalsh(predicted)), np.sqrt(np.linalg.eigvalsh(true)), rtol=0.15
        )


def test_independent_landmarks_average_and_dependent_ones_do_not():
    poses = arc(5)
    found = triangulate(stack(poses), see(landmarks(), poses), SIGMA)
    sigmas = np.full((68, 5), SIGMA)

    def mouth(correlation):
        options = AlignmentOptions(landmark_correlation=correlation)
        return np.trace(form_keypoints(IBUG68, stack(poses), found, sigmas, options).covariance[MOUTH])

    lip = np.trace(found.covariance[62])
    assert mouth(0.0) == pytest.approx(lip / 2, rel=0.01)
    assert mouth(1.0) == pytest.approx(lip, rel=0.01)


def test_a_keypoint_without_one_of_its_landmarks_is_missing_with_the_reason():
    poses = arc(5)
    pixels = see(landmarks(), poses)
    pixels[66, 1:] = np.nan
    found = triangulate(stack(poses), pixels, SIGMA)
    keypoints = form_keypoints(IBUG68, stack(poses), found, np.full((68, 5), SIGMA), AlignmentOptions())
    assert keypoints.good.tolist() == [True, True, True, False, True]
    assert keypoints.reasons[MOUTH] == "landmark 66: seen by fewer than two views"
    assert np.isnan(keypoints.covariance[MOUTH]).all()
    assert keypoints.views.tolist() == [5, 5, 5, 0, 5]


def test_a_keypoint_that_is_known_too_badly_is_missing_with_the_reason():
    poses = arc(2, reach=3)
    found = triangulate(stack(poses), see(landmarks(), poses), 10.0)
    keypoints = form_keypoints(IBUG68, stack(poses), found, np.full((68, 2), 10.0), AlignmentOptions())
    assert not keypoints.good.any()
    assert all("standard deviation of" in reason and "more than 5%" in reason for reason in keypoints.reasons)


def test_a_face_with_left_and_right_exchanged_is_inside_out():
    face = landmarks()[[36, 45, 30, 62, 8]]
    assert not inside_out(face)
    assert inside_out(face[[1, 0, 2, 3, 4]])
    assert inside_out(face * (-1, 1, 1))
