"""Rigid motions and similarities form groups, and refuse what is none of theirs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from preface.geometry import (
    GeometryError,
    Rigid,
    Similarity,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_from_quaternion,
    validate_rotation,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_rigid(rng: np.random.Generator, *batch: int) -> Rigid:
    return Rigid(nearest_rotation(rng.normal(size=(*batch, 3, 3))), rng.normal(size=(*batch, 3)))


def random_similarity(rng: np.random.Generator, *batch: int) -> Similarity:
    rigid = random_rigid(rng, *batch)
    return Similarity(np.exp(rng.normal(size=batch)), rigid.rotation, rigid.translation)


@given(SEEDS)
def test_composition_applies_the_right_one_first(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(5, 3))
    for a in (random_rigid(rng), random_similarity(rng)):
        for b in (random_rigid(rng), random_similarity(rng)):
            np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-12)
            np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-12)


@given(SEEDS)
def test_inverse_undoes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(5, 3))
    for transform in (random_rigid(rng), random_similarity(rng)):
        np.testing.assert_allclose(transform.inverse.apply(transform.apply(points)), points, atol=1e-12)
        np.testing.assert_allclose((transform @ transform.inverse).matrix, np.eye(4), atol=1e-12)


@given(SEEDS)
def test_quaternions_and_matrices_hold_the_same_transform(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rigid, similarity = random_rigid(rng, 4), random_similarity(rng, 4)
    again = Rigid.from_quaternion(rigid.quaternion_wxyz, rigid.translation)
    np.testing.assert_allclose(again.matrix, rigid.matrix, atol=1e-14)
    np.testing.assert_allclose(Rigid.from_matrix(rigid.matrix).matrix, rigid.matrix, atol=0)
    np.testing.assert_allclose(
        Similarity.from_matrix(similarity.matrix).matrix, similarity.matrix, rtol=1e-14
    )
    parts = similarity.scale, similarity.quaternion_wxyz, similarity.translation
    np.testing.assert_allclose(Similarity.from_quaternion(*parts).matrix, similarity.matrix, atol=1e-13)


def test_quaternions_are_scalar_first_with_positive_sign() -> None:
    quarter_turn_about_z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quaternion_from_rotation(quarter_turn_about_z), [half, 0, 0, half], atol=1e-15)
    np.testing.assert_allclose(
        rotation_from_quaternion([-half, 0, 0, -half]), quarter_turn_about_z, atol=1e-15
    )
    half_turn = quaternion_from_rotation(np.diag([-1.0, -1.0, 1.0]))
    np.testing.assert_allclose(half_turn, [0, 0, 0, 1], atol=1e-15)
    angles = np.linspace(-3 * np.pi, 3 * np.pi, 500)
    turns = Rotation.from_rotvec(angles[:, None] * np.array([0.6, 0.0, -0.8])).as_matrix()
    assert (quaternion_from_rotation(turns)[:, 0] >= 0).all()


def test_a_batch_of_transforms_moves_a_batch_of_points() -> None:
    rng = np.random.default_rng(0)
    batch, points = random_similarity(rng, 7), rng.normal(size=(7, 3))
    moved = batch.apply(points)
    for i in range(7):
        one = Similarity(batch.scale[i], batch.rotation[i], batch.translation[i])
        np.testing.assert_allclose(moved[i], one.apply(points[i]), atol=1e-14)


def test_a_camera_carried_along_sees_the_mapped_scene_from_the_same_direction() -> None:
    rng = np.random.default_rng(0)
    canonical_from_rig, rig_from_camera = random_similarity(rng), random_rigid(rng)
    points = rng.normal(size=(9, 3))
    seen = rig_from_camera.inverse.apply(points)
    carried = canonical_from_rig.apply_to_pose(rig_from_camera)
    seen_after = carried.inverse.apply(canonical_from_rig.apply(points))
    np.testing.assert_allclose(seen_after, canonical_from_rig.scale * seen, atol=1e-12)


def test_nearest_rotation_repairs_few_digits_and_mirrors() -> None:
    rotation = random_rigid(np.random.default_rng(5)).rotation
    np.testing.assert_allclose(nearest_rotation(np.round(rotation, 4)), rotation, atol=2e-4)
    validate_rotation(nearest_rotation(np.round(rotation, 4)))
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1)


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), "determinant -1 .*an axis is mirrored"),
        (np.zeros((3, 3)), "determinant 0 .*an axis is mirrored or lost"),
        (2 * np.eye(3), "determinant 8 .*orthogonality defect 3 .*a scaled rotation is a Similarity"),
        (np.eye(3) + 1e-5, "too few digits: pass it through nearest_rotation"),
        (np.full((3, 3), np.nan), r"rotation: \[0, 0\] is not finite"),
        (np.eye(4), r"its shape \(4, 4\) does not end in \(3, 3\)"),
        (np.stack([np.eye(3), 2 * np.eye(3)]), r"rotation\[1\]: not a rotation"),
        ("R", "not an array of numbers"),
    ],
)
def test_matrices_that_do_not_rotate_are_refused(rotation: np.ndarray, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        Rigid(rotation, np.zeros(3))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan])
def test_scales_that_collapse_or_mirror_are_refused(scale: float) -> None:
    with pytest.raises(GeometryError, match="scale"):
        Similarity(scale, np.eye(3), np.zeros(3))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(4).T + np.eye(4, k=-3), "last row is not"),
        (np.eye(3), "does not end in"),
        (np.diag([1.0, 1, -1, 1]), "mirrored"),
        (np.diag([1.0, 2, 3, 1]), "not a rotation"),
    ],
)
def test_matrices_that_are_no_similarity_are_refused(matrix: np.ndarray, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        Similarity.from_matrix(matrix)


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [2, 0, 0, 0], [np.nan, 0, 0, 1], [1, 0, 0]])
def test_quaternions_that_are_not_unit_are_refused(quaternion: list[float]) -> None:
    with pytest.raises(GeometryError, match="quaternion_wxyz"):
        Rigid.from_quaternion(quaternion, np.zeros(3))
