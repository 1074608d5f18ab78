"""Numerically delicate operations, each with the domain on which it holds, and the precision they run in.

Everything here is differentiable twice with finite derivatives on its domain. Nothing replaces a
non-finite value that came in: NaN in is NaN out, at the element where it was.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

FP32_EPS = torch.finfo(torch.float32).eps  # the floor multinerf uses throughout, in every dtype
SOFTPLUS_LINEAR_FROM = 40.0  # exp(-40) is below half a rounding of 40 in float32 and in float64

P = ParamSpec("P")
R = TypeVar("R")


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function of tensors compute in float32 at least, whatever precision surrounds it.

    Half and bfloat16 arguments are converted to float32, float64 stays, and autocast is off inside. The
    functions so marked use no matrix product, so that TF32 and reduced-precision matmul settings, which are
    global and cannot be changed safely around a call, have nothing to act on.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        promoted: Any = [_promote(value) for value in args]
        named: Any = {name: _promote(value) for name, value in kwargs.items()}
        device = next((v.device.type for v in (*promoted, *named.values()) if isinstance(v, Tensor)), "cpu")
        if not torch.is_autocast_enabled(device):
            return function(*promoted, **named)
        with torch.autocast(device, enabled=False):
            return function(*promoted, **named)

    return wrapper


def _promote(value: Any) -> Any:
    half = isinstance(value, Tensor) and value.dtype in (torch.float16, torch.bfloat16)
    return value.float() if half else value


def normalize(vectors: Tensor, floor: float = FP32_EPS) -> Tensor:
    """Scale vectors to length one: v * rsqrt(max(v.v, floor)).

    Below a length of sqrt(floor) the result shrinks linearly to zero instead of jumping, and the derivative
    stays at most 1/sqrt(floor); `v / |v|` is NaN at zero there.

    Args:
        vectors: [..., n], any finite values: lengths up to the largest float do not overflow.
        floor: on the squared length; more than the smallest normal float.

    Returns:
        [..., n].
    """
    # A vector and its multiple have one direction, so the scale needs no derivative of its own.
    scale = vectors.detach().abs().amax(dim=-1, keepdim=True).clamp_min(1.0)
    scaled = vectors / scale
    squared = (scaled * scaled).sum(dim=-1, keepdim=True)
    return scaled * torch.rsqrt(torch.maximum(squared, floor / (scale * scale)))


def softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)), exact to rounding for every x; exp(x) where x is very negative, x where it is large."""
    return functional.softplus(x, threshold=SOFTPLUS_LINEAR_FROM)


def log_of_weight(weights: Tensor) -> Tensor:
    """log(w) for w >= 0, -inf at zero, with a derivative of zero there in place of infinity."""
    zero = weights == 0  # not "<= 0": a negative weight is an error, and its NaN should be seen
    return torch.where(zero, -torch.inf, torch.log(torch.where(zero, 1.0, weights)))


def interpolate_sorted(x: Tensor, xp: Tensor, fp: Tensor) -> Tensor:
    """Interpolate linearly in tables whose abscissae may repeat, as `numpy.interp` row by row.

    Where x meets a jump (equal abscissae), the value after the jump is taken. The width of the interval
    divided by is positive for every x within the table, so the derivatives are finite.

    Args:
        x: [..., m], queries; those outside the table take its first or last value.
        xp: [..., n], abscissae in ascending order.
        fp: [..., n], ordinates in ascending order.

    Returns:
        [..., m], ascending where x is.
    """
    low, high = enclosing_indices(xp, x)
    x0, x1 = xp.gather(-1, low), xp.gather(-1, high)
    f0, f1 = fp.gather(-1, low), fp.gather(-1, high)
    width = torch.where(high > low, x1 - x0, 1.0)
    share = ((x - x0) / width).clamp(0.0, 1.0)
    # Rounding may carry the sum past the end of the interval, and with it the order of the results.
    return torch.minimum(f0 + share * (f1 - f0), f1)


def enclosing_indices(edges: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Find the edges around each value: edges[low] <= value < edges[high].

    Values outside [edges[0], edges[-1]) have low = high = the first or the last index.

    Args:
        edges: [..., n], ascending.
        values: [..., m], with the same leading dimensions.

    Returns:
        low, high: int64 [..., m].
    """
    above = torch.searchsorted(edges.detach().contiguous(), values.detach().contiguous(), right=True)
    return (above - 1).clamp_min(0), above.clamp_max(edges.shape[-1] - 1)
