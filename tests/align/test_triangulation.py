"""Triangulation reaches the Cramer-Rao bound, survives outliers, and says why where it gives no point."""

import numpy as np
import pytest
from cameras_around import LENS, SIZE, arc, information, looking_at_origin, see, stack

from preface.align.options import TriangulationOptions
from preface.align.triangulation import Reason, triangulate
from preface.geometry import Camera, GeometryError, Rigid

SIGMA = 0.5


def scattered(count, seed=0):
    return np.random.default_rng(seed).uniform(-0.08, 0.08, (count, 3))


def with_gross_outliers(pixels, share, rng):
    """Displace a share of the pixels by 20 to 400 pixels in random directions."""
    wrong = rng.random(pixels.shape[:-1]) < share
    length, angle = rng.uniform(20, 400, wrong.shape), rng.uniform(0, 2 * np.pi, wrong.shape)
    shift = np.stack([length * np.cos(angle), length * np.sin(angle)], axis=-1)
    return np.where(wrong[..., None], pixels + shift, pixels), wrong


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_error_is_that_of_the_cramer_rao_bound(outliers):
    rng, poses, points = np.random.default_rng(1), arc(13), scattered(3000)
    pixels = see(points, poses) + rng.normal(0, SIGMA, (3000, 13, 2))
    pixels, wrong = with_gross_outliers(pixels, outliers, rng)
    missing = rng.random(wrong.shape) < 0.3
    pixels[missing] = np.nan
    found = triangulate(stack(poses), pixels, SIGMA)

    good = ~wrong & ~missing
    enough = good.sum(1) >= 3
    assert found.ok[enough].mean() > 0.999
    assert not (found.inliers & ~good).any()
    bound = np.linalg.inv(information(points, poses, good, SIGMA)[found.ok])
    squared = ((found.points - points)[found.ok] ** 2).sum(-1)
    assert np.sqrt(squared.sum() / np.trace(bound, axis1=1, axis2=2).sum()) < 1.05
    assert np.sqrt(squared).max() < 0.003, "a gross error"
    np.testing.assert_allclose(found.covariance[found.ok], bound, rtol=0.3, atol=0.05 * bound.max())


def test_covariance_is_that_of_repeated_measurements():
    rng, poses, point = np.random.default_rng(2), arc(5), scattered(1)
    pixels = see(point, poses) + rng.normal(0, SIGMA, (4000, 5, 2))
    found = triangulate(stack(poses), pixels, SIGMA)
    true = np.cov(found.points[found.ok].T)
    np.testing.assert_allclose(found.covariance[found.ok].mean(0), true, atol=0.1 * np.trace(true) / 3)


def test_precise_views_count_more():
    rng, poses, points = np.random.default_rng(3), arc(6), scattered(500)
    sigmas = np.array([0.1, 0.1, 0.1, 3.0, 3.0, 3.0])
    pixels = see(points, poses) + rng.normal(0, 1, (500, 6, 2)) * sigmas[:, None]
    found = triangulate(stack(poses), pixels, sigmas)
    three = triangulate(stack(poses[:3]), pixels[:, :3], 0.1)
    error = np.linalg.norm(found.points - points, axis=-1)
    assert np.median(error) < 1.02 * np.median(np.linalg.norm(three.points - points, axis=-1))


def test_subjects_and_points_may_have_any_leading_shape():
    poses, points = arc(4), scattered(24)
    pixels = see(points, poses)
    flat = triangulate(stack(poses), pixels, 1.0)
    shaped = triangulate(stack(poses), pixels.reshape(2, 3, 4, 4, 2), np.ones(4))
    np.testing.assert_array_equal(shaped.points.reshape(-1, 3), flat.points)
    assert shaped.covariance.shape == (2, 3, 4, 3, 3)
    assert shaped.inliers.shape == shaped.residuals.shape == (2, 3, 4, 4)
    assert triangulate(stack(poses), np.empty((0, 4, 2)), 1.0).points.shape == (0, 3)


