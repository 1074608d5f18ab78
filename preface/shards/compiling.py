"""How the loops of this package are compiled: by numba, once per machine.

Importing this needs numba, which is optional: `preface.shards.routes` says whether it is there. Compiling takes
seconds; the result is kept where numba keeps such things. No fast-math: nothing is reordered or fused.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numba
from numba import types

# Division by zero is infinite, and not an exception.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# A function that compiled ones call.
stage = numba.njit(**_OPTIONS)
# Flat arrays, by their type. Inputs are not to be written to; arrays that may be are taken, too.
input_of = partial(types.Array, ndim=1, layout="C", readonly=True)
output_of = partial(types.Array, ndim=1, layout="C")


def compiled_for(function: Callable[..., None], *arguments: types.Type) -> Callable[..., None]:
    """Compile a function for arguments, or take what was compiled before."""
    signature = types.void(*arguments)
    try:
        return numba.njit(signature, cache=True, **_OPTIONS)(function)
    except (RuntimeError, OSError):
        # No folder to keep it in can be written to, or the disk is full; then it is compiled each time.
        return numba.njit(signature, **_OPTIONS)(function)
