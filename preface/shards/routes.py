"""Which way batches are formed on a processor: compiled, where numba is installed, or by torch.

Both give the same batches. numba is optional (`pip install preface[fast]`), and importing it takes a moment,
hence it is looked for when it is first of use.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from types import ModuleType
from typing import NamedTuple


class Route(NamedTuple):
    """A way to form batches.

    Attributes:
        rays: `preface.shards.compiled`, None without numba.
        draws: `preface.shards.compiled_draws`, None without numba.
        name: "compiled by numba <version>", or "torch" and why not the other.
    """

    rays: ModuleType | None
    draws: ModuleType | None
    name: str


@lru_cache(maxsize=1)
def fastest_route() -> Route:
    """The route of this installation, found out once."""
    try:
        numba = import_module("numba")
        rays, draws = (import_module(f"preface.shards.{name}") for name in ("compiled", "compiled_draws"))
        return Route(rays, draws, f"compiled by numba {numba.__version__}")
    except ImportError as error:  # also of a numba that does not go with this numpy
        return Route(None, None, f"torch ({error})")
