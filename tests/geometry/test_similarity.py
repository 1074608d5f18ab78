"""The optimal similarity: recovered, optimal, robust, and refused where it does not exist."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from preface.geometry import (
    GeometryError,
    Similarity,
    fit_similarity,
    fit_similarity_robust,
    nearest_rotation,
)

# Outer eye corners, nose tip, mouth centre, chin; metres, roughly.
FACE = np.array(
    [[-0.045, 0.03, 0], [0.045, 0.03, 0], [0, -0.005, 0.03], [0, -0.035, 0.015], [0, -0.075, 0.005]]
)


def random_similarity(rng: np.random.Generator) -> Similarity:
    return Similarity(np.exp(rng.normal()), nearest_rotation(rng.normal(size=(3, 3))), rng.normal(size=3))


@given(st.integers(0, 2**32 - 1), st.integers(3, 20))
def test_exact_correspondences_give_the_similarity_back(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    source, truth = rng.normal(size=(count, 3)), random_similarity(rng)
    fit = fit_similarity(source, truth.apply(source), weights=rng.uniform(0.1, 1, count))
    np.testing.assert_allclose(fit.target_from_source.matrix, truth.matrix, atol=1e-10 * max(1, truth.scale))
    assert fit.rms < 1e-12 * max(1, truth.scale)
    assert not fit.mirrored


@pytest.mark.parametrize("fixed_scale", [None, 1.0])
def test_no_other_similarity_has_smaller_weighted_residuals(fixed_scale: float | None) -> None:
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(8, 3)), rng.normal(size=(8, 3))
    weights = rng.uniform(0.1, 2, 8)
    fit = fit_similarity(source, target, weights, fixed_scale)

    def cost(x: np.ndarray) -> float:
        scale = np.exp(x[6]) if fixed_scale is None else fixed_scale
        moved = scale * Rotation.from_rotvec(x[:3]).apply(source) + x[3:6]
        return float((weights * ((target - moved) ** 2).sum(-1)).sum())

    best = min(minimize(cost, rng.normal(size=7)).fun for _ in range(6))
    assert weights @ fit.residuals**2 == pytest.approx(best, rel=1e-6)
    np.testing.assert_allclose(
        fit.residuals, np.linalg.norm(target - fit.target_from_source.apply(source), axis=-1), rtol=1e-12
    )


def test_a_fixed_scale_is_kept() -> None:
    fit = fit_similarity(FACE, 1.1 * FACE, fixed_scale=1.0)
    assert fit.target_from_source.scale == 1
    assert fit.rms > 1e-3


def test_a_point_of_weight_zero_has_no_say_and_may_be_missing() -> None:
    target = FACE.copy()
    target[2] = np.nan
    fit = fit_similarity(FACE, target, weights=[1, 1, 0, 1, 1])
    np.testing.assert_allclose(fit.target_from_source.matrix, np.eye(4), atol=1e-12)
    assert np.isnan(fit.residuals).tolist() == [False, False, True, False, False]
    assert fit.inliers.tolist() == [True, True, False, True, True]


def test_coplanar_points_determine_a_rotation() -> None:
    truth = random_similarity(np.random.default_rng(2))
    source = FACE * (1, 1, 0)
    fit = fit_similarity(source, truth.apply(source))
    np.testing.assert_allclose(fit.target_from_source.matrix, truth.matrix, atol=1e-12)
    assert not fit.mirrored


def test_swapped_left_and_right_are_reported_with_both_residuals() -> None:
    swapped = FACE[[1, 0, 2, 3, 4]]
    for fit in (fit_similarity(FACE, swapped), fit_similarity_robust(FACE, swapped, threshold=0.02)):
        assert np.linalg.det(fit.target_from_source.rotation) == pytest.approx(1)
        assert fit.mirrored
        assert "left and right swapped" in fit.hint
        assert fit.mirrored_residuals.max() < 1e-12
    assert fit_similarity(FACE, swapped).residuals.max() > 1e-3


@pytest.mark.parametrize("points", [FACE, FACE * (1, 1, 0), FACE * (1, 1, 1e-3)])
def test_noise_alone_does_not_look_mirrored(points: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    fits = [fit_similarity(points, points + rng.normal(size=points.shape) * 2e-3) for _ in range(200)]
    assert not any(fit.mirrored for fit in fits)


@pytest.mark.parametrize("bad", range(5))
def test_one_bad_keypoint_of_five_is_found(bad: int) -> None:
    rng = np.random.default_rng(bad)
    truth = random_similarity(rng)
    target = truth.apply(FACE + rng.normal(size=FACE.shape) * 2e-4)
    target[bad] += truth.scale * 0.05 * np.eye(3)[bad % 3]
    fit = fit_similarity_robust(FACE, target, threshold=truth.scale * 2e-3)
    assert np.flatnonzero(~fit.inliers).tolist() == [bad]
    np.testing.assert_allclose(truth.inverse.apply(fit.target_from_source.apply(FACE)), FACE, atol=2e-3)
    assert fit.residuals[bad] > truth.scale * 0.03


@pytest.mark.parametrize(("count", "bad"), [(10, 5), (20, 10), (100, 60)])
def test_half_of_the_points_may_be_wrong(count: int, bad: int) -> None:
    rng = np.random.default_rng(count)
    truth = random_similarity(rng)
    source = rng.normal(size=(count, 3))
    target = truth.apply(source + rng.normal(size=(count, 3)) * 1e-3)
    target[:bad] = truth.apply(3 * rng.normal(size=(bad, 3)))
    fit = fit_similarity_robust(source, target, threshold=truth.scale * 0.01)
    np.testing.assert_array_equal(fit.inliers, np.arange(count) >= bad)
    np.testing.assert_allclose(fit.target_from_source.matrix, truth.matrix, atol=5e-3 * max(1, truth.scale))


def test_without_outliers_the_robust_fit_is_the_plain_one() -> None:
    rng = np.random.default_rng(0)
    target, weights = FACE + rng.normal(size=FACE.shape) * 1e-4, rng.uniform(0.5, 1, 5)
    plain = fit_similarity(FACE, target, weights, fixed_scale=1.0)
    robust = fit_similarity_robust(FACE, target, 5e-3, weights, fixed_scale=1.0)
    np.testing.assert_array_equal(robust.target_from_source.matrix, plain.target_from_source.matrix)


LINE = np.outer(np.arange(5.0), [1, 2, 3])


@pytest.mark.parametrize(
    ("source", "target", "weights", "scale", "message"),
    [
        (FACE[:2], FACE[:2], None, None, "2 points of positive weight; a similarity takes three"),
        (FACE, FACE, [1, 1, 0, 0, 0], None, "2 points of positive weight"),
        (LINE, FACE, None, None, "source: the points are collinear"),
        (FACE, LINE + 1e6, None, None, "target: the points are collinear"),
        (np.ones((5, 3)), FACE, None, None, "source: all points coincide"),
        (FACE, np.full((5, 3), 1e6), None, None, "target: all points coincide"),
        (
            FACE * np.nan,
            FACE,
            None,
            None,
            r"source\[0\]: \[nan, nan, nan\] is not finite; give it the weight 0",
        ),
        (FACE, np.where(FACE == 0.03, np.inf, FACE), None, None, r"target\[0\]"),
        (FACE, FACE[:4], None, None, "shapes"),
        (FACE, FACE, [1, 1, 1, 1], None, "weights"),
        (FACE, FACE, [1, 1, 1, 1, -1], None, "weights"),
        (FACE, FACE, None, 0.0, "fixed_scale: 0.0 is not a positive number"),
        (np.eye(3)[[0, 0, 1, 1]], np.eye(3)[[0, 1, 0, 1]], None, None, "collinear|correspond"),
        (
            np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]] * 2),
            np.array([[1.0, 0, 0]] * 4 + [[0.0, 1, 0]] * 2 + [[0.0, 0, 1]] * 2),
            None,
            None,
            "do not correspond",
        ),
    ],
)
def test_degenerate_points_are_refused_by_name(
    source: np.ndarray, target: np.ndarray, weights: list | None, scale: float | None, message: str
) -> None:
    with pytest.raises(GeometryError, match=message):
        fit_similarity(source, target, weights, scale)


def test_points_that_nothing_explains_are_refused_with_the_residuals() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(GeometryError, match="no three points agree within 1e-06"):
        fit_similarity_robust(rng.normal(size=(6, 3)), rng.normal(size=(6, 3)), threshold=1e-6)
    with pytest.raises(GeometryError, match="threshold: 0 is not a positive distance"):
        fit_similarity_robust(FACE, FACE, threshold=0)
