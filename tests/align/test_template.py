"""The template is the median face, in a frame that its own keypoints define."""

import numpy as np
import pytest
from faces import FACE
from scipy.spatial.transform import Rotation

from preface.align.errors import AlignmentError
from preface.align.keypoints3d import Keypoints, no_keypoints
from preface.align.template import bring_together, build_template, canonical_frame, require_same_scheme
from preface.geometry import Similarity


def keypoints(points):
    points = np.asarray(points, float)
    missing = ~np.isfinite(points).all(-1)
    covariance = np.where(missing[:, None, None], np.nan, 1e-8 * np.eye(3))
    reasons = tuple("seen by fewer than two views" if no else "" for no in missing)
    return Keypoints(points, covariance, np.where(missing, 0, 5), reasons)


def people(count, spread=0.003, seed=0, moved=False):
    """Faces of one shape and some variation; moved: turned, shifted and scaled each in its own way."""
    shapes = np.random.default_rng(seed).normal(0, spread, (count, 5, 3))
    rng = np.random.default_rng(seed + 1)
    faces = {}
    for index in range(count):
        face = FACE + shapes[index]
        if moved:
            turn = Rotation.from_rotvec(rng.normal(0, 0.8, 3)).as_matrix()
            face = Similarity(np.exp(rng.normal(0, 0.1)), turn, rng.normal(0, 0.5, 3)).apply(face)
        faces[f"id{index:04d}"] = keypoints(face)
    return faces


def shape(points):
    """All distances between points: what no motion changes."""
    return np.linalg.norm(points[..., :, None, :] - points[..., None, :, :], axis=-1)


def test_it_is_the_median_of_each_coordinate():
    faces = people(9)
    template = build_template(faces, "ibug68", 260, procrustes=False)
    median = np.median([face.positions for face in faces.values()], axis=0)
    np.testing.assert_allclose(
        template.canonical_from_rig.inverse.apply(template.keypoints), median, atol=1e-15
    )
    assert template.identities == tuple(faces)
    distances = np.array([face.positions - median for face in faces.values()])
    np.testing.assert_allclose(template.spread, np.sqrt((distances**2).sum(-1).mean(0)))


def test_one_odd_face_does_not_move_it():
    faces = people(9)
    before = build_template(faces, "ibug68", 260, procrustes=False)
    faces["id0004"] = keypoints(FACE * 1000)
    after = build_template(faces, "ibug68", 260, procrustes=False)
    assert np.abs(shape(after.keypoints) - shape(before.keypoints)).max() < 0.004


def test_it_takes_the_first_identities_that_have_five_keypoints():
    faces = people(6)
    faces["id0001"] = keypoints(np.where(np.arange(5)[:, None] == 4, np.nan, FACE))
    faces["id0002"] = no_keypoints("no face")
    template = build_template(faces, "ibug68", 3, procrustes=False)
    assert template.identities == ("id0000", "id0003", "id0004")


def test_without_anybody_there_is_none():
    with pytest.raises(AlignmentError, match="none of the 2 subjects has all five keypoints"):
        build_template(
            {"a": no_keypoints("no face"), "b": no_keypoints("no face")}, "ibug68", 260, procrustes=False
        )


@pytest.mark.parametrize("seed", range(3))
def test_canonical_axes_are_those_of_the_face(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0, 1, 3)).as_matrix()
    face = FACE @ turn.T + rng.normal(0, 2, 3)
    moved = canonical_frame(face).apply(face)
    right, left, nose, _, chin = moved
    np.testing.assert_allclose(moved.mean(0), 0, atol=1e-15)
    np.testing.assert_allclose((left - right)[1:], 0, atol=1e-15)
    assert left[0] > right[0]
    assert ((left + right) / 2)[1] > chin[1]
    assert ((left + right) / 2)[2] == pytest.approx(chin[2], abs=1e-15)
    assert nose[2] > chin[2]
    np.testing.assert_allclose(shape(moved), shape(FACE), atol=1e-14)


@pytest.mark.parametrize(
    ("face", "said"),
    [
        (FACE[[1, 0, 2, 3, 4]], "left and right are exchanged"),
        (FACE * (-1, 1, 1), "left and right are exchanged"),
        (np.repeat(FACE[:1], 5, axis=0), "coincide"),
        (np.arange(5)[:, None] * np.ones(3), "on one line"),
        (np.where(np.arange(5)[:, None] == 1, np.nan, FACE), "five finite keypoints"),
    ],
)
def test_what_is_no_face_has_no_canonical_frame(face, said):
    with pytest.raises(AlignmentError, match=said):
        canonical_frame(face)


def test_procrustes_finds_the_shape_whatever_the_poses_and_sizes():
    together = build_template(people(40), "ibug68", 260, procrustes=True)
    moved = build_template(people(40, moved=True), "ibug68", 260, procrustes=True)
    ratio = shape(moved.keypoints).max() / shape(together.keypoints).max()
    np.testing.assert_allclose(shape(moved.keypoints), ratio * shape(together.keypoints), atol=1e-9)
    assert moved.spread.max() < 0.01
    assert build_template(people(40, moved=True), "ibug68", 260, procrustes=False).spread.min() > 0.3


def test_procrustes_keeps_the_mean_size_and_the_first_pose():
    faces = np.stack([FACE * size for size in (0.8, 1.0, 1.25)])
    together, upright_from_rig = bring_together(faces + 5)
    np.testing.assert_allclose(shape(together), np.stack([shape(FACE)] * 3), rtol=1e-9)
    np.testing.assert_allclose(upright_from_rig.inverse.apply(together[0]).mean(0), 0.8 * FACE.mean(0) + 5)


def test_a_template_of_another_scheme_is_refused():
    template = build_template(people(3), "ibug68", 260, procrustes=False)
    require_same_scheme(template, ["ibug68", "ibug68"])
    with pytest.raises(AlignmentError, match="made from ibug68 landmarks, and these are facemesh478"):
        require_same_scheme(template, ["ibug68", "facemesh478"])
