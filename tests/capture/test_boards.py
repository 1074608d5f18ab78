"""Boards are counted and measured as OpenCV does, and impossible descriptions are refused."""

import cv2
import numpy as np
import pytest

from preface.capture.boards import (
    BoardError,
    board_in_words,
    board_points,
    describe_board,
    marker_corners,
    parse_squares,
)

DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("squares", [(5, 4), (4, 5), (6, 6), (5, 5), (7, 10)])
def test_charuco_boards_are_opencvs(squares, legacy):
    ours = describe_board("charuco", squares, 0.05, 0.04, "DICT_5X5_250", legacy=legacy)
    theirs = cv2.aruco.CharucoBoard(squares, 0.05, 0.04, DICTIONARY)
    theirs.setLegacyPattern(legacy)
    np.testing.assert_allclose(board_points(ours), theirs.getChessboardCorners(), atol=1e-7)
    np.testing.assert_allclose(marker_corners(ours), np.array(theirs.getObjPoints())[..., :2], atol=1e-7)


def test_aprilgrids_are_opencvs_grid_boards():
    ours = describe_board("aprilgrid", (4, 3), 0.05, 0.04, "DICT_5X5_250")
    theirs = cv2.aruco.GridBoard((4, 3), 0.04, 0.01, DICTIONARY)
    np.testing.assert_allclose(board_points(ours), np.array(theirs.getObjPoints()).reshape(-1, 3), atol=1e-7)


def test_a_chessboard_is_described_by_its_inner_corners_and_kept_by_its_squares():
    board = describe_board("chessboard", (9, 6), 0.01)
    assert board.squares == (10, 7)
    points = board_points(board)
    assert len(points) == 54
    np.testing.assert_allclose(points[[0, 1, 9]], [[0.01, 0.01, 0], [0.02, 0.01, 0], [0.01, 0.02, 0]])
    assert board_in_words(board) == "chessboard of 9x6 inner corners"


def test_squares_are_columns_by_rows():
    assert parse_squares("9x6") == (9, 6)
    for text in ("9", "9x", "9,6", "-9x6", "9x6x2"):
        with pytest.raises(BoardError, match="write for example 9x6"):
            parse_squares(text)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("checkers", (5, 4), 0.05), "'checkers' is not a kind of board"),
        (("charuco", (5, 4), 0.05), "marker_size: is missing"),
        (("charuco", (5, 4), 0.05, 0.04), "dictionary: is missing"),
        (("charuco", (5, 4), 0.05, 0.06, "DICT_4X4_50"), "marker_size: 0.06 m is not between"),
        (("charuco", (5, 4), 54.0, 40.0, "DICT_4X4_50"), "square_size: 54.0 is not a length in metres"),
        (("chessboard", (9, 6), 10.0), "25 mm are 0.025"),
        (("charuco", (5, 4), 0.05, 0.04, "DICT_4X4_55"), "Perhaps 'DICT_4X4_50' was meant"),
        (("charuco", (15, 14), 0.05, 0.04, "DICT_4X4_50"), "holds 50 markers, but the board shows 105"),
        (("charuco", (1, 4), 0.05, 0.04, "DICT_4X4_50"), "squares: 1x4 cannot be"),
        (("chessboard", (9, 6), 0.05, 0.04), "marker_size: a chessboard has none"),
        (("chessboard", (1, 6), 0.05), "squares: 1x6 cannot be"),
    ],
)
def test_impossible_boards_are_refused(arguments, said):
    with pytest.raises(BoardError, match=said):
        describe_board(*arguments)