def test_points_without_noise_are_exact():
    poses, points = arc(7), scattered(200)
    found = triangulate(stack(poses), see(points, poses), 1.0)
    np.testing.assert_allclose(found.points, points, atol=1e-9)
    assert found.residuals.max() < 1e-5


def test_many_points_do_not_depend_on_how_they_are_divided():
    rng, poses, points = np.random.default_rng(4), arc(6), scattered(2500)
    pixels, _ = with_gross_outliers(see(points, poses) + rng.normal(0, SIGMA, (2500, 6, 2)), 0.1, rng)
    together = triangulate(stack(poses), pixels, SIGMA)
    for part in (slice(0, 700), slice(2000, 2500)):
        alone = triangulate(stack(poses), pixels[part], SIGMA)
        both = alone.ok & together.ok[part]
        assert (alone.ok == together.ok[part]).mean() > 0.99
        np.testing.assert_allclose(alone.points[both], together.points[part][both], atol=1e-4)


def test_half_of_the_views_may_be_wrong():
    rng, poses, points = np.random.default_rng(5), arc(12), scattered(300)
    pixels = see(points, poses) + rng.normal(0, SIGMA, (300, 12, 2))
    wrong = rng.random((300, 12)).argsort(axis=1) < 6
    pixels[wrong] += rng.uniform(40, 400, (wrong.sum(), 2)) * rng.choice([-1, 1], (wrong.sum(), 2))
    found = triangulate(stack(poses), pixels, SIGMA)
    assert found.ok.all()
    assert (found.inliers == ~wrong).mean() > 0.999
    assert np.linalg.norm(found.points - points, axis=-1).max() < 0.002


def test_outliers_keep_their_residual():
    poses, points = arc(6), scattered(1)
    pixels = see(points, poses)
    pixels[0, 2] += (30, 40)
    found = triangulate(stack(poses), pixels, SIGMA)
    assert found.inliers[0].tolist() == [True, True, False, True, True, True]
    assert found.residuals[0, 2] == pytest.approx(50, rel=0.01)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_views_are_too_few(count):
    poses = arc(4)
    pixels = see(scattered(3), poses)
    pixels[:, count:] = np.nan
    found = triangulate(stack(poses), pixels, 1.0)
    assert (found.reason == Reason.TOO_FEW_VIEWS).all()
    assert np.isnan(found.points).all()
    assert np.isnan(found.covariance).all()
    assert not found.inliers.any()


def test_one_camera_is_too_few():
    poses = arc(1)
    found = triangulate(stack(poses), see(scattered(2), poses), 1.0)
    assert (found.reason == Reason.TOO_FEW_VIEWS).all()


def test_rays_that_diverge_meet_behind_the_cameras():
    left = looking_at_origin(0)
    right = Rigid(left.rotation, left.translation - (0.2, 0, 0))  # 0.2 m to the right in the image
    toward = see(np.zeros((1, 3)), [left, right])
    apart = toward[:, ::-1]
    assert triangulate(stack([left, right]), toward, 1.0).reason[0] == Reason.OK
    assert triangulate(stack([left, right]), apart, 1.0).reason[0] == Reason.BEHIND


def test_a_view_that_has_the_point_behind_it_is_an_outlier():
    poses = arc(5)
    turned = np.diag([-1.0, 1.0, -1.0])  # looks away, and sees on the film where the ray backwards would go
    away = Rigid(turned @ poses[2].rotation, turned @ poses[2].translation)
    pixels = see(np.zeros((1, 3)), poses)
    pixels[0, 2] = LENS.params[2:4]
    found = triangulate(stack([*poses[:2], away, *poses[3:]]), pixels, 1.0)
    assert found.inliers[0].tolist() == [True, True, False, True, True]
    assert np.isnan(found.residuals[0, 2])


def test_two_views_that_contradict_each_other_are_no_consensus():
    poses = [looking_at_origin(-20), looking_at_origin(20)]
    pixels = see(np.zeros((1, 3)), poses)
    pixels[0, 0, 1] += 50
    assert triangulate(stack(poses), pixels, 1.0).reason[0] == Reason.NO_CONSENSUS


