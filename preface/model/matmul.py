"""How a process multiplies float32 matrices, chosen by trying; and how it keeps the memory it multiplies in.

On a CPU, PyTorch has two libraries for float32 products, MKL and oneDNN, and takes MKL. Which is faster depends
on the processor: oneDNN by more than two on AMD's, MKL on Intel's. The switch to oneDNN is the permission to use
bfloat16 inside; a processor without fast bfloat16 products stays exact to float32 rounding, one with them does
not. So the choice is by measurement, of the error as well as of the speed:

    route = choose_route("fp32")
    route.apply()

bfloat16 products, where the configuration asks for them, have tensors of that type and one route.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Precision = Literal["fp32", "bf16"]
FP32_ERROR = 4e-6  # of a float32 route, relative to the largest of the result; MKL has 3e-7 to 1e-6
_SETTINGS = {"mkl": "none", "onednn": "bf16"}
_ROWS = {"cpu": 2048, "cuda": 16384}
_REPEATS = 8


@dataclass(frozen=True)
class Route:
    """A way of multiplying matrices, and what it was measured to do.

    Attributes:
        name: `mkl` or `onednn` for float32 on a CPU, `bfloat16`, or the device's type.
        gflops: of the best of a few products, 1e9 operations per second with the threads in use; what a
            run's use of the machine is held against.
        error: the largest against float64, relative to the largest element of the result.
    """

    name: str
    gflops: float
    error: float

    def apply(self) -> None:
        """Make this process take the route in all float32 products on its CPU."""
        _set(_SETTINGS.get(self.name, "none"))


def choose_route(precision: Precision, device: torch.device | str = "cpu", width: int = 512) -> Route:
    """Try the routes that a precision has on a device, in well under a second.

    Args:
        precision: of the products.
        device: where they are formed.
        width: of the matrices, that of the network's layers.

    Returns:
        The fastest of those exact enough for the precision. The process's settings are as before.
    """
    kind = torch.device(device).type
    if precision == "bf16":
        return measure_route("bfloat16", device, width)
    if kind != "cpu":
        return measure_route(kind, device, width)
    found = [measure_route(name, device, width) for name in _SETTINGS]
    exact = [route for route in found if route.error <= FP32_ERROR]
    return max(exact, key=lambda route: route.gflops)


def keep_freed_memory() -> bool:
    """Ask the C library to keep memory that was freed instead of giving it back to the system.

    PyTorch's CPU allocator has no cache: tensors of more than 32 MiB, and on a young process of more than
    128 KiB, are fresh pages each time, which have to be cleared and mapped. It halves the speed of chunks of
    more than some hundred rays; smaller chunks stay in the heap anyway. A process grows to its largest need
    and stays there.

    Returns:
        Whether the library knows the request (glibc does).
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # another C library
        return False
    trim_threshold, mmap_max = -1, -4  # glibc's malloc.h
    return bool(mallopt(mmap_max, 0)) and bool(mallopt(trim_threshold, 2**31 - 1))


@contextmanager
def denormals_flushed() -> Iterator[None]:
    """Take numbers below 1.2e-38 for zero, in this thread and in those that it starts meanwhile.

    Processors multiply them a hundred times more slowly, and there are many: an encoding that a wide cone has
    averaged away, the weight of a sample behind a surface, and the gradients of both. Nothing that is added to
    them can tell the difference. Enter before anything is computed: threads that already run keep their ways.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def measure_route(name: str, device: torch.device | str = "cpu", width: int = 512) -> Route:
    """Measure a route on the three products of a layer: forward, and by its input and its weight.

    Args:
        name: see `Route`.
        device: where.
        width: of the matrices.
    """
    device, dtype = torch.device(device), torch.bfloat16 if name == "bfloat16" else torch.float32
    generator = torch.Generator().manual_seed(0)
    rows = _ROWS.get(device.type, _ROWS["cuda"])
    x, y = (torch.randn(rows, width, generator=generator).to(device, dtype) for _ in range(2))
    weight = torch.randn(width, width, generator=generator).to(device, dtype)
    pairs = [(x, weight.T), (x, weight), (y.T, x)]
    with _setting(_SETTINGS.get(name, "none")):
        error = max(_error(a, b) for a, b in pairs)
        seconds = min(_seconds(*pairs[0], device) for _ in range(_REPEATS))
    return Route(name, 2 * rows * width * width / seconds / 1e9, error)


def _error(a: Tensor, b: Tensor) -> float:
    # Some rows are enough: of what is summed, all of it is.
    exact = a[:64].double() @ b.double()
    return float(((a @ b)[:64].double() - exact).abs().max() / exact.abs().max())


def _seconds(a: Tensor, b: Tensor, device: torch.device) -> float:
    """Time of a product; on a CPU that of its processors, so that waiting for other programs does not count."""
    if device.type == "cpu":
        started = time.process_time()
        torch.mm(a, b)
        return (time.process_time() - started) / torch.get_num_threads()
    torch.cuda.synchronize(device)
    started = time.perf_counter()
    torch.mm(a, b)
    torch.cuda.synchronize(device)
    return time.perf_counter() - started


@contextmanager
def _setting(value: str) -> Iterator[None]:
    before = torch.backends.mkldnn.matmul.fp32_precision  # type: ignore[attr-defined]
    _set(value)
    try:
        yield
    finally:
        _set(before)


def _set(value: str) -> None:
    torch.backends.mkldnn.matmul.fp32_precision = value  # type: ignore[attr-defined]
