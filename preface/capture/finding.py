"""Finding a board in one image: which of its points are seen, and where.

The search works on a reduced grey image; corners are then refined in the full one (`subpixel.py`). ChArUco
corners are predicted from the two markers that touch them and not taken from cv2.aruco.CharucoDetector:
OpenCV's own corners carry half a pixel too much up to version 4.12, and walk to markers on steep boards.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from preface.capture.boards import board_points, marker_corners, marker_dictionary
from preface.capture.images import display_tones
from preface.capture.manifest import Board
from preface.capture.subpixel import Junction, Refined, Surroundings, refine
from preface.geometry.conventions import pixels_from_opencv
from preface.srgb import light_of_levels

SEARCH_SIDE = 2048  # pixels; markers are found faster, and large ones better, in a reduced image
CHESSBOARD_SIDE = 1280  # likewise for chessboards, which are searched for more slowly
DECIMALS = 5  # of a pixel; a thousandth of the noise, and short in the artefact
OUTLIER = 0.25  # of a square: more than lenses bend a board, less than any wrong assignment
CONSISTENT = 0.6  # of the markers must lie where one plane has them
NEIGHBOURS, NEIGHBOURHOOD = 3, 2.2  # markers that predict a corner, and their distance in squares
WHOLE = 0.8  # of a chessboard's corners must be sharp and lie on one plane; glare may hide the rest
# Pixels along a ChArUco marker of 4x4 bits from which boards are found; measured in the synthetic studio: in no frame
# where it has 7, in 4 of 10 where it has 9, in 8 of 10 where it has 11.5, in all that show the board where it has 14.
MARKER_PIXELS = 12
TAG_BITS = 8  # along an AprilTag of the 36h11 kind, its border of one bit included


@dataclass(frozen=True)
class Sighting:
    """What one image shows of a board.

    Attributes:
        points: [N] indices into `board_points`, ascending.
        pixels: [N, 2] COLMAP's: the centre of the top-left pixel is (0.5, 0.5).
        markers: how many of the board's markers were decoded.
        rejected: corners that were found and failed the refinement.
        mirrored: the board is there, but its markers decode only in the mirror; no points are given.
        contradictory: markers are there, but not where the description has them; no points are given.
    """

    points: np.ndarray = field(default_factory=lambda: np.empty(0, np.int32))
    pixels: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    markers: int = 0
    rejected: int = 0
    mirrored: bool = False
    contradictory: bool = False


@dataclass(frozen=True)
class Picture:
    """An image as the search and the refinement need it.

    Attributes:
        shown: uint8 [height, width], as encoded; inverted where the board is printed white on black.
        light: float32 [height, width], proportional to light; not finite where the image is not.
    """

    shown: np.ndarray
    light: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray, inverted: bool = False) -> "Picture":
        """From an image as `read_image` returns it: [height, width] or with channels, integers are sRGB."""
        grey = _grey(image)
        if np.issubdtype(grey.dtype, np.integer):
            light = light_of_levels(grey.dtype)[grey]
        else:
            light = grey.astype(np.float32)
        shown = display_tones(grey)
        return cls(255 - shown if inverted else shown, light)


def _grey(image: np.ndarray) -> np.ndarray:
    if image.ndim == 2 or image.shape[2] == 1:
        return image.reshape(image.shape[:2])
    if np.issubdtype(image.dtype, np.integer):
        return cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY)
    return image[..., :3].astype(np.float32).mean(axis=-1)


def find_board(board: Board, image: np.ndarray, search_side: int = SEARCH_SIDE) -> Sighting:
    """Find a board in an image.

    Args:
        board: its description.
        image: [height, width] or [height, width, channels], as `read_image` returns it.
        search_side: the search works on an image whose longer side is at most this many pixels.

    Returns:
        What is seen, partly seen boards included; a chessboard must be whole. Empty where nothing is.
    """
    picture = Picture.of(image, bool(board.inverted))
    if board.type == "chessboard":
        return _find_chessboard(board, picture, search_side)
    reduced, scale = _reduced(picture.shown, search_side)
    sighting = _find_markers(board, picture, reduced, scale)
    if len(sighting.points) or sighting.markers > 2:
        return sighting
    mirrored = _find_markers(board, None, np.ascontiguousarray(reduced[:, ::-1]), scale)
    if mirrored.markers > 2 and not mirrored.contradictory:
        return Sighting(markers=mirrored.markers, mirrored=True)
    return sighting


def _reduced(shown: np.ndarray, side: int) -> tuple[np.ndarray, float]:
    scale = min(1.0, side / max(shown.shape))
    if scale == 1:
        return shown, 1.0
    size = tuple(max(1, round(length * scale)) for length in shown.shape[::-1])
    return cv2.resize(shown, size, interpolation=cv2.INTER_AREA), scale


def _enlarged(pixels: np.ndarray, scale: float) -> np.ndarray:
    """Pixels with OpenCV's origin, from the reduced image to the full one."""
    return (pixels + 0.5) / scale - 0.5


