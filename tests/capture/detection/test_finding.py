"""A board is found where it is, counted from its own top left, and only when it is the board described."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_pictures import APRILGRID, CHARUCO, CHESSBOARD, HEIGHT, WIDTH, homography, picture, print_of, seen

from preface.capture.boards import board_points, describe_board
from preface.capture.finding import find_board

EVEN = describe_board("charuco", (6, 6), 0.03, 0.022, "DICT_4X4_50")
BOARDS = {
    "charuco": CHARUCO,
    "charuco, even rows": EVEN,
    "charuco, legacy": replace(EVEN, legacy=True),
    "charuco, inverted": replace(CHARUCO, inverted=True),
    "chessboard": CHESSBOARD,
    "aprilgrid": APRILGRID,
}


@pytest.mark.parametrize("name", BOARDS)
def test_corners_are_found_where_they_are(name):
    board, errors = BOARDS[name], []
    for seed in range(4):
        pose = homography(board, seed)
        found = find_board(board, picture(board, pose, seed=seed))
        assert len(found.points) > 0.9 * len(board_points(board))
        errors.append(found.pixels - seen(board, pose)[found.points])
    errors = np.concatenate(errors)
    # A tag's corner has a third of the edges that the corner of four squares has.
    assert np.sqrt((errors**2).mean()) < (0.03 if name == "aprilgrid" else 0.015)
    assert np.abs(errors).max() < 0.1
    np.testing.assert_allclose(errors.mean(axis=0), 0, atol=0.003)


def test_a_board_in_part_is_found_in_part():
    pose = np.array([[1, 0, 130.0], [0, 1, 60], [0, 0, 1]]) @ homography(CHARUCO, 1, size=1.2)
    truth = seen(CHARUCO, pose)
    inside = ((truth > 0) & (truth < (WIDTH, HEIGHT))).all(axis=1)
    found = find_board(CHARUCO, picture(CHARUCO, pose))
    assert 0.5 * inside.sum() < len(found.points) < len(truth)
    assert inside[found.points].all()
    np.testing.assert_allclose(found.pixels, truth[found.points], atol=0.5)


def test_a_chessboard_is_counted_from_the_same_end_when_the_camera_stands_on_its_head():
    pose = homography(CHESSBOARD, 2)
    half_turn = np.array([[-1, 0, WIDTH], [0, -1, HEIGHT], [0, 0, 1.0]])
    for where in (pose, half_turn @ pose):
        found = find_board(CHESSBOARD, picture(CHESSBOARD, where))
        np.testing.assert_allclose(found.pixels, seen(CHESSBOARD, where)[found.points], atol=0.5)


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=["charuco", "aprilgrid"])
def test_a_board_in_a_mirror_is_named_and_gives_no_corner(board):
    flipped = picture(board, homography(board))[:, ::-1]
    found = find_board(board, flipped)
    assert found.mirrored
    assert len(found.points) == 0


def test_a_board_of_other_squares_gives_no_corner():
    other = replace(CHARUCO, squares=(7, 5))
    found = find_board(CHARUCO, picture(other, homography(other)))
    assert found.contradictory
    assert len(found.points) == 0


def test_kalibrs_numbering_and_black_gaps_are_understood():
    """Kalibr counts its tags from the bottom left and prints black squares into the gaps."""
    columns, rows = APRILGRID.squares
    sheet = print_of(APRILGRID)
    margin, cell = 24, 40
    side, gap = 32, 8
    upwards = sheet.copy()
    for row in range(rows):
        top, source = margin + row * cell, margin + (rows - 1 - row) * cell
        upwards[top : top + side] = sheet[source : source + side]
    for row in range(rows + 1):
        for column in range(columns + 1):
            top, left = margin + row * cell - gap, margin + column * cell - gap
            upwards[top : top + gap, left : left + gap] = 0
    image = cv2.GaussianBlur(
        cv2.resize(upwards, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST), (0, 0), 0.6
    )
    kalibr = replace(APRILGRID, marker_size=0.03 * side / cell)
    found = find_board(kalibr, image)
    truth = 2 * (margin + board_points(kalibr)[:, :2] / 0.03 * cell)
    assert len(found.points) > 0.9 * len(truth)
    np.testing.assert_allclose(found.pixels, truth[found.points], atol=0.1)


@pytest.mark.parametrize(
    "board", [CHARUCO, CHESSBOARD, APRILGRID], ids=["charuco", "chessboard", "aprilgrid"]
)
def test_nothing_is_found_in_noise_or_darkness(board):
    random = np.random.default_rng(0)
    for image in (np.zeros((HEIGHT, WIDTH), np.uint8), random.integers(0, 255, (HEIGHT, WIDTH), np.uint8)):
        found = find_board(board, image)
        assert len(found.points) == 0
        assert not found.mirrored


def test_depth_and_colour_of_the_image_do_not_move_the_corners():
    grey = picture(CHARUCO, homography(CHARUCO), noise=0)
    expected = find_board(CHARUCO, grey)
    light = np.where(grey / 255 <= 0.04045, grey / 255 / 12.92, ((grey / 255 + 0.055) / 1.055) ** 2.4)
    for image in (
        grey.astype(np.uint16) * 257,
        np.repeat(grey[..., None], 3, axis=2),
        7 * light.astype(np.float32),
    ):
        found = find_board(CHARUCO, image)
        np.testing.assert_array_equal(found.points, expected.points)
        np.testing.assert_allclose(found.pixels, expected.pixels, atol=5e-3)  # how far the fit converges


def test_searching_a_reduced_image_keeps_the_accuracy():
    pose = homography(CHARUCO, 3)
    image = picture(CHARUCO, pose)
    found = find_board(CHARUCO, image, search_side=300)
    assert len(found.points) > 10
    assert np.sqrt(((found.pixels - seen(CHARUCO, pose)[found.points]) ** 2).mean()) < 0.06


def test_a_finger_on_the_board_costs_the_corners_under_it_and_moves_none():
    pose = homography(CHARUCO, 1)
    image, truth = picture(CHARUCO, pose), seen(CHARUCO, pose)
    cv2.circle(image, tuple(int(v) for v in truth[9]), 9, 90, -1)
    found = find_board(CHARUCO, image)
    assert 9 not in found.points
    assert len(found.points) >= 15
    np.testing.assert_allclose(found.pixels, truth[found.points], atol=0.3)


def test_pixels_that_are_no_number_move_no_corner():
    pose = homography(CHARUCO, 1)
    image, truth = picture(CHARUCO, pose).astype(np.float32), seen(CHARUCO, pose)
    light = (image / 255) ** 2.2
    for index, odd in ((4, np.nan), (9, np.inf)):
        column, row = truth[index].astype(int)
        light[row + 3, column - 3 : column + 4] = odd
    found = find_board(CHARUCO, light)
    assert len(found.points) >= 15
    np.testing.assert_allclose(found.pixels, truth[found.points], atol=0.3)
