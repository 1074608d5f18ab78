"""Calibration boards: what their description means in metres, and in OpenCV's objects.

Board frame, as in OpenCV: origin at the outer corner of the top-left square (for an aprilgrid, of the
top-left tag), x to the right along the print, y down, z into the board. Points are numbered row by row:
the inner corners of ChArUco boards and chessboards, and the four corners of each tag of an aprilgrid
(clockwise from the top left).
"""

import re
from dataclasses import replace
from typing import Any

import numpy as np

from preface.capture.manifest import DICTIONARY_SIZES, Board
from preface.plain_words import suggestion

BOARD_TYPES = ("charuco", "chessboard", "aprilgrid")
_LARGEST_SQUARE = 1.0  # metres; who says 10 means millimetres


class BoardError(ValueError):
    """A board description that cannot be; the message says the field, the problem and the remedy."""


def parse_squares(text: str) -> tuple[int, int]:
    """(columns, rows) from ``9x6``; raises BoardError."""
    match = re.fullmatch(r"(\d{1,4})[xX](\d{1,4})", text.strip())
    if not match:
        raise BoardError(f"squares: '{text}' is not COLUMNSxROWS; write for example 9x6")
    return int(match[1]), int(match[2])


def describe_board(
    kind: str,
    squares: tuple[int, int],
    square_size: float,
    marker_size: float | None = None,
    dictionary: str | None = None,
    legacy: bool = False,
    inverted: bool = False,
) -> Board:
    """Build a board as OpenCV's users describe it.

    Args:
        kind: ``charuco``, ``chessboard`` or ``aprilgrid``.
        squares: (columns, rows) of squares; of **inner corners** for a chessboard; of tags for an aprilgrid.
            A manifest, and thus `Board`, counts the squares of a chessboard too: one more each way.
        square_size: edge of a square in metres; for an aprilgrid from one tag to the next, gap included.
        marker_size: edge of a marker in metres.
        dictionary: OpenCV's name, such as ``DICT_4X4_50``.
        legacy: a ChArUco board made with OpenCV before 4.6.
        inverted: printed white on black.

    Raises:
        BoardError: naming what is missing, superfluous or impossible.
    """
    if kind not in BOARD_TYPES:
        raise BoardError(f"board: '{kind}' is not a kind of board; {suggestion(kind, BOARD_TYPES)}")
    is_chessboard = kind == "chessboard"
    if is_chessboard:
        squares = (squares[0] + 1, squares[1] + 1)
    board = Board(kind, kind, squares, square_size, marker_size, dictionary, legacy or None, inverted or None)
    _check(board)
    return board


def _check(board: Board) -> None:
    smallest = 3 if board.type == "chessboard" else 2
    if min(board.squares) < smallest or max(board.squares) > 1000:
        raise BoardError(
            f"squares: {_counted(board)} cannot be a {board.type}; give COLUMNSxROWS of the print"
        )
    if not 0 < board.square_size <= _LARGEST_SQUARE:
        problem = f"square_size: {board.square_size} is not a length in metres from 0 to {_LARGEST_SQUARE:g}"
        raise BoardError(f"{problem}; 25 mm are 0.025")
    if board.type == "chessboard":
        for name in ("marker_size", "dictionary", "legacy", "inverted"):
            if getattr(board, name) is not None:
                raise BoardError(f"{name}: a chessboard has none; leave it out, or give the board as charuco")
        return
    if board.marker_size is None or board.dictionary is None:
        missing = "marker_size" if board.marker_size is None else "dictionary"
        raise BoardError(f"{missing}: is missing; a {board.type} needs marker_size and dictionary")
    if not 0 < board.marker_size < board.square_size:
        raise BoardError(
            f"marker_size: {board.marker_size} m is not between 0 and square_size, {board.square_size} m; "
            "measure both again, in metres"
        )
    if board.dictionary not in DICTIONARY_SIZES:
        raise BoardError(
            f"dictionary: '{board.dictionary}' is unknown; {suggestion(board.dictionary, DICTIONARY_SIZES)}"
        )
    capacity = DICTIONARY_SIZES[board.dictionary]
    if board.marker_count > capacity:
        raise BoardError(
            f"dictionary: {board.dictionary} holds {capacity} markers, but the board shows "
            f"{board.marker_count}; correct the dictionary or the squares"
        )


def board_in_words(board: Board) -> str:
    """Such as ``ChArUco board of 9x6 squares, DICT_4X4_50, inverted``; counted as `describe_board` does."""
    names = {"charuco": "ChArUco board of {} squares", "chessboard": "chessboard of {} inner corners"}
    words = [names.get(board.type, "aprilgrid of {} tags").format(_counted(board)), board.dictionary]
    return ", ".join(
        word for word in (*words, board.legacy and "legacy", board.inverted and "inverted") if word
    )


def _counted(board: Board) -> str:
    less = 1 if board.type == "chessboard" else 0
    return f"{board.squares[0] - less}x{board.squares[1] - less}"


def board_points(board: Board) -> np.ndarray:
    """The points [P, 3] of a board in metres, board frame, on a flat board."""
    if board.type == "aprilgrid":
        xy = marker_corners(board).reshape(-1, 2)
    else:
        x, y = (np.arange(1, count) * board.square_size for count in board.squares)
        xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)


def marker_corners(board: Board) -> np.ndarray:
    """Corners [markers, 4, 2] of the markers in metres, clockwise from the top left, in the order of ids."""
    assert board.marker_size is not None
    if board.type == "aprilgrid":
        row, column = np.divmod(np.arange(board.marker_count), board.squares[0])
        inset = 0.0
    else:
        row, column = _marker_squares(board)
        inset = (board.square_size - board.marker_size) / 2
    origin = np.stack([column, row], axis=-1) * board.square_size + inset
    return origin[:, None] + board.marker_size * np.array([(0, 0), (1, 0), (1, 1), (0, 1)])


def _marker_squares(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a ChArUco board's white squares, in the order of ids.

    The top-left square is black; but boards with an even number of rows began with a white one before
    OpenCV 4.6 (``legacy``).
    """
    columns, rows = board.squares
    row, column = np.divmod(np.arange(columns * rows), columns)
    first = 1 if board.legacy and rows % 2 == 0 else 0
    white = (row + column + first) % 2 == 1
    return row[white], column[white]


def marker_dictionary(name: str) -> Any:
    """OpenCV's dictionary of that name."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def with_squares(board: Board, columns: int, rows: int) -> Board:
    """The same board with another number of squares."""
    return replace(board, squares=(columns, rows))
