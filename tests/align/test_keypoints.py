"""Schemes: twins of left and right, and the five keypoints in both numberings."""

import numpy as np
import pytest

from preface.align.keypoints import CANONICAL_KEYPOINTS, FACEMESH478, IBUG68, SCHEMES

BOTH = pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES)


@BOTH
def test_the_twin_of_the_twin_is_the_landmark_itself(scheme):
    assert scheme.mirror.shape == (scheme.size,)
    np.testing.assert_array_equal(scheme.mirror[scheme.mirror], np.arange(scheme.size))


@BOTH
def test_keypoints_of_the_middle_stay_and_the_eyes_swap_in_the_mirror(scheme):
    twins = {
        name: tuple(scheme.mirror[list(scheme.keypoints[name])].tolist()) for name in CANONICAL_KEYPOINTS
    }
    assert twins["right_eye_outer"] == scheme.keypoints["left_eye_outer"]
    for name in ("nose_tip", "mouth_center", "chin"):
        assert set(twins[name]) == set(scheme.keypoints[name])


def test_twins_keep_the_edges_of_facemesh():
    from mediapipe.python.solutions import face_mesh_connections as connections

    for edges in ("FACEMESH_LIPS", "FACEMESH_FACE_OVAL"):
        given = {frozenset(edge) for edge in getattr(connections, edges)}
        assert {frozenset(FACEMESH478.mirror[list(edge)].tolist()) for edge in given} == given
    right = {frozenset(edge) for edge in connections.FACEMESH_RIGHT_EYE | connections.FACEMESH_RIGHT_IRIS}
    left = {frozenset(edge) for edge in connections.FACEMESH_LEFT_EYE | connections.FACEMESH_LEFT_IRIS}
    assert {frozenset(FACEMESH478.mirror[list(edge)].tolist()) for edge in right} == left


def test_ibug_twins_cross_the_middle():
    points = {
        0: 16,
        8: 8,
        17: 26,
        27: 27,
        31: 35,
        36: 45,
        39: 42,
        41: 46,
        48: 54,
        57: 57,
        58: 56,
        60: 64,
        67: 65,
    }
    assert {index: int(IBUG68.mirror[index]) for index in points} == points


def test_keypoints_are_means_and_missing_where_a_part_is_missing():
    pixels = np.stack([np.arange(478.0), -np.arange(478.0)], -1)
    np.testing.assert_array_equal(FACEMESH478.keypoint_pixels(pixels)[:, 0], [33, 263, 1, (13 + 14) / 2, 152])
    pixels[14] = np.nan
    assert np.isnan(FACEMESH478.keypoint_pixels(pixels)).any(-1).tolist() == [
        False,
        False,
        False,
        True,
        False,
    ]
