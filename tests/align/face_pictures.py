"""A photograph of a face that is installed with matplotlib: Grace Hopper, in the public domain."""

from functools import cache

import matplotlib.cbook
import numpy as np

from preface.capture.images import displayable, read_image

EYE_DISTANCE = 120.0  # pixels between the outer eye corners
# Left, top, right, bottom within which the eyes, nose and mouth lie, read off the picture by eye.
RIGHT_EYE_BOX = (195.0, 180.0, 225.0, 205.0)  # the subject's right
LEFT_EYE_BOX = (300.0, 175.0, 330.0, 200.0)


@cache
def portrait() -> np.ndarray:
    """The photograph, uint8 [600, 512, 3], face upright and from the front."""
    pixels = displayable(read_image(matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))
    pixels.setflags(write=False)
    return pixels


def canvas(height: int, width: int) -> np.ndarray:
    """An empty grey picture, uint8 [height, width, 3]."""
    return np.full((height, width, 3), 90, np.uint8)
