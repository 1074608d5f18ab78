"""Each subject gets one similarity; what is odd is flagged, what is impossible is refused."""

from dataclasses import replace

import numpy as np
import pytest
from faces import FACE
from scipy.spatial.transform import Rotation
from test_template import keypoints

from preface.align.errors import AlignmentError
from preface.align.options import AlignmentOptions
from preface.align.placement import place_subject
from preface.align.template import build_template
from preface.geometry import Similarity

FREE, FIXED = AlignmentOptions(), AlignmentOptions(scale="fixed")
CHIN = 4


def template(face=FACE):
    return build_template({"id0000": keypoints(face)}, "ibug68", 260, procrustes=False)


def moved(scale=1.0, seed=0, face=FACE):
    """A face elsewhere, and where it was moved from."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0, 1, 3)).as_matrix()
    there = Similarity(scale, turn, rng.normal(0, 1, 3))
    return keypoints(there.apply(face))


def codes(placement):
    return [flag.code for flag in placement.flags]


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
def test_a_face_is_brought_onto_the_template(scale):
    person = moved(scale)
    placement = place_subject(person, template(), FREE)
    there = placement.canonical_from_rig.apply(person.positions)
    np.testing.assert_allclose(there, template().keypoints, atol=1e-14)
    assert float(placement.canonical_from_rig.scale) == pytest.approx(1 / scale)
    assert np.linalg.det(placement.canonical_from_rig.rotation) == pytest.approx(1)
    np.testing.assert_allclose(placement.residuals, 0, atol=1e-14)
    assert placement.weights.sum() == pytest.approx(1)
    assert codes(placement) == []


def test_a_fixed_scale_stays_one():
    person = moved(1.1)
    placement = place_subject(person, template(), FIXED)
    assert float(placement.canonical_from_rig.scale) == 1.0
    assert placement.residuals.max() > 0.003
    assert codes(placement) == []


def test_residuals_are_distances_in_the_canonical_frame():
    face = FACE.copy()
    face[CHIN] += (0, -0.01, 0)
    person = moved(1.05, face=face)
    placement = place_subject(person, template(), FREE)
    there = placement.canonical_from_rig.apply(person.positions)
    expected = np.linalg.norm(there - template().keypoints, axis=-1)
    np.testing.assert_allclose(placement.residuals, expected)
    assert 0.001 < placement.residuals.max() < 0.01


def test_a_badly_known_keypoint_counts_less():
    face = FACE.copy()
    face[CHIN] += (0, -0.01, 0)
    person = moved(face=face)
    vague = person.covariance.copy()
    vague[CHIN] = 0.02**2 * np.eye(3)
    sure = place_subject(person, template(), FREE)
    unsure = place_subject(replace(person, covariance=vague), template(), FREE)
    assert unsure.weights[CHIN] < 0.1 * sure.weights[CHIN]
    assert np.delete(unsure.residuals, CHIN).max() < 0.2 * np.delete(sure.residuals, CHIN).max()


def test_well_known_keypoints_all_count_the_same():
    np.testing.assert_allclose(place_subject(moved(), template(), FREE).weights, 0.2, rtol=1e-3)


def test_a_missing_keypoint_is_left_out():
    person = moved()
    points = person.positions.copy()
    points[CHIN] = np.nan
    placement = place_subject(keypoints(points), template(), FREE)
    assert placement.weights[CHIN] == 0
    assert np.isnan(placement.residuals[CHIN])
    np.testing.assert_allclose(placement.residuals[:CHIN], 0, atol=1e-14)


def test_too_few_keypoints_are_refused_with_their_reasons():
    person = moved()
    points = person.positions.copy()
    points[[2, CHIN]] = np.nan
    with pytest.raises(AlignmentError, match=r"3 of the five keypoints.*nose_tip \(seen by fewer.*chin"):
        place_subject(keypoints(points), template(), FREE)


@pytest.mark.parametrize("change", [lambda face: face[[1, 0, 2, 3, 4]], lambda face: face * (-1, 1, 1)])
def test_left_and_right_exchanged_is_refused_and_named(change):
    with pytest.raises(AlignmentError, match="left and right seem to be exchanged"):
        place_subject(moved(face=change(FACE)), template(), FREE)


def test_one_keypoint_far_off_is_flagged_and_left_out():
    face = FACE.copy()
    face[CHIN] += (0.0, -0.05, 0.0)
    placement = place_subject(moved(face=face), template(), FREE)
    assert codes(placement) == ["shape"]
    assert "chin 50 mm" in placement.flags[0].text
    assert placement.weights[CHIN] == 0
    assert placement.residuals[CHIN] == pytest.approx(0.05)
    assert placement.residuals[:CHIN].max() < 1e-12


@pytest.mark.parametrize(
    ("units_per_metre", "name"),
    [(1000, "millimetres"), (100, "centimetres"), (1 / 0.0254, "inches"), (0.001, "kilometres")],
)
def test_a_rig_in_another_unit_is_flagged_and_named(units_per_metre, name):
    placement = place_subject(moved(units_per_metre), template(), FREE)
    assert codes(placement) == ["unit"]
    assert name in placement.flags[0].text
    np.testing.assert_allclose(placement.residuals, 0, atol=1e-12)


def test_a_unit_is_not_taken_for_granted_where_the_scale_is_fitted_and_may_be_arbitrary():
    (flag,) = place_subject(moved(1 / 0.0254), template(), FREE).flags
    assert "39.4 times as large as the template's, as with a rig in inches, or" in flag.text
    assert "scale is arbitrary" in flag.text
    (odd,) = place_subject(moved(7.3), template(), FREE).flags
    assert odd.code == "unit"
    assert "7.3 times as large as the template's, or with one whose scale is arbitrary" in odd.text


def test_the_size_of_a_face_says_nothing_where_the_scale_is_known_to_be_arbitrary():
    placement = place_subject(moved(1 / 0.0254), template(), FREE, metric=False)
    assert placement.flags == ()
    np.testing.assert_allclose(placement.residuals, 0, atol=1e-12)


def test_with_a_fixed_scale_another_unit_is_refused_and_named():
    with pytest.raises(AlignmentError, match=r"rig seems to be in millimetres.*correct the rig"):
        place_subject(moved(1000), template(), FIXED)


@pytest.mark.parametrize("options", [FREE, FIXED])
def test_a_face_of_improbable_size_is_flagged(options):
    placement = place_subject(moved(1.5), template(), replace(options, shape_tolerance=0.5))
    assert codes(placement) == ["scale"]
    assert "1.5 times as large" in placement.flags[0].text


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (np.repeat(FACE[:1], 5, axis=0), "coincide"),
        (np.arange(5)[:, None] * np.array([0.01, 0.02, 0.0]), "collinear"),
    ],
)
def test_degenerate_keypoints_are_refused(points, said):
    with pytest.raises(AlignmentError, match=said):
        place_subject(keypoints(points), template(), FREE)
