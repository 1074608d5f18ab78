"""Photographs of a calibration board: exact geometry through the true lens, area-filtered, plainly lit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid
from synthetic_studio.patterns import INK, PAPER, BoardPattern

# Linear reflectance and light. Paper stays below full scale except where it shines.
PAPER_COLOUR = np.array([0.80, 0.79, 0.76], np.float32)
INK_COLOUR = np.array([0.028, 0.028, 0.030], np.float32)
BACK_COLOUR = np.array([0.035, 0.033, 0.030], np.float32)
STUDIO_DARK = np.float32(0.004)
AMBIENT, KEY = 0.55, 0.50
KEY_DIRECTION = np.array([0.35, 0.55, 0.76]) / np.linalg.norm([0.35, 0.55, 0.76])
GLOSS, SHININESS = 0.06, 40.0

# Sub-pixel positions [16, 2]: a centred rank-1 lattice, which resolves an edge of any direction to 1/16 pixel
# or better where a 4 x 4 grid has 4 levels for upright edges. It is symmetric about the pixel's centre.
_STEPS = np.arange(16)
LATTICE = (np.stack([_STEPS, (5 * _STEPS + 2) % 16], axis=1) + 0.5) / 16
# Pixels and rows worked on at a time, to bound the scratch memory at 25 megapixels.
CHUNK = 1 << 16
# Newton steps to a bowed surface: the bow is a few per cent of the board, so each gains many digits.
NEWTON_STEPS = 4


@dataclass(frozen=True)
class BoardCamera:
    """A camera prepared for many frames of boards: the rays of its pixel corners are computed once."""

    camera: Camera

    @cached_property
    def corner_rays(self) -> np.ndarray:
        """Normalised coordinates [H + 1, W + 1, 2] of the rays through the pixels' corners."""
        width, height = self.camera.width, self.camera.height
        columns = np.arange(width + 1.0)
        rays = np.empty((height + 1, width + 1, 2))
        rows = max(1, CHUNK // (width + 1))
        for top in range(0, height + 1, rows):
            lines = np.arange(top, min(top + rows, height + 1), dtype=float)
            pixels = np.stack(np.meshgrid(columns, lines), axis=-1)
            rays[top : top + len(lines)], valid = self.camera.unproject(pixels)
            if not valid.all():
                raise ValueError("the lens folds inside the image")
        return rays


def render_board(
    pattern: BoardPattern, camera_from_board: Rigid, key: np.ndarray, view: BoardCamera
) -> np.ndarray:
    """Linear light [H, W, 3] float32 of a board in the dark studio.

    Args:
        pattern: the board.
        camera_from_board: its pose in the camera's frame.
        key: unit direction [3] towards the key light, in the board's frame.
        view: the camera.

    Pixels are box-filtered. The ray through a pixel's corner is exact; between the four corners, positions on
    the board are interpolated linearly, which is off by less than 1e-3 pixel at 60 degrees of tilt.
    """
    height, width = view.camera.height, view.camera.width
    image = np.full((height, width, 3), STUDIO_DARK, np.float32)
    left, top, right, bottom = _bounding_box(pattern, camera_from_board, view.camera)
    if left >= right or top >= bottom:
        return image
    rays = view.corner_rays[top : bottom + 1, left : right + 1]
    rows = max(1, 4 * CHUNK // (right - left))
    for start in range(0, bottom - top, rows):
        band = rays[start : start + rows + 1]
        lit = _render_band(pattern, camera_from_board, key, band)
        image[top + start : top + start + len(lit), left:right] = lit
    return image


def _render_band(
    pattern: BoardPattern, camera_from_board: Rigid, key: np.ndarray, rays: np.ndarray
) -> np.ndarray:
    """Linear light [h, w, 3] of the pixels between corner rays [h + 1, w + 1, 2]."""
    board_from_camera = camera_from_board.inverse
    eye = board_from_camera.translation
    directions = rays @ board_from_camera.rotation[:, :2].T + board_from_camera.rotation[:, 2]
    xy, hit = _intersect(pattern, eye, directions)
    paper, ink = _coverage(pattern, xy, hit)
    middle = (xy[1:, 1:] + xy[:-1, :-1]) / 2
    diffuse, gloss = _light(pattern, middle, eye, key)
    covered = (paper + ink)[..., None]
    if eye[2] > 0:
        surface = covered * diffuse[..., None] * BACK_COLOUR
    else:
        albedo = paper[..., None] * PAPER_COLOUR + ink[..., None] * INK_COLOUR
        surface = albedo * diffuse[..., None] + covered * gloss[..., None]
    return surface + (1 - covered) * STUDIO_DARK


def _bounding_box(
    pattern: BoardPattern, camera_from_board: Rigid, camera: Camera
) -> tuple[int, int, int, int]:
    """Left, top, right, bottom in whole pixels of all that the paper can cover; the image if unsure."""
    steps = np.linspace(0, 1, 33)
    low, high = -pattern.margin, pattern.extent + pattern.margin
    x, y = (low + steps * (end - low) for end in high)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    surface = np.concatenate([grid, pattern.height(grid)[:, None]], axis=1)
    pixels, valid = camera.project(camera_from_board.apply(surface))
    if not valid.all():
        return 0, 0, camera.width, camera.height
    # The outline between two samples bends less than a pixel per thousand of its length.
    slack = 2 + 1e-3 * camera.height
    first = np.floor(pixels.min(axis=0) - slack).clip(0, None).astype(int)
    last = np.ceil(pixels.max(axis=0) + slack).clip(None, (camera.width, camera.height)).astype(int)
    return int(first[0]), int(first[1]), int(last[0]), int(last[1])


def _intersect(
    pattern: BoardPattern, eye: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Flat positions [..., 2] where rays meet the board, and whether they do, in front of the eye [...]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -eye[2] / directions[..., 2]
        for _ in range(NEWTON_STEPS if any(pattern.bow) else 0):
            xy = eye[:2] + distance[..., None] * directions[..., :2]
            miss = eye[2] + distance * directions[..., 2] - pattern.height(xy)
            rate = directions[..., 2] - (pattern.slope(xy) * directions[..., :2]).sum(axis=-1)
            distance = distance - miss / rate
        xy = eye[:2] + distance[..., None] * directions[..., :2]
    hit = np.isfinite(xy).all(axis=-1) & (distance > 0)
    far = pattern.extent + 1.0
    return np.where(hit[..., None], xy, far), hit


def _coverage(pattern: BoardPattern, xy: np.ndarray, hit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fractions [h, w] float32 of paper and ink in each pixel, from its corners' positions [h+1, w+1, 2]."""
    column, row = _cell_indices(pattern, xy[..., 0], xy[..., 1])
    columns, rows = _corner_range(column), _corner_range(row)
    area = (columns[1] - columns[0] + 1) * (rows[1] - rows[0] + 1)
    # A pixel's corners lie in a rectangle of cells; if all of these have one colour, so has the pixel.
    paper_cells = _count_in_rectangles(pattern.cells == PAPER, columns, rows)
    ink_cells = _count_in_rectangles(pattern.cells == INK, columns, rows)
    paper, ink = (paper_cells == area).astype(np.float32), (ink_cells == area).astype(np.float32)
    uniform = (paper_cells == area) | (ink_cells == area) | (paper_cells + ink_cells == 0)
    mixed = np.nonzero(~uniform)
    for start in range(0, len(mixed[0]), CHUNK):
        some = tuple(index[start : start + CHUNK] for index in mixed)
        paper[some], ink[some] = _sampled_coverage(pattern, xy, some)
    partly_seen = ~_corner_range(hit)[0]
    paper[partly_seen], ink[partly_seen] = 0, 0
    return paper, ink


def _sampled_coverage(
    pattern: BoardPattern, xy: np.ndarray, pixels: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, np.ndarray]:
    i, j = pixels
    across, down = LATTICE[:, :1], LATTICE[:, 1:]
    weights = np.hstack([(1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down])
    corners = np.stack([xy[i, j], xy[i, j + 1], xy[i + 1, j], xy[i + 1, j + 1]])
    column, row = _cell_indices(pattern, weights @ corners[..., 0], weights @ corners[..., 1])
    kinds = pattern.cells[row, column]
    return (kinds == PAPER).mean(axis=0, dtype=np.float32), (kinds == INK).mean(axis=0, dtype=np.float32)


def _cell_indices(pattern: BoardPattern, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.searchsorted(pattern.edges[0], x), np.searchsorted(pattern.edges[1], y)


def _corner_range(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest [h, w] of the four corner values of every pixel, from [h + 1, w + 1]."""
    upper, lower = corners[:-1], corners[1:]
    small, large = np.minimum(upper, lower), np.maximum(upper, lower)
    return np.minimum(small[:, :-1], small[:, 1:]), np.maximum(large[:, :-1], large[:, 1:])


def _count_in_rectangles(
    cells: np.ndarray, columns: tuple[np.ndarray, np.ndarray], rows: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """How many cells are set in each rectangle of cells, both ends included (summed-area table)."""
    table = np.pad(cells.astype(int).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    left, right, top, bottom = columns[0], columns[1] + 1, rows[0], rows[1] + 1
    return table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]


def _light(
    pattern: BoardPattern, xy: np.ndarray, eye: np.ndarray, key: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Diffuse factor and gloss [h, w] float32 of the surface at flat positions [h, w, 2] (Blinn-Phong)."""
    xy = xy.astype(np.float32)
    slope = pattern.slope(xy).astype(np.float32)
    # The viewer's side of the surface: of negative z before the board, of positive z behind it.
    side = np.float32(1 if eye[2] <= 0 else -1)
    normal = _unit(side * slope[..., 0], side * slope[..., 1], np.broadcast_to(-side, slope.shape[:2]))
    light = key.astype(np.float32)
    far = eye.astype(np.float32)
    to_eye = _unit(far[0] - xy[..., 0], far[1] - xy[..., 1], far[2] - pattern.height(xy).astype(np.float32))
    half = _unit(*(towards + one for towards, one in zip(to_eye, light, strict=True)))
    diffuse = AMBIENT + KEY * np.maximum(_dot(normal, light), 0)
    gloss = GLOSS * np.maximum(_dot(normal, half), 0) ** SHININESS
    return diffuse, gloss


def _unit(*vector: np.ndarray) -> tuple[np.ndarray, ...]:
    """Unit vectors, component by component: several times faster than with a last axis of three."""
    length = np.sqrt(_dot(vector, vector))
    return tuple(component / length for component in vector)


def _dot(one: Iterable[np.ndarray], other: Iterable[np.ndarray]) -> np.ndarray:
    x, y, z = (a * b for a, b in zip(one, other, strict=True))
    return x + y + z
