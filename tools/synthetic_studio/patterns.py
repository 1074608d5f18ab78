"""The calibration boards as exact geometry: where their edges, colours and corners are, without any pixels.

Board frame, as in OpenCV: origin at the outer corner of the top-left square, x along the top, y down the
side, z into the board, away from the viewer. Metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from synthetic_studio.config import BoardConfig

# Bits along a marker of the 4x4 dictionaries, its black border included.
MARKER_CELLS = 6
# Dictionaries of 4x4 markers by capacity; a board takes the smallest that is large enough.
DICTIONARIES = {50: "DICT_4X4_50", 100: "DICT_4X4_100", 250: "DICT_4X4_250", 1000: "DICT_4X4_1000"}
# White paper around the pattern, in squares.
MARGIN = 0.4

NOTHING, PAPER, INK = 0, 1, 2


@dataclass(frozen=True)
class BoardPattern:
    """A ChArUco board or a chessboard, in metres.

    bow is the height (across, down) of mrcal's calobject_warp: the surface is
    z = bow[0] (1 - u^2) + bow[1] (1 - v^2), with u and v running from -1 to 1 between the outermost inner
    corners; x and y stay those of the flat board.
    """

    kind: str
    squares: tuple[int, int]
    square: float
    marker: float
    bow: tuple[float, float]

    @classmethod
    def from_config(cls, config: BoardConfig) -> BoardPattern:
        """The board that the configuration describes."""
        square = config.square_mm / 1000
        # A whole number of 10 um, so that the side can be written down and typed in exactly.
        marker = round(square * config.marker_ratio, 5) if config.kind == "charuco" else 0.0
        bow = (config.bow_mm[0] / 1000, config.bow_mm[1] / 1000)
        return cls(config.kind, config.squares, square, marker, bow)

    @property
    def dictionary(self) -> str:
        """Name of OpenCV's marker dictionary; for ChArUco boards."""
        needed = self.squares[0] * self.squares[1] // 2
        return next(name for capacity, name in DICTIONARIES.items() if capacity >= needed)

    @property
    def extent(self) -> np.ndarray:
        """Width and height [2] of the pattern without its margin."""
        return np.array(self.squares) * self.square

    @property
    def margin(self) -> float:
        """Width of the paper around the pattern."""
        return MARGIN * self.square

    @cached_property
    def corners(self) -> np.ndarray:
        """Inner corners [N, 3] in OpenCV's order, row by row, on the bowed surface."""
        x, y = (np.arange(1, n) * self.square for n in self.squares)
        flat = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return np.concatenate([flat, self.height(flat)[:, None]], axis=1)

    @cached_property
    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """All x and all y, ascending, at which a colour may change: paper, squares and marker bits."""
        return self._axis_edges(self.squares[0]), self._axis_edges(self.squares[1])

    @cached_property
    def cells(self) -> np.ndarray:
        """NOTHING, PAPER or INK [len(y edges) + 1, len(x edges) + 1] between those edges and beyond."""
        x_edges, y_edges = self.edges
        x, y = np.meshgrid(_midpoints(x_edges), _midpoints(y_edges))
        cells = np.where(self._ink(x[1:-1, 1:-1], y[1:-1, 1:-1]), INK, PAPER)
        return np.pad(cells, 1, constant_values=NOTHING).astype(np.uint8)

    def height(self, xy: np.ndarray) -> np.ndarray:
        """z [...] of the surface over flat positions xy [..., 2]."""
        warped = self._normalised(xy)
        return (np.array(self.bow) * (1 - warped**2)).sum(axis=-1)

    def slope(self, xy: np.ndarray) -> np.ndarray:
        """Gradient [..., 2] of `height`."""
        return -2 * np.array(self.bow) * self._normalised(xy) / self._half_span

    @property
    def _half_span(self) -> np.ndarray:
        return (self.extent - 2 * self.square) / 2

    def _normalised(self, xy: np.ndarray) -> np.ndarray:
        return (xy - self.extent / 2) / self._half_span

    def _axis_edges(self, squares: int) -> np.ndarray:
        lines = np.arange(squares + 1) * self.square
        paper = np.array([-self.margin, squares * self.square + self.margin])
        inset = (self.square - self.marker) / 2
        bits = inset + np.arange(MARKER_CELLS + 1) * self.marker / MARKER_CELLS
        markers = (lines[:-1, None] + bits).ravel() if self.kind == "charuco" else np.empty(0)
        return np.unique(np.concatenate([lines, paper, markers]))

    def _ink(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        column, row = (np.floor(axis / self.square).astype(int) for axis in (x, y))
        on_squares = (column >= 0) & (column < self.squares[0]) & (row >= 0) & (row < self.squares[1])
        black = (column + row) % 2 == 0
        if self.kind == "charuco":
            black = np.where(black, True, self._marker_ink(x, y, column, row))
        return on_squares & black

    def _marker_ink(self, x: np.ndarray, y: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Ink of the markers in the white squares, numbered row by row as OpenCV 4.6 and later do."""
        inset = (self.square - self.marker) / 2
        bit_x, bit_y = (
            np.floor((axis - index * self.square - inset) / (self.marker / MARKER_CELLS)).astype(int)
            for axis, index in ((x, column), (y, row))
        )
        inside = (bit_x >= 0) & (bit_x < MARKER_CELLS) & (bit_y >= 0) & (bit_y < MARKER_CELLS)
        across = self.squares[0]
        # White squares before this one: those of the rows above and those to the left.
        identity = (row * across) // 2 + np.where(row % 2 == 0, column // 2, (column + 1) // 2)
        markers = self._marker_bits
        safe = np.clip(identity, 0, len(markers) - 1)
        last = MARKER_CELLS - 1
        return inside & markers[safe, np.clip(bit_y, 0, last), np.clip(bit_x, 0, last)]

    @cached_property
    def _marker_bits(self) -> np.ndarray:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        count = self.squares[0] * self.squares[1] // 2
        images = [cv2.aruco.generateImageMarker(dictionary, i, MARKER_CELLS) for i in range(count)]
        return np.array(images) == 0


def _midpoints(edges: np.ndarray) -> np.ndarray:
    """One position in every interval between edges and one beyond either end."""
    return np.concatenate([[edges[0] - 1], (edges[1:] + edges[:-1]) / 2, [edges[-1] + 1]])
