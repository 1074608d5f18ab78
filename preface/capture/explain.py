"""Why a board was not found: what the images show instead of what was described."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from preface.capture.boards import board_in_words, marker_corners, marker_dictionary, with_squares
from preface.capture.finding import MARKER_PIXELS, Picture, fitting_markers
from preface.capture.manifest import DICTIONARY_SIZES, Board

EXPLAIN_SIDE = 1280  # pixels; for an explanation, large markers will do
FEW = 4  # markers; fewer are found by chance in any picture
SMALLEST_CHESSBOARD = 12  # inner corners; 3x3 of them are found in noise
# The largest of each kind: the smaller ones are their beginnings.
_FAMILIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL",
             "DICT_ARUCO_MIP_36h12", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10",
             "DICT_APRILTAG_36h11")  # fmt: skip


_Markers = tuple[np.ndarray, np.ndarray]  # ids [N], corners [N, 4, 2]


def explain(board: Board, images: Sequence[np.ndarray]) -> str:
    """Say what images show instead of a board.

    Args:
        board: what was expected.
        images: a few images, as `read_image` returns them, in which it was not found.

    Returns:
        A clause such as ``found markers of 5x4 squares, expected 9x6``.
    """
    shown = [_small(Picture.of(image).shown) for image in images]
    return (
        _other_markers(board, shown)
        or _other_chessboard(board, shown)
        or f"nothing like a board is seen (expected a {board_in_words(board)}){_too_small(board)}"
    )


def _too_small(board: Board) -> str:
    """What else it may be: how many pixels a marker of a board has that is not found, nobody knows."""
    if board.type == "chessboard":
        return ""
    return f", or the images are too small: a marker needs some {MARKER_PIXELS} pixels along its side"


def _small(shown: np.ndarray) -> np.ndarray:
    scale = min(1.0, EXPLAIN_SIDE / max(shown.shape))
    return shown if scale == 1 else cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


# ---------------------------------------------------------------------------------------- markers


def _other_markers(board: Board, shown: Sequence[np.ndarray]) -> str | None:
    best: tuple[int, str, bool, bool] = (0, "", False, False)
    found: list[_Markers] = []
    families = sorted(_FAMILIES, key=lambda name: not _same_family(name, board.dictionary))
    # What was described comes first: the earliest of equals wins.
    for inverted in (bool(board.inverted), not board.inverted):
        for mirrored in (False, True):
            images = [_markers(families, image, inverted, mirrored) for image in shown]
            for family in families:
                seen = [image[family] for image in images]
                count = sum(len(ids) for ids, _ in seen)
                if count > best[0]:
                    best, found = (count, family, inverted, mirrored), seen
    count, dictionary, inverted, mirrored = best
    if count < FEW * max(1, len(shown) // 2):
        return None
    if board.type == "chessboard":
        return f"found markers of {dictionary}, expected a chessboard; give the board as charuco or aprilgrid"
    if mirrored:
        return "the markers decode only in the mirror: the footage is mirrored"
    if not _same_family(dictionary, board.dictionary):
        highest = max(int(ids.max()) for ids, _ in found if len(ids))
        return f"found markers of {_smallest(dictionary, highest)}, expected {board.dictionary}"
    if inverted != bool(board.inverted):
        kinds = ("black on white", "white on black")
        return f"found markers printed {kinds[inverted]}, expected {kinds[not inverted]} (the board's 'inverted')"
    return _other_squares(board, found)


def _markers(
    families: Sequence[str], shown: np.ndarray, inverted: bool, mirrored: bool
) -> dict[str, _Markers]:
    """The markers of each family in one image, all searched for at once."""
    image = 255 - shown if inverted else shown
    detector = cv2.aruco.ArucoDetector([marker_dictionary(name) for name in families])
    corners, ids, _, which = detector.detectMarkersMultiDict(
        np.ascontiguousarray(image[:, ::-1]) if mirrored else image
    )
    if ids is None:
        return dict.fromkeys(families, (np.empty(0, int), np.empty((0, 4, 2))))
    places, ids, which = np.array(corners, np.float64).reshape(-1, 4, 2), ids.ravel(), which.ravel()
    return {name: (ids[which == index], places[which == index]) for index, name in enumerate(families)}


def _same_family(name: str, other: str | None) -> bool:
    return other is not None and (name == other or (name[:8] == other[:8] and name[5].isdigit()))


def _smallest(family: str, highest: int) -> str:
    names = [n for n, size in DICTIONARY_SIZES.items() if _same_family(n, family) and size > highest]
    return min(names, key=lambda name: DICTIONARY_SIZES[name])


def _other_squares(board: Board, found: Sequence[_Markers]) -> str | None:
    """The size of the board that the markers' ids and places tell of."""
    images = [(ids, corners) for ids, corners in found if len(ids) >= FEW]
    if not images:
        return None
    highest = max(int(ids.max()) for ids, _ in images)
    total = sum(len(ids) for ids, _ in images)
    best, best_fit = board, 0
    for candidate in _boards_up_to(board, highest):
        fit = _fit(candidate, images)
        if fit > 1.2 * best_fit:  # the earliest of equals wins
            best, best_fit = candidate, fit
        if best_fit > 0.9 * total:
            break
    if best_fit < 0.6 * total:
        return f"found markers of {board.dictionary}, but not in the order of a {board.type} board"
    if best.squares == board.squares and bool(best.legacy) != bool(board.legacy):
        return f"found a {'legacy' if best.legacy else 'current'} pattern, expected the other (the board's 'legacy')"
    if best.squares == board.squares:
        return None
    kind = "tags" if board.type == "aprilgrid" else "squares"
    return (
        f"found markers of {best.squares[0]}x{best.squares[1]} {kind}, "
        f"expected {board.squares[0]}x{board.squares[1]}"
    )


