"""How renders are shown, wherever they are: errors and normals as colours, and the size of tiles."""

from __future__ import annotations

import numpy as np

from preface.reports.pictures import Picture, as_picture, colorize

ERROR_SHOWN = 0.25  # the mean absolute error, of 1, at the bright end of the error map
SMALLEST = 200  # pixels of a tile's height; smaller images are enlarged by repeating pixels


def error_picture(rgb: np.ndarray, truth: np.ndarray) -> Picture:
    """The mean over channels of the absolute difference of two images [H, W, 3], from none to `ERROR_SHOWN`."""
    return colorize(np.abs(rgb - truth).mean(axis=-1), 0, ERROR_SHOWN, "inferno")


def normals_picture(normals: np.ndarray) -> Picture:
    """Normals [H, W, 3] as colours, black where there is none.

    Red grows along x of their frame, green along y, blue along z; the canonical frame's are to the subject's left, up
    and out of the face.
    """
    return as_picture(np.where(np.isnan(normals), 0.0, (normals + 1) / 2).astype(np.float32))


def tile_size(width: int, height: int, smallest: int = SMALLEST) -> tuple[int, int]:
    """Width and height of an image's tile: the image's, by a whole factor that makes it at least so tall."""
    factor = max(1, -(-smallest // height))
    return width * factor, height * factor
