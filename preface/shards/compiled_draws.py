"""The compiled twins of what is drawn thousands of times a step: random numbers, and the rays of single heads.

They do what `preface.shards.streams` and `preface.shards.samplers` do by numpy, to the bit, without an array per
operation. The tests hold one against the other.
"""

from __future__ import annotations

import numpy as np
from numba import types

from preface.shards.compiling import compiled_for, input_of, output_of


def _below(key: int, begin: int, limit: int, out: np.ndarray) -> None:
    """`streams.below` for one limit, to out [count]."""
    scale = float(limit)
    for i in range(len(out)):
        state = np.uint64(begin + 1 + i) * np.uint64(0x9E3779B97F4A7C15) + key
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state = state ^ (state >> np.uint64(31))
        number = np.int64(np.float64(np.int64(state >> np.uint64(11))) * 2.0**-53 * scale)
        out[i] = min(number, limit - 1)


# In what follows no branch depends on what was drawn, since no processor can guess it. Quotients are floors of those
# of float64, which are exact for numbers below 2^53.


def _from_views(number: np.ndarray, total: int, pair: np.ndarray, pixel: np.ndarray) -> None:
    """Views of `total` pixels each, and pixels, by the number [count] of a pixel among all."""
    for i in range(len(number)):
        view = np.int64(float(number[i]) / float(total))
        pair[i] = view
        pixel[i] = number[i] - view * total


def _from_boxes(
    chance: np.ndarray,
    bound: int,
    number: np.ndarray,
    left: np.ndarray,
    top: np.ndarray,
    across: np.ndarray,
    areas: np.ndarray,
    width: int,
    pair: np.ndarray,
    pixel: np.ndarray,
) -> None:
    """Where chance [count] is below the bound: views and pixels by the number of a pixel among those of all boxes."""
    box = np.zeros(len(number), np.uint64)  # the first that ends beyond; searched for all of them at once
    size = len(areas)
    while size > 1:
        half = size // 2
        for i in range(len(number)):
            further = box[i] + np.uint64(half)
            box[i] = further if areas[further - np.uint64(1)] <= number[i] else box[i]
        size -= half
    before = np.zeros(len(areas), np.int64)
    before[1:] = areas[:-1]
    place = np.empty(len(number), np.int64)
    for i in range(len(number)):
        within, columns = number[i] - before[box[i]], across[box[i]]
        down = np.int64(float(within) / float(columns))
        place[i] = (top[box[i]] + down) * width + left[box[i]] + within - down * columns
    for i in range(len(number)):  # by itself, or it becomes a branch around the division
        pair[i] = np.int64(box[i]) if chance[i] < bound else pair[i]
        pixel[i] = place[i] if chance[i] < bound else pixel[i]


_array = input_of(types.int64)
_places = [output_of(types.int64)] * 2
_draw_below = compiled_for(_below, types.uint64, types.int64, types.int64, output_of(types.int64))
_place_in_views = compiled_for(_from_views, _array, types.int64, *_places)
_place_in_boxes = compiled_for(_from_boxes, _array, types.int64, *[_array] * 5, types.int64, *_places)


def below(key: int, begin: int, count: int, limit: int) -> np.ndarray:
    """`preface.shards.streams.below` for one limit."""
    out = np.empty(count, np.int64)
    _draw_below(key, begin, limit, out)
    return out


def single_rays(
    keys: tuple[int, int, int],
    bound: int,
    begin: int,
    count: int,
    size: tuple[int, int],
    boxes: np.ndarray,
    areas: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """`preface.shards.samplers.single_rays_by_numpy`."""
    uniform, chance, boxed = keys
    width, height = size
    pair, pixel = np.empty(count, np.int64), np.empty(count, np.int64)
    number = below(uniform, begin, count, len(areas) * width * height)
    _place_in_views(number, width * height, pair, pixel)
    if bound > 0:
        chances = below(chance, begin, count, 2**53)
        number = below(boxed, begin, count, int(areas[-1]))
        _place_in_boxes(chances, bound, number, *boxes, areas, width, pair, pixel)
    return pair, pixel