def _boards_up_to(board: Board, highest: int) -> Iterator[Board]:
    """The described board in either pattern, then boards just large enough for an id, its kin first."""
    if board.type == "charuco":
        # A board of one row more may fit as well: the pattern's other kind is the smaller mistake.
        yield from (board, replace(board, legacy=not board.legacy))
    widths = sorted(range(2, 41), key=lambda columns: abs(columns - board.squares[0]))
    for legacy in (board.legacy, not board.legacy) if board.type == "charuco" else (board.legacy,):
        for columns in widths:
            per_row = columns / 2 if board.type == "charuco" else columns
            rows = max(2, int(np.ceil((highest + 1) / per_row)))
            # Legacy boards differ where the number of rows is even, which the ids alone do not tell.
            for more in (0, 1):
                yield replace(with_squares(board, columns, rows + more), legacy=legacy)


def _fit(board: Board, images: Sequence[_Markers]) -> int:
    """How many markers lie where a board has them."""
    places = marker_corners(board)
    if any(ids.max() >= len(places) for ids, _ in images):
        return 0
    cv2.setRNGSeed(0)
    return sum(int(fitting_markers(places[ids], corners, board.square_size).sum()) for ids, corners in images)


# ------------------------------------------------------------------------------------- chessboards


def _other_chessboard(board: Board, shown: Sequence[np.ndarray]) -> str | None:
    """The largest chessboard in an image."""
    expected = (board.squares[0] - 1, board.squares[1] - 1)
    for image in shown:
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        found, _, cells = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
        if not found or cells is None:
            continue
        size = (cells.shape[1], cells.shape[0])
        if cells.size < SMALLEST_CHESSBOARD:
            continue
        if board.type != "chessboard":
            return f"found a chessboard of {size[0]}x{size[1]} inner corners without readable markers"
        if sorted(size) != sorted(expected):
            wide = size if (size[0] >= size[1]) == (expected[0] >= expected[1]) else size[::-1]
            return (
                f"found a {wide[0]}x{wide[1]} inner-corner chessboard, expected {expected[0]}x{expected[1]}"
            )
    return None