def test_two_of_three_views_are_no_consensus():
    """Any two views agree on something somewhere along their epipolar lines; three views need three."""
    poses = arc(3)
    pixels = see(np.zeros((1, 3)), poses)
    pixels[0, 1] += (150, 90)
    found = triangulate(stack(poses), pixels, 1.0)
    assert found.reason[0] == Reason.NO_CONSENSUS
    assert np.isnan(found.points).all()


@pytest.mark.parametrize(("degrees", "expected"), [(1.0, Reason.SMALL_ANGLE), (3.0, Reason.OK)])
def test_views_that_are_almost_parallel_give_no_point(degrees, expected):
    poses = [looking_at_origin(0), looking_at_origin(degrees)]
    pixels = see(scattered(20), poses) + np.random.default_rng(6).normal(0, 0.2, (20, 2, 2))
    found = triangulate(stack(poses), pixels, 0.2)
    assert (found.reason == expected).all()
    narrow = triangulate(stack(poses), pixels, 0.2, TriangulationOptions(minimum_angle_degrees=0.1))
    assert narrow.ok.all()
    np.testing.assert_allclose(np.degrees(narrow.angle), degrees, rtol=0.2)


def test_the_angle_is_that_of_the_two_most_different_inliers():
    poses = [looking_at_origin(angle) for angle in (0, 10, 25, 70)]
    pixels = see(np.zeros((1, 3)), poses)
    assert np.degrees(triangulate(stack(poses), pixels, 1.0).angle[0]) == pytest.approx(70)
    pixels[0, 3] += 200
    assert np.degrees(triangulate(stack(poses), pixels, 1.0).angle[0]) == pytest.approx(25)


def test_pixels_beyond_the_lens_count_as_not_seen():
    folding = Camera("OPENCV", *SIZE, np.array([3550.0, 3550.0, 512.0, 768.0, -8.0, 0.0, 0.0, 0.0]))
    poses, points = arc(4), scattered(5) / 4
    pixels = see(points, poses, folding)
    pixels[0, 1] = (512 + 900, 768)  # no direction has this image
    found = triangulate(stack(poses, folding), pixels, 1.0)
    assert found.ok.all()
    assert not found.inliers[0, 1]
    assert np.isnan(found.residuals[0, 1])
    np.testing.assert_allclose(found.points, points, atol=1e-9)


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf])
def test_a_deviation_that_is_none_is_refused_by_its_place(sigma):
    poses = arc(3)
    sigmas = np.ones((2, 3))
    sigmas[1, 2] = sigma
    with pytest.raises(GeometryError, match=r"sigmas\[1, 2\]: .* not a positive number"):
        triangulate(stack(poses), see(scattered(2), poses), sigmas)


def test_a_deviation_is_not_needed_where_nothing_is_seen():
    poses = arc(3)
    pixels, sigmas = see(scattered(2), poses), np.ones((2, 3))
    pixels[1, 2], sigmas[1, 2] = np.nan, np.nan
    assert triangulate(stack(poses), pixels, sigmas).ok.all()


@pytest.mark.parametrize("shape", [(3, 2), (5, 4, 2), (2,)])
def test_pixels_of_another_number_of_views_are_refused(shape):
    with pytest.raises(GeometryError, match="pixels: the shape"):
        triangulate(stack(arc(6)), np.zeros(shape), 1.0)


def test_agrees_with_pycolmap():
    pycolmap = pytest.importorskip("pycolmap")
    rng, poses, points = np.random.default_rng(7), arc(8), scattered(20)
    pixels = see(points, poses) + rng.normal(0, SIGMA, (20, 8, 2))
    camera = pycolmap.Camera(model="OPENCV", width=SIZE[0], height=SIZE[1], params=LENS.params)
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = 4 * SIGMA
    found = triangulate(stack(poses), pixels, SIGMA)
    for index in range(20):
        theirs = pycolmap.estimate_triangulation(
            pixels[index], [pycolmap.Rigid3d(pose.matrix[:3]) for pose in poses], [camera] * 8, options
        )
        deviation = np.sqrt(np.trace(found.covariance[index]))
        assert np.linalg.norm(theirs["xyz"] - found.points[index]) < deviation
