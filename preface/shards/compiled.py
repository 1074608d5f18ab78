"""The compiled twin of the loop that a batch spends its time in: rays formed.

It does what `preface.shards.rays` does, operation by operation in the same precision, so that its results are the
same bits (but for the radii, where torch's square root may be a rounding off); the formulas and their sources
stand there. What is different is that all of a ray is done while it is in the cache, and that its fields are
written once. The tests hold one against the other.

A block of rays goes through in stages, each a loop without branches over rows of `LANES` numbers in two scratch
arrays, which is what a compiler turns into vector instructions. No fast-math: nothing is reordered or fused.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import types
from torch import Tensor

from preface.shards.batches import Batch
from preface.shards.compiling import compiled_for, input_of, output_of, stage
from preface.shards.rays import COEFFICIENTS, DERIVED, FAR, FINITE, ORIGIN, RADIUS, SERIES, RayTable

# Rays per block: both scratch arrays stay in a core's first-level cache. The paper's 128 of a view are one block.
LANES = 128
# The rows of `single`. The first ones are columns of the table, in this order; 2 k1 and its like are not among
# them, since a doubling is exact.
_COLUMNS = (*range(COEFFICIENTS + 8), SERIES, SERIES + 1, DERIVED + 3, *range(ORIGIN, FAR + 1))
_SINGLES, _DOUBLES = 24, 13  # columns of float32 and of float64
assert len(_COLUMNS) == _SINGLES
_FX, _FY, _K1, _K2, _P1, _P2, _K3, _K4, _K5, _K6, _S1, _S2, _SIX_K3 = (LANES * row for row in range(13))
_OX, _OY, _OZ, _X0, _Y0, _Z0, _X1, _Y1, _Z1, _N, _F = (LANES * row for row in range(13, _SINGLES))
_XD, _YD, _DX, _DY, _R, _A, _B, _C = (LANES * row for row in range(_SINGLES, _SINGLES + 8))
_SINGLE_ROWS = _SINGLES + 8
# The rows of `double`: the columns, then the distorted point.
_FX_, _FY_, _CX_, _CY_ = (LANES * row for row in range(4))
_R00, _R01, _R02, _R10, _R11, _R12, _R20, _R21, _R22 = (LANES * row for row in range(4, _DOUBLES))
_XD_, _YD_ = (LANES * row for row in range(_DOUBLES, _DOUBLES + 2))
_DOUBLE_ROWS = _DOUBLES + 2

# Numba takes a number without a type for a float64, and all that is computed with it.
_ZERO, _ONE, _TWO, _THREE, _FOUR = (np.float32(number) for number in range(5))
_RADIUS, _LARGEST, _SMALLEST = np.float32(RADIUS), np.float32(FINITE), np.float32(-FINITE)
_BYTE = np.float32(255)


@stage
def _fill_from_one(
    single: np.ndarray,
    double: np.ndarray,
    columns: np.ndarray,
    exact: np.ndarray,
    view: int,
    begin: int,
    end: int,
) -> None:
    """Put the numbers of one view, out of columns [M * 24] and exact [M * 13], into lanes begin to end - 1."""
    at = np.uint64(view * _SINGLES)  # without a sign, so that nothing checks for one
    for column in range(_SINGLES):
        value = columns[at + np.uint64(column)]
        for lane in range(begin, end):
            single[np.uint64(column * LANES + lane)] = value
    at = np.uint64(view * _DOUBLES)
    for column in range(_DOUBLES):
        number = exact[at + np.uint64(column)]
        for lane in range(begin, end):
            double[np.uint64(column * LANES + lane)] = number


@stage
def _fill_from_many(
    single: np.ndarray,
    double: np.ndarray,
    columns: np.ndarray,
    exact: np.ndarray,
    views: np.ndarray,
    first: int,
) -> None:
    """Put the numbers of the views of rays `first` and after, one ray a lane, into the lanes."""
    for lane in range(min(len(views) - first, LANES)):
        view = views[np.uint64(first + lane)]
        at = np.uint64(view * _SINGLES)
        for column in range(_SINGLES):
            single[column * LANES + lane] = columns[at + np.uint64(column)]
        at = np.uint64(view * _DOUBLES)
        for column in range(_DOUBLES):
            double[column * LANES + lane] = exact[at + np.uint64(column)]


@stage
def _distorted(
    single: np.ndarray, double: np.ndarray, pixels: np.ndarray, first: int, count: int, width: int
) -> None:
    """`rays._distorted`."""
    across = float(width)
    inverse = 1.0 / across
    for i in range(count):
        index = float(pixels[np.uint64(first + i)])
        row = math.floor((index + 0.5) * inverse)
        x = (index - row * across - double[_CX_ + i]) * double[_FX_ + i]
        y = (row - double[_CY_ + i]) * double[_FY_ + i]
        double[_XD_ + i], double[_YD_ + i] = x, y
        single[_XD + i], single[_YD + i] = np.float32(x), np.float32(y)


@stage
def _series(single: np.ndarray, count: int) -> None:
    """`rays._series`."""
    for i in range(count):
        x, y, p1, p2 = single[_XD + i], single[_YD + i], single[_P1 + i], single[_P2 + i]
        u = x * x + y * y
        gain = u * (single[_S1 + i] + u * single[_S2 + i]) - (_TWO * p2 * x + _TWO * p1 * y)
        single[_DX + i] = gain * x - u * p2
        single[_DY + i] = gain * y - u * p1


@stage
def _newton_step(single: np.ndarray, count: int, rational: bool) -> None:
    """`rays._newton_step` taken, and the radii out of its Jacobian."""
    for i in range(count):
        dx, dy, p1, p2 = single[_DX + i], single[_DY + i], single[_P1 + i], single[_P2 + i]
        x, y = single[_XD + i] + dx, single[_YD + i] + dy
        u = x * x + y * y
        radial = u * (single[_K1 + i] + u * (single[_K2 + i] + u * single[_K3 + i]))
        slope = _TWO * single[_K1 + i] + u * (_FOUR * single[_K2 + i] + u * single[_SIX_K3 + i])
        if rational:
            k4, k5, k6 = single[_K4 + i], single[_K5 + i], single[_K6 + i]
            below = u * (k4 + u * (k5 + u * k6))
            share = _ONE / (_ONE + below)
            radial = (radial - below) * share
            slope = (slope - _TWO * (_ONE + radial) * (k4 + u * (_TWO * k5 + u * (_THREE * k6)))) * share
        excess = radial + (_TWO * p2 * x + _TWO * p1 * y)
        error_x = dx + excess * x + u * p2
        error_y = dy + excess * y + u * p1
        gain, slope_x = _ONE + excess, slope * x
        xx = gain + slope_x * x + _FOUR * p2 * x
        xy = slope_x * y + (_TWO * p1 * x + _TWO * p2 * y)
        yy = gain + slope * (y * y) + _FOUR * p1 * y
        square = xy * xy
        inverse = _ONE / (xx * yy - square)
        single[_DX + i] = dx + (xy * error_y - yy * error_x) * inverse
        single[_DY + i] = dy + (xy * error_x - xx * error_y) * inverse
        along_x = np.sqrt(yy * yy + square) * single[_FX + i]
        along_y = np.sqrt(xx * xx + square) * single[_FY + i]
        single[_R + i] = (along_x + along_y) * inverse * _RADIUS


@stage
def _without_distortion(single: np.ndarray, count: int) -> None:
    """The displacement and the radii where no lens distorts."""
    for i in range(count):
        single[_DX + i] = single[_DY + i] = _ZERO
        single[_R + i] = (single[_FX + i] + single[_FY + i]) * _RADIUS


@stage
def _turn(single: np.ndarray, double: np.ndarray, count: int) -> None:
    """The undistorted points turned into the canonical frame."""
    for i in range(count):
        x, y = double[_XD_ + i] + float(single[_DX + i]), double[_YD_ + i] + float(single[_DY + i])
        single[_A + i] = np.float32(x * double[_R00 + i] + y * double[_R01 + i] + double[_R02 + i])
        single[_B + i] = np.float32(x * double[_R10 + i] + y * double[_R11 + i] + double[_R12 + i])
        single[_C + i] = np.float32(x * double[_R20 + i] + y * double[_R21 + i] + double[_R22 + i])


@stage
def _write_vectors(
    x: int, y: int, z: int, single: np.ndarray, first: int, count: int, out: np.ndarray
) -> None:
    """Write three rows as vectors, to out [3 n] from vector `first` on."""
    # A bound that is known to be small lets the compiler see that nothing overflows, and store in vectors.
    for i in range(min(count, LANES)):
        at = np.uint64(3 * first) + np.uint64(3 * i)
        out[at] = single[x + i]
        out[at + np.uint64(1)] = single[y + i]
        out[at + np.uint64(2)] = single[z + i]


@stage
def _normalise(single: np.ndarray, count: int) -> None:
    """Directions to length one."""
    for i in range(count):
        a, b, c = single[_A + i], single[_B + i], single[_C + i]
        inverse = _ONE / np.sqrt(a * a + b * b + c * c)
        single[_A + i], single[_B + i], single[_C + i] = a * inverse, b * inverse, c * inverse


_lower = stage(lambda a, b: a if a < b else b)
_higher = stage(lambda a, b: a if a > b else b)


@stage
def _write_depths(
    single: np.ndarray, first: int, count: int, near: np.ndarray, far: np.ndarray, hit: np.ndarray
) -> None:
    """`rays._depths`, to near, far and hit from ray `first` on."""
    for i in range(count):
        at = np.uint64(first + i)
        x, y, z = _ONE / single[_A + i], _ONE / single[_B + i], _ONE / single[_C + i]
        x0, y0, z0 = single[_X0 + i] * x, single[_Y0 + i] * y, single[_Z0 + i] * z
        x1, y1, z1 = single[_X1 + i] * x, single[_Y1 + i] * y, single[_Z1 + i] * z
        enter = _higher(_higher(_lower(x0, x1), _lower(y0, y1)), _lower(z0, z1))
        leave = _lower(_lower(_higher(x0, x1), _higher(y0, y1)), _higher(z0, z1))
        enter = _lower(_higher(enter, _ZERO), _LARGEST)
        leave = _lower(_higher(leave, _SMALLEST), _LARGEST)
        meets = leave > enter
        near[at] = enter if meets else single[_N + i]
        far[at] = leave if meets else single[_F + i]
        hit[at] = meets


@stage
def _write_rest(
    single: np.ndarray, first: int, count: int, rgba: np.ndarray, radii: np.ndarray, colours: np.ndarray
) -> None:
    """Write the radii, and the four bytes of each ray as shares of 255, from ray `first` on."""
    for i in range(count):
        radii[np.uint64(first + i)] = single[_R + i]
    for i in range(4 * count):
        at = np.uint64(4 * first + i)
        colours[at] = np.float32(rgba[at]) / _BYTE


@stage
def _write_indices(group: int, begin: int, end: int, indices: np.ndarray, out: np.ndarray) -> None:
    """Write the index of a group to its rays begin to end - 1."""
    index = indices[np.uint64(group)]
    for ray in range(begin, end):
        out[np.uint64(ray)] = index


def _form(
    exact: np.ndarray,
    columns: np.ndarray,
    steps: int,
    rational: bool,
    width: int,
    rows: np.ndarray,
    identity: np.ndarray,
    view: np.ndarray,
    pixels: np.ndarray,
    per_group: int,
    rgba: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    viewdirs: np.ndarray,
    radii: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    colours: np.ndarray,
    identities_out: np.ndarray,
    views_out: np.ndarray,
    hit: np.ndarray,
) -> None:
    """Form the rays of pixels [G * P] block by block; the fields of a batch, flat, come last."""
    single = np.empty(_SINGLE_ROWS * LANES, np.float32)
    double = np.empty(_DOUBLE_ROWS * LANES, np.float64)
    for first in range(0, len(pixels), LANES):
        last = min(first + LANES, len(pixels))
        count, begin = last - first, first
        if per_group == 1:
            _fill_from_many(single, double, columns, exact, rows, first)
        while begin < last:
            group = begin // per_group
            end = min(last, (group + 1) * per_group)
            if per_group > 1:
                _fill_from_one(single, double, columns, exact, rows[group], begin - first, end - first)
            _write_indices(group, begin, end, identity, identities_out)
            _write_indices(group, begin, end, view, views_out)
            begin = end
        _distorted(single, double, pixels, first, count, width)
        if steps > 0:
            _series(single, count)
            for _ in range(steps):
                _newton_step(single, count, rational)
        else:
            _without_distortion(single, count)
        _turn(single, double, count)
        _write_depths(single, first, count, near, far, hit)
        _write_vectors(_OX, _OY, _OZ, single, first, count, origins)
        _write_vectors(_A, _B, _C, single, first, count, directions)
        _normalise(single, count)
        _write_vectors(_A, _B, _C, single, first, count, viewdirs)
        _write_rest(single, first, count, rgba, radii, colours)


_form_rays = compiled_for(
    _form,
    *(input_of(types.float64), input_of(types.float32), types.int64, types.boolean, types.int64),
    *[input_of(types.int64)] * 4,
    *(types.int64, input_of(types.uint8)),
    *[output_of(types.float32)] * 7,
    *(output_of(types.int64), output_of(types.int64), output_of(types.boolean)),
)


class CompiledTable:
    """A ray table on the CPU, laid out for the kernel: view by view.

    Args:
        table: of all views of the dataset, identity by identity.
    """

    def __init__(self, table: RayTable):
        self._table = table
        self._exact = np.ascontiguousarray(table.exact.numpy().T).reshape(-1)
        self._columns = np.ascontiguousarray(table.columns.numpy()[list(_COLUMNS)].T).reshape(-1)

    def form_batch(
        self, identity: np.ndarray, view: np.ndarray, views: int, pixel: np.ndarray, rgba: Tensor
    ) -> Batch:
        """`preface.shards.batches.form_batch`, without the global lock of Python.

        Args:
            identity, view: int64 [G].
            views: V of the dataset.
            pixel: int64 [G, P], raster indices.
            rgba: int32 [G, P], the pixels' four bytes.

        Raises:
            IndexError: an identity or a view that is not there.
            ValueError: arrays that do not fit each other.
        """
        if not len(identity) == len(view) == len(pixel) or rgba.shape != pixel.shape:
            raise ValueError(
                f"pixel: {pixel.shape} does not fit {identity.shape}, {view.shape}, {rgba.shape}"
            )
        table, rows = self._table, identity * views + view
        if len(rows) and not 0 <= rows.min() <= rows.max() < table.exact.shape[1]:  # nothing checks it later
            raise IndexError(f"identity: {rows.min()} to {rows.max()} are not all among the views")
        batch = Batch.empty(pixel.size, torch.device("cpu"))
        inputs = (
            np.ascontiguousarray(array, np.int64).reshape(-1) for array in (rows, identity, view, pixel)
        )
        channels = rgba.contiguous().numpy().reshape(-1).view(np.uint8)
        _form_rays(
            *(self._exact, self._columns, table.steps, table.rational, table.width),
            *(*inputs, pixel.shape[1], channels),
            *(field.numpy().reshape(-1) for field in vars(batch).values()),
        )
        return batch
