"""The boards are exactly the ones that OpenCV knows."""

import cv2
import numpy as np
import pytest

from synthetic_studio.config import BoardConfig
from synthetic_studio.patterns import INK, NOTHING, PAPER, BoardPattern

SIZES = [(7, 10), (6, 9), (9, 6), (8, 11), (12, 9), (3, 4)]


def opencv_board(pattern):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, pattern.dictionary))
    return cv2.aruco.CharucoBoard(pattern.squares, pattern.square, pattern.marker, dictionary)


def colour_at(pattern, x, y):
    column, row = np.searchsorted(pattern.edges[0], x), np.searchsorted(pattern.edges[1], y)
    return pattern.cells[np.ix_(row, column)]


@pytest.mark.parametrize("squares", SIZES)
def test_corners_are_where_opencv_has_them_and_in_its_order(squares):
    pattern = BoardPattern.from_config(BoardConfig(squares=squares))
    # OpenCV keeps them as float32.
    np.testing.assert_allclose(pattern.corners, opencv_board(pattern).getChessboardCorners(), atol=1e-7)


@pytest.mark.parametrize("squares", SIZES)
def test_every_marker_bit_is_where_opencv_has_it(squares):
    pattern = BoardPattern.from_config(BoardConfig(squares=squares))
    board = opencv_board(pattern)
    middles = (np.arange(6) + 0.5) / 6
    for identity, outline in zip(board.getIds().ravel(), board.getObjPoints(), strict=True):
        left, top, right, bottom = *outline[0, :2], *outline[2, :2]
        seen = colour_at(pattern, left + middles * (right - left), top + middles * (bottom - top))
        expected = cv2.aruco.generateImageMarker(board.getDictionary(), int(identity), 6)
        np.testing.assert_array_equal(seen == INK, expected == 0)


def test_squares_of_a_chessboard_alternate_from_a_black_first_one():
    pattern = BoardPattern.from_config(BoardConfig(kind="chessboard", squares=(4, 3), square_mm=10))
    colours = colour_at(pattern, np.arange(4) * 0.01 + 0.005, np.arange(3) * 0.01 + 0.005)
    np.testing.assert_array_equal(colours == INK, np.indices((3, 4)).sum(axis=0) % 2 == 0)


def test_there_is_white_paper_around_the_pattern_and_nothing_beyond():
    pattern = BoardPattern.from_config(BoardConfig())
    x = np.array([-2, -0.5, *(pattern.extent[0] / pattern.margin + [0.5, 2])]) * pattern.margin
    colours = colour_at(pattern, x, pattern.extent[1:] / 2)[0]
    np.testing.assert_array_equal(colours, [NOTHING, PAPER, PAPER, NOTHING])


def test_bow_is_highest_in_the_middle_and_zero_at_the_outermost_corners():
    pattern = BoardPattern.from_config(BoardConfig(bow_mm=(1.0, 0.5)))
    heights = pattern.corners[:, 2].reshape(9, 6)
    assert pattern.height(pattern.extent / 2) == pytest.approx(1.5e-3)
    np.testing.assert_allclose(heights[[0, 0, -1, -1], [0, -1, 0, -1]], 0, atol=1e-15)


def test_slope_is_the_derivative_of_the_height():
    pattern = BoardPattern.from_config(BoardConfig(bow_mm=(1.0, -0.5)))
    here, step = np.array([0.03, 0.2]), 1e-6
    numeric = [
        (pattern.height(here + step * axis) - pattern.height(here - step * axis)) / (2 * step)
        for axis in np.eye(2)
    ]
    np.testing.assert_allclose(pattern.slope(here), numeric, rtol=1e-6)
