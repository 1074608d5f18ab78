"""How renders are shown, wherever they are: errors, depths and normals as colours with legends, the size of tiles."""

from __future__ import annotations

import numpy as np

from preface.reports.pictures import LegendEntry, Picture, as_picture, colorize, gradient

_DEPTHS, _ERRORS = "viridis", "inferno"  # matplotlib's names of their colours
ERROR_SHOWN = 0.25  # the mean absolute error, of 1, at the bright end of the error map
BAR_WIDTH, BAR_HEIGHT, BALL = 160, 16, 56  # pixels of what a legend shows of colours
SMALLEST = 200  # pixels of a tile's height; smaller images are enlarged by repeating pixels


def error_picture(rgb: np.ndarray, truth: np.ndarray) -> Picture:
    """The mean over channels of the absolute difference of two images [H, W, 3], from none to `ERROR_SHOWN`."""
    return colorize(np.abs(rgb - truth).mean(axis=-1), 0, ERROR_SHOWN, _ERRORS)


def depth_picture(depth: np.ndarray, near: float, far: float) -> Picture:
    """Depths [H, W] from dark (near, or less) to bright (far, or more), a grey checker board where there is none."""
    return colorize(depth, near, far, _DEPTHS)


def normals_picture(normals: np.ndarray) -> Picture:
    """Normals [H, W, 3] as colours, black where there is none.

    Red grows along x of their frame, green along y, blue along z; the canonical frame's are to the subject's left, up
    and out of the face.
    """
    return as_picture(np.where(np.isnan(normals), 0.0, (normals + 1) / 2).astype(np.float32))


def depth_entry(near: str, far: str) -> LegendEntry:
    """For a legend: the colours of `depth_picture` between the words for both ends."""
    return f"depth: {near}", gradient(_DEPTHS, BAR_WIDTH, BAR_HEIGHT), f"{far}; checker board: nothing there"


def error_entry() -> LegendEntry:
    """For a legend: the colours of `error_picture`."""
    return "error: 0", gradient(_ERRORS, BAR_WIDTH, BAR_HEIGHT), f"{ERROR_SHOWN} of full scale and more"


def normals_entry() -> LegendEntry:
    """For a legend: the colours of `normals_picture` on a ball that is seen from in front of the face."""
    x, y = np.meshgrid(np.linspace(-1, 1, BALL), np.linspace(1, -1, BALL))
    z = np.sqrt(np.where(np.hypot(x, y) <= 1, np.maximum(1 - x**2 - y**2, 0), np.nan))
    ball = np.where(np.isnan(z)[..., None], np.nan, np.stack([x, y, z], axis=-1))
    words = "red: to the subject's left, green: up, blue: out of the face (a ball seen from in front of it)"
    return "normals:", normals_picture(ball), words


def tile_size(width: int, height: int, smallest: int = SMALLEST) -> tuple[int, int]:
    """Width and height of an image's tile: the image's, by a whole factor that makes it at least so tall."""
    factor = max(1, -(-smallest // height))
    return width * factor, height * factor
