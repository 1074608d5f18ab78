"""Triangulation, template and placement at the edges of what numbers and cameras allow."""

from dataclasses import replace

import numpy as np
import pytest

from preface.align.errors import AlignmentError
from preface.align.keypoints3d import Keypoints
from preface.align.options import AlignmentOptions, TriangulationOptions
from preface.align.placement import place_subject
from preface.align.template import build_template, canonical_frame
from preface.align.triangulation import Reason, triangulate
from preface.geometry import Camera, Rigid, Similarity, Views

LENS = Camera("OPENCV", 1024, 1536, np.array([3550.0, 3548.0, 517.0, 760.0, -0.08, 0.03, 4e-4, -3e-4]))
FACE = np.array([(-0.045, 0.03, 0), (0.045, 0.03, 0), (0, -0.01, 0.04), (0, -0.045, 0.02), (0, -0.085, 0)])


def around(degrees, centre=(0.0, 0.0, 0.0), size=1.0):
    """Poses on a circle of one `size` about a centre, which they look at."""
    poses = []
    for angle in np.radians(degrees):
        back = np.array([np.sin(angle), 0.0, np.cos(angle)])
        rotation = np.stack([np.array([np.cos(angle), 0.0, -np.sin(angle)]), (0.0, -1.0, 0.0), -back])
        poses.append(Rigid(rotation, -rotation @ (np.array(centre) + size * back)))
    return poses


def stack(poses):
    return Views.stack([LENS] * len(poses), [pose.inverse for pose in poses])


def see(points, poses):
    return np.stack([LENS.project(pose.apply(points))[0] for pose in poses], axis=-2)


def some_points(size=1.0, centre=(0.0, 0.0, 0.0), count=50):
    return np.random.default_rng(0).uniform(-0.08, 0.08, (count, 3)) * size + centre


def keypoints(points):
    return Keypoints(
        np.asarray(points, float), np.broadcast_to(1e-8 * np.eye(3), (5, 3, 3)), np.full(5, 5), ("",) * 5
    )


@pytest.mark.parametrize("far", [1e3, 1e6])
def test_coordinates_far_from_the_origin_lose_nothing_but_their_rounding(far):
    centre = np.array([far, -far, far / 3])
    poses, points = around((-40, -15, 0, 20, 45), centre), some_points(centre=centre)
    pixels = see(points, poses)
    found = triangulate(stack(poses), pixels, 0.5)
    assert found.ok.all()
    np.testing.assert_allclose(found.points, points, rtol=0, atol=20 * far * np.finfo(float).eps * 10 + 1e-12)
    near = triangulate(stack(around((-40, -15, 0, 20, 45))), pixels, 0.5)
    np.testing.assert_allclose(found.covariance, near.covariance, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1e3, 1e6])
