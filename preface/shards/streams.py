"""Random numbers as a pure function of what they are for: SplitMix64 on a counter.

Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014: the n-th output of
SplitMix64 is the finaliser `mix64` of state + n * GOLDEN, so that any part of the stream is had without the
rest. All arithmetic is modulo 2^64. The permutation of a view's pixels is drawn from it too, hence it is part
of the format and never changes.
"""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType

import numpy as np

from preface.shards.routes import fastest_route

GOLDEN = 0x9E3779B97F4A7C15
_MASK = 2**64 - 1
PERMUTATION_KEY = int.from_bytes(b"preface1", "big")  # what permuted shards are permuted with
# Fewer numbers are drawn by numpy in less time than it takes to import numba, steps on end.
_WORTH_COMPILING = 1024


def mix64(state: int) -> int:
    """The finaliser of SplitMix64 (variant 13 of Stafford's)."""
    state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & _MASK
    return state ^ (state >> 31)


def stream_key(*words: int) -> int:
    """A key for each tuple of whole numbers, such as (seed, step, purpose)."""
    key = 0
    for word in words:
        key = mix64((key + GOLDEN + (word & _MASK)) & _MASK)
        key = mix64((key + GOLDEN) & _MASK)
    return key


def bits(key: int, begin: int, count: int) -> np.ndarray:
    """Outputs `begin` to `begin + count - 1` of the stream of a key, uint64 [count]."""
    state = np.arange(begin + 1, begin + 1 + count, dtype=np.uint64)
    state *= np.uint64(GOLDEN)
    state += np.uint64(key)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        state ^= state >> np.uint64(shift)
        state *= np.uint64(factor)
    state ^= state >> np.uint64(31)
    return state


def compiled_draws(count: int) -> ModuleType | None:
    """`preface.shards.compiled_draws` if it is there and worth its import for so many numbers."""
    return fastest_route().draws if count >= _WORTH_COMPILING else None


def below(key: int, begin: int, count: int, limit: np.ndarray | int) -> np.ndarray:
    """Whole numbers in [0, limit), int64 [count], from 53 bits each; the limits [count] are at most 2^53."""
    if isinstance(limit, int) and (draws := compiled_draws(count)):
        return draws.below(key, begin, count, limit)
    return below_by_numpy(key, begin, count, limit)


def below_by_numpy(key: int, begin: int, count: int, limit: np.ndarray | int) -> np.ndarray:
    """What `below` returns, by numpy, which runs anywhere."""
    share = (bits(key, begin, count) >> np.uint64(11)).astype(np.float64)
    share *= 2.0**-53
    share *= limit
    # The product of a share just below 1 may round up to the limit itself.
    return np.minimum(share.astype(np.int64), np.asarray(limit) - 1)


def without_replacement(key: int, rows: int, allowed: np.ndarray, count: int) -> np.ndarray:
    """For each row, `count` of the allowed columns in random order, all of them before any repeats.

    Args:
        key: of the stream.
        rows: how many.
        allowed: bool [rows, n]; each row allows at least one.
        count: how many columns to draw.

    Returns:
        int64 [rows, count].
    """
    columns = allowed.shape[1]
    keys = bits(key, 0, rows * columns).reshape(rows, columns) >> np.uint64(1)
    order = np.argsort(np.where(allowed, keys, np.uint64(_MASK)), axis=1, kind="stable")
    wrapped = np.arange(count) % allowed.sum(axis=1)[:, None]
    return np.take_along_axis(order, wrapped, axis=1)


@lru_cache(maxsize=2)
def permutation(pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """The order in which permuted shards store the pixels of a view.

    Slot s holds pixel order[s], where `order` sorts the pixels' outputs of the stream of `PERMUTATION_KEY`.

    Args:
        pixels: of a view.

    Returns:
        order, int64 [pixels]: slot -> pixel of the raster; slots, int64 [pixels]: pixel -> slot. Read-only.
    """
    order = np.argsort(bits(PERMUTATION_KEY, 0, pixels), kind="stable")
    slots = np.empty_like(order)
    slots[order] = np.arange(pixels)
    order.setflags(write=False)
    slots.setflags(write=False)
    return order, slots
