"""What a segmenter is given and what it returns, and the checks that all of them share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from preface.artifacts import ArtifactError


class ForegroundError(ArtifactError):
    """An image, mask, plate or matting model from which no foreground can be made."""


@dataclass(frozen=True, eq=False)
class Hints:
    """What else is known about one photograph.

    Attributes:
        mask: the user's mask, [h, w] or [h, w, 1, 3 or 4], of the photograph's size, or None; 0 is background
            and the type's top (1 for floats and truth values) is foreground.
        plate: the photograph of the empty background, of the photograph's size and kind, or None.
        path: the photograph's file, to be named in errors.
    """

    mask: np.ndarray | None = None
    plate: np.ndarray | None = None
    path: Path = Path("image")


@dataclass(frozen=True, eq=False)
class Foreground:
    """Which part of a photograph is the person.

    Attributes:
        alpha: float32 [h, w], coverage in [0, 1], at the photograph's full resolution.
        pixels: the photograph, [h, w, channels] of the type given; the light that a coloured screen casts on
            the person is taken out where the method does that.
        method: what was used, one of `METHODS`.
        notes: what a user should know about this photograph, as sentences without a period.
    """

    alpha: np.ndarray
    pixels: np.ndarray
    method: str
    notes: tuple[str, ...] = ()


class Segmenter(Protocol):
    """Finds the foreground of one photograph; one object serves any number of them, one after another."""

    name: str

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """Segment a photograph.

        Args:
            pixels: [h, w, 1, 3 or 4], uint8, uint16, float16 or float32, as `preface.capture.images.read_image`
                returns it: integers sRGB-encoded, floats linear light. A fourth channel is looked at by the
                method "given" only.
            hints: what else is known.

        Raises:
            ForegroundError: a hint that the method needs is missing or has another size, or the image has no
                colour where the method needs it.
        """
        ...


def checked_image(pixels: np.ndarray, hints: Hints) -> np.ndarray:
    """The photograph as [h, w, channels], refused when it is no image of a supported kind."""
    image = pixels[..., None] if pixels.ndim == 2 else pixels
    kinds = (np.uint8, np.uint16, np.float16, np.float32)
    if image.ndim != 3 or image.size == 0 or image.shape[2] not in (1, 3, 4) or image.dtype not in kinds:
        problem = f"have the shape {pixels.shape} and type {pixels.dtype}"
        remedy = "Give [height, width, 1, 3 or 4] of uint8, uint16, float16 or float32"
        raise ForegroundError(hints.path, "pixels", problem, remedy)
    return image


def check_size(found: np.ndarray, image: np.ndarray, what: str, hints: Hints) -> None:
    """Refuse a mask or plate of another size than the photograph."""
    if found.shape[:2] != image.shape[:2]:
        sizes = [
            f"{shape[1]}x{shape[0]}" if len(shape) > 1 else str(shape) for shape in (found.shape, image.shape)
        ]
        problem = f"has {sizes[0]} pixels, and the photograph has {sizes[1]}"
        raise ForegroundError(hints.path, what, problem, f"Give a {what} of the photograph's size")