def test_any_unit_gives_the_same_points(size):
    degrees = (-40, -15, 0, 20, 45)
    noise = np.random.default_rng(1).normal(0, 0.5, (50, 5, 2))
    pixels = see(some_points(), around(degrees)) + noise
    pixels[::7, 2] += 100
    metres = triangulate(stack(around(degrees)), pixels, 0.5)
    other = triangulate(stack(around(degrees, size=size)), pixels, 0.5)
    np.testing.assert_array_equal(other.inliers, metres.inliers)
    np.testing.assert_allclose(other.points / size, metres.points, rtol=0, atol=1e-10)
    np.testing.assert_allclose(other.covariance / size**2, metres.covariance, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("degrees", [1.0, 0.1, 0.001])
def test_two_views_almost_in_one_place_give_no_point(degrees):
    poses = around((0, degrees))
    pixels = see(some_points(), poses) + np.random.default_rng(2).normal(0, 0.5, (50, 2, 2))
    found = triangulate(stack(poses), pixels, 0.5)
    assert (found.reason == Reason.SMALL_ANGLE).all()
    assert np.isnan(found.points).all()


def test_asked_to_two_views_one_degree_apart_say_how_little_they_know():
    poses, points = around((0, 1.0)), some_points(count=400)
    pixels = see(points, poses) + np.random.default_rng(3).normal(0, 0.5, (400, 2, 2))
    found = triangulate(stack(poses), pixels, 0.5, TriangulationOptions(minimum_angle_degrees=0.5))
    error = found.points - points
    assert found.ok.mean() > 0.99
    whitened = np.einsum("pi,pij,pj->p", error, np.linalg.inv(found.covariance), error)[found.ok]
    assert whitened.mean() == pytest.approx(3, rel=0.15)
    assert np.sqrt(found.covariance[found.ok, 2, 2]).mean() > 0.005


@pytest.mark.parametrize("pose", [0, 30])
def test_cameras_in_one_place_give_no_point(pose):
    poses = around((pose, pose, pose))
    found = triangulate(stack(poses), see(some_points(), poses), 0.5)
    assert (found.reason == Reason.SMALL_ANGLE).all()


def test_a_point_in_a_camera_s_centre_is_no_point():
    poses = around((-30, 0, 30))
    pixels = see(np.array([[0.0, 0.0, 1.0]]), poses)  # the middle camera stands there
    found = triangulate(stack(poses), pixels, 0.5)
    assert not found.inliers[:, 1].any()
    assert np.isnan(found.residuals[:, 1]).all()


def test_half_of_many_views_may_be_wrong():
    rng, poses, points = np.random.default_rng(4), around(np.linspace(-70, 70, 40)), some_points(count=30)
    pixels = see(points, poses) + rng.normal(0, 0.5, (30, 40, 2))
    wrong = rng.random((30, 40)).argsort(axis=1) < 20
    pixels[wrong] = rng.uniform(0, 1000, (wrong.sum(), 2))
    found = triangulate(stack(poses), pixels, 0.5)
    assert found.ok.all()
    assert not (found.inliers & wrong).any()
    assert np.linalg.norm(found.points - points, axis=-1).max() < 0.001


def test_views_that_are_all_wrong_give_no_points():
    rng, poses = np.random.default_rng(5), around(np.linspace(-60, 60, 9))
    pixels = rng.uniform(0, 1000, (300, 9, 2))
    found = triangulate(stack(poses), pixels, 0.5)
    assert (found.reason == Reason.NO_CONSENSUS).mean() > 0.99


def test_float32_input_is_computed_in_float64():
    poses, points = around((-40, -15, 0, 20, 45)), some_points()
    pixels = see(points, poses).astype(np.float32)
    views = stack(poses)
    found = triangulate(views, pixels, np.float32(0.5))
    same = triangulate(views, pixels.astype(np.float64), 0.5)
    assert found.points.dtype == found.covariance.dtype == np.float64
    np.testing.assert_array_equal(found.points, same.points)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_count_as_not_seen(value):
    poses, points = around((-40, -15, 0, 20, 45)), some_points()
    pixels = see(points, poses)
    pixels[::2, 1] = value
    pixels[1::2, 3, 0] = value
    found = triangulate(stack(poses), pixels, 0.5)
    assert found.ok.all()
    assert not found.inliers[::2, 1].any()
    assert not found.inliers[1::2, 3].any()
    np.testing.assert_allclose(found.points, points, atol=1e-9)


@pytest.mark.parametrize("value", [1e9, -1e9, 1e30, 1e300])
def test_absurd_pixels_are_outliers_or_not_seen(value):
    poses, points = around((-40, -15, 0, 20, 45)), some_points()
    pixels = see(points, poses)
    pixels[:, 2, 0] = value
    found = triangulate(stack(poses), pixels, 0.5)
    assert found.ok.all()
    assert not found.inliers[:, 2].any()
    np.testing.assert_allclose(found.points, points, atol=1e-9)


@pytest.mark.parametrize("sigma", [1e-6, 1e6])
def test_any_deviation_gives_the_point_and_its_own_covariance(sigma):
    poses, points = around((-40, -15, 0, 20, 45)), some_points()
    found = triangulate(stack(poses), see(points, poses), sigma)
    np.testing.assert_allclose(found.points, points, atol=1e-8)
    unit = triangulate(stack(poses), see(points, poses), 1.0)
    np.testing.assert_allclose(found.covariance / sigma**2, unit.covariance, rtol=1e-5, atol=1e-16)


# ------------------------------------------------------------------------- template, placement


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("far", [0.0, 1e6])
def test_the_canonical_frame_of_any_face_is_exact(size, far):
    face = size * FACE + far
    moved = canonical_frame(face).apply(face)
    np.testing.assert_allclose(moved.mean(0), 0, atol=1e-15 * size + 4e-16 * far)
    np.testing.assert_allclose(
        np.linalg.norm(moved[0] - moved[1]), 0.09 * size, rtol=1e-12, atol=1e-15 * far * 10
    )


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_faces_of_any_scale_are_placed_and_flagged(scale):
    template = build_template({"a": keypoints(FACE)}, "ibug68", 260, procrustes=False)
    person = keypoints(FACE * scale + 1e3)
    placement = place_subject(person, template, AlignmentOptions())
    there = placement.canonical_from_rig.apply(person.positions)
    np.testing.assert_allclose(there, template.keypoints, atol=1e-9)
    assert [flag.code for flag in placement.flags] == ["unit"]
    assert np.linalg.det(placement.canonical_from_rig.rotation) == pytest.approx(1)


def test_people_a_thousand_kilometres_away_are_placed_as_well():
    template = build_template({"a": keypoints(FACE)}, "ibug68", 260, procrustes=False)
    placement = place_subject(keypoints(FACE + 1e6), template, AlignmentOptions())
    assert placement.residuals.max() < 1e-8
    assert placement.flags == ()


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((5, 3)),
        np.ones((5, 3)) * 1e6,
        np.outer(np.arange(5), (0.01, 0.02, 0.03)),
        np.where(np.arange(5)[:, None] < 3, np.nan, FACE),
    ],
    ids=["zero", "coincident", "collinear", "two points"],
)
def test_points_that_are_no_face_are_refused(points):
    template = build_template({"a": keypoints(FACE)}, "ibug68", 260, procrustes=False)
    with pytest.raises(AlignmentError):
        place_subject(keypoints(points), template, AlignmentOptions())
    with pytest.raises(AlignmentError):
        build_template({"a": keypoints(points)}, "ibug68", 260, procrustes=False)


def test_a_flat_face_is_placed():
    """Exactly coplanar keypoints determine a rotation; only their reflection is as good."""
    flat = FACE * (1, 1, 0)
    template = build_template({"a": keypoints(FACE)}, "ibug68", 260, procrustes=False)
    flat_template = replace(template, keypoints=flat - flat.mean(0))
    turn = Similarity(1.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))
    placement = place_subject(keypoints(turn.apply(flat)), flat_template, AlignmentOptions())
    np.testing.assert_allclose(placement.residuals, 0, atol=1e-14)
    assert np.linalg.det(placement.canonical_from_rig.rotation) == pytest.approx(1)
