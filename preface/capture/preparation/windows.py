"""Which part of a photograph becomes a shard's image, and the exact camera of that part at its new size."""

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from preface.capture.preparation.options import PreparationError
from preface.geometry import CAMERA_MODELS, Camera

Framing = Literal["whole", "center", "box"]
# Points per line between two corners of a box: enough for lines that a lens bends.
_LINE_POINTS = 17
# How far, in pixels of the source, a window may pass the image's border: the rounding of its arithmetic.
_ROUNDING = 1e-6
_UPSCALING = "choose a smaller --resolution, or photographs with more pixels: enlarging adds none"


@dataclass(frozen=True)
class Window:
    """A part of a photograph, [x, x + width) x [y, y + height).

    Attributes:
        x, y: its corner, in pixels of the photograph, whose top-left pixel has its centre at (0.5, 0.5); they
            need not be whole.
        width, height: in those pixels.
    """

    x: float
    y: float
    width: float
    height: float


def framing_window(
    camera: Camera,
    size: tuple[int, int],
    framing: Framing,
    camera_from_box_corners: np.ndarray | None = None,
) -> Window:
    """Place the window that becomes an image of the wanted size.

    Args:
        camera: of the whole photograph.
        size: width and height of the result, pixels.
        framing: ``whole``: everything, if its aspect is the result's to half a pixel of the result.
            ``center``: the largest window of the result's aspect, centred. ``box``: the smallest window of
            that aspect around the projected box that is no smaller than the result, moved to lie inside
            the image; where the image is too narrow for it, the largest one that fits, as near as possible.
        camera_from_box_corners: [8, 3], the corners of the box in the camera's frame, metres, for ``box``.

    Raises:
        PreparationError: the result is larger than the window, the aspects differ, or the box is not
            before the camera or not in its picture.
    """
    width, height = checked_size(size)
    if width > camera.width or height > camera.height:
        problem = f"{width}x{height} is larger than the photograph's {camera.width}x{camera.height}"
        raise PreparationError("resolution", problem, _UPSCALING)
    if framing == "whole":
        return _whole(camera, width, height)
    scale = min(camera.width / width, camera.height / height)
    if framing == "center":
        across, down = width * scale, height * scale
        return Window((camera.width - across) / 2, (camera.height - down) / 2, across, down)
    if framing == "box":
        if camera_from_box_corners is None:
            raise ValueError("camera_from_box_corners: framing by the box needs them")
        return _around_box(camera, width, height, scale, np.asarray(camera_from_box_corners, np.float64))
    raise PreparationError("framing", f"{framing!r} is unknown", "use one of whole, center, box")


def checked_size(size: tuple[int, int]) -> tuple[int, int]:
    """Width and height as ints.

    Raises:
        PreparationError: not two whole numbers of at least one pixel.
    """
    width, height = size
    if int(width) != width or int(height) != height or width < 1 or height < 1:
        raise PreparationError("resolution", f"{width}x{height} is no size", "give whole pixels, as 512x768")
    return int(width), int(height)


def checked_window(camera: Camera, size: tuple[int, int], window: Window) -> Window:
    """The window, moved by rounding errors into the image.

    Raises:
        PreparationError: it reaches out of the image, or is smaller than the result.
    """
    spans = []
    for start, span, limit in (
        (window.x, window.width, camera.width),
        (window.y, window.height, camera.height),
    ):
        inside = start >= -_ROUNDING and span > 0 and start + span <= limit + _ROUNDING
        if not inside:  # also what is no number
            problem = f"{window} reaches out of the {camera.width}x{camera.height} image"
            raise PreparationError("window", problem, "place it inside, or frame the image whole or center")
        start = max(start, 0.0)
        spans.append((start, min(span, limit - start)))
    (x, across), (y, down) = spans
    width, height = size
    if across < width * (1 - 1e-12) or down < height * (1 - 1e-12):
        problem = f"{across:g}x{down:g} pixels would be enlarged to {width}x{height}"
        raise PreparationError("window", problem, _UPSCALING)
    return Window(x, y, across, down)


def camera_of_window(camera: Camera, size: tuple[int, int], window: Window) -> Camera:
    """The camera of the window resampled to a size; distortion is kept, and everything is exact.

    Pixel (u, v) of the photograph becomes ((u - x) W / width, (v - y) H / height), because pixel coordinates
    are continuous. Models with one focal length become OPENCV where the two factors differ.
    """
    across, down = size[0] / window.width, size[1] / window.height
    if abs(across / down - 1) < 1e-14:  # equal but for rounding
        down = across
    elif "f" in CAMERA_MODELS[camera.model]:
        camera = camera.as_model("OPENCV")
    affine = {
        "f": (across, 0.0),
        "fx": (across, 0.0),
        "fy": (down, 0.0),
        "cx": (across, window.x),
        "cy": (down, window.y),
    }
    factor, corner = np.array([affine.get(name, (1.0, 0.0)) for name in CAMERA_MODELS[camera.model]]).T
    return Camera(camera.model, *size, (camera.params - corner) * factor)


def _whole(camera: Camera, width: int, height: int) -> Window:
    # The size that keeps the aspect, given one side, may differ by half a pixel from the other.
    fits_down = abs(camera.height * width / camera.width - height) <= 0.5
    fits_across = abs(camera.width * height / camera.height - width) <= 0.5
    if not (fits_down or fits_across):
        problem = f"{width}x{height} has another aspect than the photograph's {camera.width}x{camera.height}"
        remedy = "choose one with the same aspect, or frame the images center or box"
        raise PreparationError("resolution", problem, remedy)
    return Window(0.0, 0.0, float(camera.width), float(camera.height))


def _around_box(camera: Camera, width: int, height: int, scale: float, corners: np.ndarray) -> Window:
    if corners.shape != (8, 3) or not np.isfinite(corners).all():
        raise ValueError(f"camera_from_box_corners: {corners.shape} are not eight finite points [8, 3]")
    if not (corners[:, 2] > 0).all():
        raise PreparationError(
            "box", "is not wholly before the camera", "frame the image center, or check the alignment"
        )
    share = np.linspace(0.0, 1.0, _LINE_POINTS)[:, None]
    lines = np.concatenate([a + share * (b - a) for a, b in combinations(corners, 2)])
    # What the lens cannot show is beyond the image.
    pixels, valid = camera.project(lines)
    inside = valid & ((pixels > 0) & (pixels < (camera.width, camera.height))).all(-1)
    if not inside.any():
        raise PreparationError("box", "is not in the picture", "leave the view out, or check the alignment")
    limit = np.array([camera.width, camera.height], np.float64)
    low = np.clip(pixels[valid].min(0), 0, limit)
    high = np.clip(pixels[valid].max(0), 0, limit)
    size = np.array([width, height], np.float64)
    span = size * np.clip(((high - low) / size).max(), 1.0, scale)
    corner = np.clip((low + high) / 2 - span / 2, 0.0, limit - span)
    return Window(float(corner[0]), float(corner[1]), float(span[0]), float(span[1]))
