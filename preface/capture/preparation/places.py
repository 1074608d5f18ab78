"""Where the pixels of a pinhole image lie in a distorted photograph, for whole images at a time.

The exact formula of `preface.geometry.lens` in float64 for six million pixels takes longer than resampling them.
Over one image it is a smooth function of two variables, hence its Chebyshev interpolant at a few nodes per axis
is as good, and is two small matrix products. Eight nodes are exact for all polynomial lenses (their highest
power is r^7); rational ones take more, and one with a pole inside the image is evaluated as it is.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev

from preface.geometry import Camera, lens

# Source pixels: what an interpolant may be off, next to OpenCV's remap, which rounds places to 1/32 of a pixel.
_EXACT = 1e-4
_NODES = (8, 16, 32)
_CHECKS = 41  # per axis, where the interpolant is held against the formula


class Places:
    """The places of a pinhole camera's pixels in the photographs of a camera with the same axes.

    Attributes:
        nodes: per axis, of the interpolant; 0 where the formula itself is evaluated.
        covered: whether all of the pinhole's image is in the photograph and before the lens folds.
    """

    def __init__(self, source: Camera, pinhole: Camera):
        """Find the interpolant for the photograph's camera and the pinhole's (without distortion)."""
        self._source, self._pinhole = source, pinhole
        self._across = np.arange(pinhole.width) + 0.5
        self.nodes, self._columns = self._interpolant()
        self.covered = self._all_covered()

    def rows(self, low: int, high: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """The places of the pixels of rows low to high.

        Returns:
            x and y, float32 [high - low, width], in pixels of the photograph, whose top-left pixel has its
            centre at (0.5, 0.5); and valid, bool of that shape, or None where all are. Places that are not
            valid, past the border or the fold, are the image's corner (0, 0).
        """
        down = np.arange(low, high) + 0.5
        if self.nodes:
            basis = _basis(down, self._pinhole.height, self.nodes).astype(np.float32)
            straight_x, straight_y = self._straight(self._across, down)
            x, y = basis @ self._columns[0], basis @ self._columns[1]
            x += straight_x.astype(np.float32)
            y += straight_y.astype(np.float32)[:, None]
        else:
            x, y = (place.astype(np.float32) for place in self._exact(self._across, down))
        if self.covered:
            return x, y, None
        valid = self._valid(self._across, down, x, y)
        return np.where(valid, x, np.float32(0)), np.where(valid, y, np.float32(0)), valid

    def _interpolant(self) -> tuple[int, np.ndarray]:
        """Nodes per axis, and float32 [2, nodes, width]: the interpolant's coefficients at every column."""
        width, height = self._pinhole.width, self._pinhole.height
        checks = (np.arange(_CHECKS) + 0.5) / _CHECKS
        wanted = self._displacements(checks * width, checks * height)
        for nodes in _NODES:
            places = (chebyshev.chebpts1(nodes) + 1) / 2
            inverse = np.linalg.inv(chebyshev.chebvander(2 * places - 1, nodes - 1))
            coefficients = inverse @ self._displacements(places * width, places * height) @ inverse.T
            found = (
                _basis(checks * height, height, nodes) @ coefficients @ _basis(checks * width, width, nodes).T
            )
            if np.abs(found - wanted).max() <= _EXACT:  # not where either is no number, as at a pole
                return nodes, (coefficients @ _basis(self._across, width, nodes).T).astype(np.float32)
        return 0, np.empty((2, 0, 0), np.float32)

    def _normalised(self, across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        fx, fy, cx, cy = self._pinhole.intrinsics[:4]
        return (across - cx) / fx, (down - cy) / fy

    def _straight(self, across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where columns and rows would be without distortion."""
        x, y = self._normalised(across, down)
        fx, fy, cx, cy = self._source.intrinsics[:4]
        return fx * x + cx, fy * y + cy

    @lens.quietly
    def _exact(self, across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The places of columns and rows by the formula, float64 [rows, columns] each, past folds as well."""
        x, y = self._normalised(across, down)
        bent = lens.distort(self._source.intrinsics, x[None, :], y[:, None])
        fx, fy, cx, cy = self._source.intrinsics[:4]
        return fx * bent.x + cx, fy * bent.y + cy

    def _displacements(self, across: np.ndarray, down: np.ndarray) -> np.ndarray:
        """By how far the lens moves columns and rows, [2, rows, columns], source pixels."""
        x, y = self._exact(across, down)
        straight_x, straight_y = self._straight(across, down)
        return np.stack([x - straight_x, y - straight_y[:, None]])

    def _valid(self, across: np.ndarray, down: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        column, row = self._normalised(across, down)
        unfolded = column**2 + row[:, None] ** 2 < self._source.monotonic_radius**2
        inside = (x >= 0) & (x <= self._source.width) & (y >= 0) & (y <= self._source.height)
        return unfolded & inside

    def _all_covered(self) -> bool:
        """Whether the outline is: the lens is one-to-one before its fold, and leaves no holes."""
        down = np.arange(self._pinhole.height) + 0.5
        for across, rows in ((self._across, down[[0, -1]]), (self._across[[0, -1]], down)):
            if not self._valid(across, rows, *self._exact(across, rows)).all():
                return False
        return True


def _basis(place: np.ndarray, side: int, nodes: int) -> np.ndarray:
    """Chebyshev polynomials at places in [0, side], [n, nodes]."""
    return chebyshev.chebvander(2 * place / side - 1, nodes - 1)
