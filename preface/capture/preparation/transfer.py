"""From a file's values to light and from light to sRGB bytes: what every value means, stated once.

| array | means | taken as |
|---|---|---|
| uint8, uint16 | sRGB-encoded, as PNG, JPEG and TIFF are (IEC 61966-2-1) | light in [0, 1] |
| float16, float32 | linear light, as EXR is | light / white, cut off to [0, 1] pixel by pixel, before filtering |

Floats that are no number or infinite are refused. What was cut off is counted by `cut_off`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from preface.capture.preparation.options import Light, PreparationError
from preface.srgb import decode, encode, light_of_levels

# Steps of the table that finds an sRGB byte: finer than the closest two thresholds, 1 / 255 / 12.92 apart, so
# that a step holds no more than one of them.
_STEPS = 4096
DTYPES = (np.uint8, np.uint16, np.float16, np.float32)
LARGEST_ALPHA = 1 + 1e-3  # a half float's rounding above 1

Reader = Callable[..., object]  # what it returns is of no interest


@dataclass(frozen=True)
class CutOff:
    """Shares of an image's values that were cut off.

    Attributes:
        above_white: were brighter than white.
        below_black: were negative.
    """

    above_white: float
    below_black: float


def cut_off(pixels: np.ndarray, white: float) -> CutOff:
    """Count what `Resampler.colors` cuts off: values of float images outside [0, white]; none of integers."""
    if pixels.dtype.kind != "f":
        return CutOff(0.0, 0.0)
    above, below = (int(np.count_nonzero(outside)) for outside in (pixels > white, pixels < 0))
    return CutOff(above / pixels.size, below / pixels.size)


def reader(dtype: np.dtype, meaning: Light | Literal["alpha"], white: float) -> Reader:
    """How rows of an image are read: ``read(rows, out)`` writes them into float32 ``out`` of the same shape.

    Args:
        dtype: of the image, one of `DTYPES`.
        meaning: what to write, from 0 to 1: ``linear`` light, sRGB values (``encoded``), or an ``alpha``,
            which is neither, and may exceed 1 by a rounding.
        white: the light of float images that counts as 1.
    """
    if dtype.kind == "f":
        return as_they_are if meaning == "alpha" else _float_reader(meaning, white)
    if meaning != "linear":
        factor = np.float32(1 / np.iinfo(dtype).max)
        return lambda rows, out: np.multiply(rows, factor, out=out, dtype=np.float32, casting="unsafe")
    table = light_of_levels(dtype)
    if dtype == np.uint8:
        return lambda rows, out: _look_up(table, rows, out)
    return lambda rows, out: np.take(table, rows, out=out, mode="clip")


def premultiplied_reader(colors: Reader, alphas: Reader) -> Reader:
    """How rows of an image are read with those of its alpha: ``read(rows, alpha, out)`` writes their product.

    Args:
        colors, alphas: how either is read.
    """

    def read(rows: np.ndarray, alpha: np.ndarray, out: np.ndarray) -> None:
        import cv2

        colors(rows, out)
        shares = np.empty(alpha.shape[:2], np.float32)
        alphas(alpha.reshape(shares.shape), shares)
        into = out.reshape(*shares.shape, -1)
        into *= cv2.cvtColor(shares, cv2.COLOR_GRAY2RGB) if into.shape[2] == 3 else shares[..., None]

    return read


def as_they_are(rows: np.ndarray, out: np.ndarray) -> None:
    """The reader of what is light already, float32."""
    np.copyto(out, rows)


def _look_up(table: np.ndarray, rows: np.ndarray, out: np.ndarray) -> None:
    import cv2

    cv2.LUT(rows, table, dst=out)


def _float_reader(meaning: Light, white: float) -> Reader:
    factor = np.float32(1 / white)

    def read(rows: np.ndarray, out: np.ndarray) -> None:
        finite = np.isfinite(rows)
        if not finite.all():
            problem = (
                f"hold {rows[~finite].flat[0]} ({int((~finite).sum())} values in {len(rows)} rows alone)"
            )
            raise PreparationError("pixels", problem, "export the image again: light is a finite number")
        np.copyto(out, rows)
        np.multiply(out, factor, out=out)
        np.clip(out, 0, 1, out=out)
        if meaning == "encoded":
            out[...] = encode(out)

    return read


def bytes_of_light(light: np.ndarray) -> np.ndarray:
    """The nearest sRGB bytes of linear light, float32 of any shape; below 0 is 0 and above 1 is 255.

    Exactly what rounding the encoded value gives: a table says which byte a small step of light begins with,
    and the one threshold inside the step whether it is the next.
    """
    first, threshold = _byte_table()
    step = np.clip(light * np.float32(_STEPS), 0, _STEPS - 1).astype(np.intp)
    return np.take(first, step) + (light >= np.take(threshold, step)).astype(np.uint8)


def bytes_of_values(values: np.ndarray) -> np.ndarray:
    """The nearest bytes of values where 1 is 255, float32 of any shape; below 0 is 0 and above 1 is 255."""
    return np.rint(np.clip(values, 0, 1) * np.float32(255)).astype(np.uint8)


@cache
def _byte_table() -> tuple[np.ndarray, np.ndarray]:
    """For every step of light: the byte of its start, uint8, and the light at which the next byte begins."""
    thresholds = decode((np.arange(255) + 0.5) / 255)  # float64: between bytes k and k + 1
    rounded = thresholds.astype(np.float32)
    up = np.nextafter(rounded, np.float32(2))
    rounded = np.where(rounded < thresholds, up, rounded).astype(np.float32)
    starts = np.arange(_STEPS, dtype=np.float32) / np.float32(_STEPS)
    first = np.searchsorted(rounded, starts, side="right")
    return first.astype(np.uint8), np.append(rounded, np.float32(np.inf))[first]
