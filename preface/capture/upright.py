"""Photographs from a phone as a person sees them: turned as EXIF says.

Phones store what the sensor saw and note how they were held. `preface.capture.images` refuses such files, because a
calibration made of other images could disagree. Photographs that are their own calibration, those of
``preface-align photos``, are read here instead: pixels, width and height are those after turning, and so are cameras
and landmarks that follow from them. JPEG and PNG, as phones write them; a TIFF that is to be turned stays refused.
"""

import os
from dataclasses import replace

import numpy as np

from preface.capture.images import ImageError, ImageHeader, decode, stored_header

# EXIF 2.32, tag 0x0112: whether the stored pixels are to be mirrored left to right, then turned clockwise by quarters.
_TURNS = {
    1: (False, 0),
    2: (True, 0),
    3: (False, 2),
    4: (True, 2),
    5: (True, 3),
    6: (False, 1),
    7: (True, 1),
    8: (False, 3),
}


def read_upright_header(path: str | os.PathLike[str]) -> ImageHeader:
    """Read an image's header; width and height are those of the upright image, ``orientation`` the file's.

    Raises:
        ImageError: not a supported image, too large, or an orientation that EXIF does not know.
    """
    header = stored_header(path)
    _, quarters = _turn(path, header)
    if quarters % 2:
        return replace(header, width=header.height, height=header.width)
    return header


def read_upright(path: str | os.PathLike[str]) -> np.ndarray:
    """Decode an image and turn it upright: [height, width, channels] as `preface.capture.images.read_image`.

    Raises:
        ImageError: as `read_upright_header` and `preface.capture.images.decode`.
    """
    header = stored_header(path)
    mirrored, quarters = _turn(path, header)
    pixels = decode(path, header)
    if mirrored:
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(np.rot90(pixels, -quarters))


def _turn(path: str | os.PathLike[str], header: ImageHeader) -> tuple[bool, int]:
    if header.orientation != 1 and header.format == "TIFF":  # OpenCV's decoder turns some of them itself
        problem = f"is {header.orientation}, which is applied to JPEG and PNG only"
        raise ImageError(path, "EXIF orientation", problem, "Turn the pixels (mogrify -auto-orient FILE)")
    if header.orientation not in _TURNS:
        problem = f"is {header.orientation}, and EXIF knows 1 to 8"
        remedy = "Remove the tag (exiftool -Orientation= FILE) and turn the pixels upright"
        raise ImageError(path, "EXIF orientation", problem, remedy)
    return _TURNS[header.orientation]
