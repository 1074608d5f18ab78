"""Small photographs of boards with known corners: OpenCV's print, seen in perspective, area-filtered."""

import struct

import cv2
import numpy as np

from preface.capture.boards import board_points, describe_board

WIDTH, HEIGHT = 400, 300
FINE = 4  # samples per pixel and axis
CELL = 40  # samples per square in the print
MARGIN = 0.6  # squares of paper about the print

CHARUCO = describe_board("charuco", (5, 7), 0.03, 0.022, "DICT_4X4_50")
CHESSBOARD = describe_board("chessboard", (6, 5), 0.03)
APRILGRID = describe_board("aprilgrid", (4, 3), 0.03, 0.024, "DICT_APRILTAG_36h11")


def print_of(board):
    """The print, uint8, CELL samples per square, with MARGIN of paper about it."""
    columns, rows = board.squares
    margin = round(MARGIN * CELL)
    if board.type == "chessboard":
        row, column = np.indices((rows, columns))
        sheet = np.kron(np.where((row + column) % 2, 255, 0), np.ones((CELL, CELL))).astype(np.uint8)
        return np.pad(sheet, margin, constant_values=255)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    if board.type == "charuco":
        drawn = cv2.aruco.CharucoBoard(board.squares, board.square_size, board.marker_size, dictionary)
        drawn.setLegacyPattern(bool(board.legacy))
        sheet = drawn.generateImage((columns * CELL, rows * CELL), marginSize=0)
        sheet = np.pad(sheet, margin, constant_values=255)
    else:
        sheet = np.full((rows * CELL + 2 * margin, columns * CELL + 2 * margin), 255, np.uint8)
        side = round(CELL * board.marker_size / board.square_size)  # a multiple of a tag's 8 bits
        for tag in range(rows * columns):
            row, column = divmod(tag, columns)
            top, left = margin + row * CELL, margin + column * CELL
            sheet[top : top + side, left : left + side] = cv2.aruco.generateImageMarker(dictionary, tag, side)
    return 255 - sheet if board.inverted else sheet


def homography(board, seed=0, tilt=0.25, size=0.8):
    """Pixels (COLMAP's) from metres on the board: turned, tilted and placed near the middle of the image."""
    random = np.random.default_rng(seed)
    width, height = np.array(board.squares) * board.square_size
    scale = size * HEIGHT / max(width, height)
    angle = random.uniform(-0.4, 0.4)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    centre = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1]])
    tilted = np.eye(3)
    tilted[2, :2] = random.uniform(-tilt, tilt, 2) / max(width, height)
    place = np.array([[scale, 0, WIDTH / 2], [0, scale, HEIGHT / 2], [0, 0, 1.0]])
    place[:2, 2] += random.uniform(-8, 8, 2)
    return place @ tilted @ turn @ centre


def picture(board, pixels_from_board, noise=1.5, seed=0):
    """A grey photograph [HEIGHT, WIDTH] of a board on a textured ground."""
    sheet = print_of(board)
    # The sheet's samples, whole numbers at their middles, to metres, to fine samples of the image.
    metres = np.diag([board.square_size / CELL] * 2 + [1.0])
    metres[:2, 2] = board.square_size * (0.5 / CELL - MARGIN)
    fine = np.array([[FINE, 0, -0.5], [0, FINE, -0.5], [0, 0, 1.0]])
    random = np.random.default_rng(seed)
    light = cv2.resize(random.uniform(0.05, 0.2, (9, 12)).astype(np.float32), (WIDTH * FINE, HEIGHT * FINE))
    cv2.warpPerspective(
        np.where(sheet > 127, 0.7, 0.02).astype(np.float32), fine @ pixels_from_board @ metres,
        light.shape[::-1], light, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT,
    )  # fmt: skip
    light = light.reshape(HEIGHT, FINE, WIDTH, FINE).mean(axis=(1, 3))
    light = cv2.GaussianBlur(light, (0, 0), 0.5)
    encoded = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(encoded + noise * random.standard_normal(light.shape)), 0, 255).astype(np.uint8)


def seen(board, pixels_from_board):
    """True pixels [P, 2] of the board's points."""
    points = board_points(board)[:, :2]
    return cv2.perspectiveTransform(points[None], pixels_from_board)[0]


def ask_for_rotation(mp4):
    """Have an MP4 file ask for a quarter turn, as phones do: by the matrix in its track header."""
    content = bytearray(mp4.read_bytes())
    # ISO 14496-12: after the type "tkhd" of version 0 come 40 bytes, then the matrix (16.16; the last column 2.30).
    matrix = content.index(b"tkhd") + 4 + 40
    upright = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    assert content[matrix : matrix + 36] == upright
    content[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    mp4.write_bytes(content)
