"""One set of formulas for numpy and torch, through the Python array API standard.

Torch is never imported here: a torch tensor brings its own namespace along.
"""

from typing import Any

import numpy as np
from array_api_compat import array_namespace, device, is_array_api_obj

# A numpy.ndarray or a torch.Tensor on any device. The two share no static type.
Array = Any


def floating(values: Array) -> Array:
    """Return floating-point arrays as they are; lists and whole numbers become float64 numpy arrays."""
    if not is_array_api_obj(values):
        return np.asarray(values, dtype=np.float64)
    xp = array_namespace(values)
    return values if xp.isdtype(values.dtype, "real floating") else xp.astype(values, xp.float64)


def matching(values: np.ndarray, reference: Array) -> Array:
    """Return a copy of `values` with the library, dtype and device of `reference`."""
    xp = array_namespace(reference)
    return xp.asarray(np.array(values), dtype=reference.dtype, device=device(reference))


def on_cpu(values: Array) -> bool:
    """Whether asking for a value of this array is free; on an accelerator it would wait for the device."""
    return str(device(values)) == "cpu"


def rotate(rotation: Array, vectors: Array) -> Array:
    """Rotate vectors [..., 3] by matrices [..., 3, 3] that broadcast against them.

    Written as a sum of columns: a matrix product would be rounded to TF32 on GPUs that are allowed to.
    """
    return (
        rotation[..., :, 0] * vectors[..., 0:1]
        + rotation[..., :, 1] * vectors[..., 1:2]
        + rotation[..., :, 2] * vectors[..., 2:3]
    )