# ---------------------------------------------------------------------------------------- markers


def detect_markers(dictionary: str, shown: np.ndarray, border_bits: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """The markers of a dictionary in a grey image: ids [N], corners [N, 4, 2] with OpenCV's origin."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    corners, ids, _ = cv2.aruco.ArucoDetector(marker_dictionary(dictionary), parameters).detectMarkers(shown)
    if ids is None:
        return np.empty(0, int), np.empty((0, 4, 2))
    return ids.ravel(), np.array(corners, np.float64).reshape(-1, 4, 2)


def _find_markers(board: Board, picture: Picture | None, shown: np.ndarray, scale: float) -> Sighting:
    """The board in an image with markers; without a picture, only whether it is there."""
    assert board.dictionary is not None
    border = 1
    ids, corners = detect_markers(board.dictionary, shown)
    if board.type == "aprilgrid" and len(ids) < 2:  # Kalibr prints a border of two bits
        border = 2
        ids, corners = detect_markers(board.dictionary, shown, border)
    ours = ids < board.marker_count
    ids, corners = ids[ours], _enlarged(corners[ours], scale)
    if len(ids) < 2:
        return Sighting(markers=len(ids))
    slots, inside = _placed(board, ids, corners)
    if inside.sum() < max(2, CONSISTENT * len(ids)):
        return Sighting(markers=len(ids), contradictory=len(ids) > 3)
    if picture is None:
        return Sighting(markers=len(ids))
    slots, corners = slots[inside], corners[inside]
    if board.type == "charuco":
        points, refined = _charuco_corners(board, picture, slots, corners)
    else:
        points, refined = _tag_corners(board, picture, slots, corners, border)
    return _sighting(points, refined, len(ids))


def fitting_markers(places: np.ndarray, corners: np.ndarray, square: float) -> np.ndarray:
    """Which markers [N] of K corners lie where one plane has them.

    Args:
        places: [N, K, 2] corners on the board, metres.
        corners: [N, K, 2] the same in the image, pixels.
        square: the board's square, metres.
    """
    homography, _ = cv2.findHomography(
        corners.reshape(-1, 2), places.reshape(-1, 2), cv2.RANSAC, OUTLIER * square, maxIters=500
    )
    if homography is None:
        return np.zeros(len(places), bool)
    mapped = cv2.perspectiveTransform(corners.reshape(1, -1, 2), homography).reshape(places.shape)
    return (np.linalg.norm(mapped - places, axis=-1) < OUTLIER * square).all(axis=1)


def _placed(board: Board, ids: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The place on the board [N] of every marker, and which of them agree on one plane [N].

    Aprilgrids are numbered from different corners: OpenCV's from the top left, Kalibr's from the bottom left
    of tags that OpenCV holds to be upside down. The numbering that fits is taken; tags in one line fit several.
    """
    places = marker_corners(board)
    if board.type == "charuco":
        return ids, fitting_markers(places[ids], corners, board.square_size)
    columns, rows = board.squares
    row, column = np.divmod(ids, columns)
    if np.linalg.matrix_rank(np.stack([row - row[0], column - column[0]])) < 2:
        return ids, np.zeros(len(ids), bool)
    options = [
        (rows - 1 - row if upwards else row) * columns + (columns - 1 - column if leftwards else column)
        for upwards in (False, True)
        for leftwards in (False, True)
    ]
    fits = [fitting_markers(places[slots], corners, board.square_size) for slots in options]
    best = max(range(4), key=lambda index: fits[index].sum())
    return options[best], fits[best]


def _charuco_corners(
    board: Board, picture: Picture, slots: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, Refined]:
    """The inner corners that a found marker touches: indices [N], and where.

    They are predicted from the nearest markers, of which there must be two: over a short way a lens is a plane's
    projection.
    """
    assert board.marker_size is not None
    square, inner = board.square_size, board_points(board)[:, :2]
    places = marker_corners(board)[slots]
    # The markers that touch a corner have their middles half a square's diagonal away.
    distance = np.linalg.norm(inner[:, None] - places.mean(axis=1), axis=-1)
    near = distance < NEIGHBOURHOOD * square
    points = np.flatnonzero((distance.min(axis=1) < 0.75 * square) & (near.sum(axis=1) >= 2))
    probes = np.array([(0, 0), (0.25, 0), (-0.25, 0), (0, 0.25), (0, -0.25)]) * square
    mapped = np.full((len(points), 5, 2), np.nan)
    for index, point in enumerate(points):
        by = np.argsort(distance[point])[: min(NEIGHBOURS, near[point].sum())]
        image_from_board, _ = cv2.findHomography(places[by].reshape(-1, 2), corners[by].reshape(-1, 2), 0)
        if image_from_board is not None:
            mapped[index] = cv2.perspectiveTransform((inner[point] + probes)[None], image_from_board)[0]
    usable = np.isfinite(mapped).all(axis=(1, 2))
    points, mapped = points[usable], mapped[usable]
    axes = 2 * np.stack([mapped[:, 1] - mapped[:, 2], mapped[:, 3] - mapped[:, 4]], axis=1)
    gap = (square - board.marker_size) / 2 / square
    # The markers that touch a corner lie on one diagonal; the nearest says on which.
    aside = places.mean(axis=1)[distance[points].argmin(axis=1)] - inner[points]
    return points, refine(
        picture.light, mapped[:, 0], axes, Surroundings(gap=gap, crowded=np.sign(aside.prod(axis=1)))
    )


def _tag_corners(
    board: Board, picture: Picture, slots: np.ndarray, corners: np.ndarray, border: int
) -> tuple[np.ndarray, Refined]:
    """The corners of the tags: indices [4 N], and where.

    Kalibr prints a black square into every gap between tags, so that four squares meet at a corner; OpenCV
    leaves the gap white. What explains the image better is taken.
    """
    assert board.marker_size is not None
    points = (4 * slots[:, None] + np.arange(4)).ravel()
    axes = np.stack([np.roll(corners, -1, axis=1), np.roll(corners, 1, axis=1)], axis=2) - corners[:, :, None]
    extent = min(0.45, 0.9 * (board.square_size - board.marker_size) / board.marker_size)
    gap = border / (TAG_BITS - 2 + 2 * border)  # the tag's own border, beyond which its bits begin
    fits = [
        refine(picture.light, corners.reshape(-1, 2), axes.reshape(-1, 2, 2), Surroundings(kind, extent, gap))
        for kind in Junction
    ]
    return points, max(fits, key=lambda fit: (fit.accepted.sum(), -np.median(fit.misfit)))


def _sighting(points: np.ndarray, refined: Refined, markers: int) -> Sighting:
    order = np.argsort(points)
    kept = order[refined.accepted[order]]
    pixels = np.asarray(pixels_from_opencv(refined.pixels[kept])).round(DECIMALS)
    return Sighting(points[kept].astype(np.int32), pixels, markers, int((~refined.accepted).sum()))


# ------------------------------------------------------------------------------------- chessboards


def _find_chessboard(board: Board, picture: Picture, search_side: int) -> Sighting:
    size = (board.squares[0] - 1, board.squares[1] - 1)
    reduced, scale = _reduced(picture.shown, min(search_side, CHESSBOARD_SIDE))
    # The older search is five times faster, and on real boards it finds what the newer one does.
    found, pixels = cv2.findChessboardCorners(
        reduced, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not found:
        found, pixels = cv2.findChessboardCornersSB(reduced, size)
    if not found:
        return Sighting()
    corners = np.asarray(pixels, np.float64).reshape(size[1], size[0], 2)
    grid = _oriented(_enlarged(corners, scale), picture.shown)
    axes = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=2)
    refined = refine(picture.light, grid.reshape(-1, 2), axes.reshape(-1, 2, 2), Surroundings())
    flat = board_points(board)[:, :2].reshape(-1, 1, 2)
    on_plane = fitting_markers(flat, refined.pixels[:, None], board.square_size)
    if min(on_plane.mean(), refined.accepted.mean()) < WHOLE:
        return Sighting()  # other patterns, such as ChArUco's, are taken for a chessboard now and then
    return _sighting(np.arange(size[0] * size[1]), refined, 0)


def looks_the_same_upside_down(board: Board) -> bool:
    """Whether nobody can tell which end of a chessboard is up: the squares in its far corners are alike."""
    return board.type == "chessboard" and sum(board.squares) % 2 == 0


def _oriented(corners: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Count the corners [rows, columns, 2] of a chessboard from the same end in every image.

    The outer square at the first corner is black; where both ends have that, or neither, the first row is
    the upper one in the image.
    """
    right, down = corners[0, 1] - corners[0, 0], corners[1, 0] - corners[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        corners = corners[:, ::-1]
    rows, columns = corners.shape[:2]
    if (rows + columns) % 2 == 1:
        if _first_contrast(corners, shown) < 0:
            return corners[::-1, ::-1]
    elif corners[0, :, 1].mean() > corners[-1, :, 1].mean():
        return corners[::-1, ::-1]
    return corners


def _first_contrast(corners: np.ndarray, shown: np.ndarray) -> float:
    """Brightness of the squares beside the black ones minus that of the black ones, over the inner squares."""
    middles = (corners[:-1, :-1] + corners[1:, 1:] + corners[1:, :-1] + corners[:-1, 1:]) / 4
    column, row = np.moveaxis(np.rint(middles).astype(int), -1, 0)
    limit = shown.shape
    values = shown[np.clip(row, 0, limit[0] - 1), np.clip(column, 0, limit[1] - 1)].astype(np.float64)
    rows, columns = np.indices(values.shape)
    # The outer square at the first corner is black, and with it the first inner one, diagonally opposite.
    black = (rows + columns) % 2 == 0
    return float(values[~black].mean() - values[black].mean())
