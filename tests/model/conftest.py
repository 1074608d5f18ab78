"""Makes the slow references importable, and opens the figures of independent programs once."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

GOLDEN = Path(os.environ.get("PREFACE_GOLDEN") or HERE.parent / "data" / "multinerf_seed11.npz")


@pytest.fixture(scope="session")
def golden_arrays() -> dict[str, np.ndarray]:
    """Inputs and outputs of multinerf, by the keys of the file."""
    with np.load(GOLDEN) as file:
        return dict(file)


@pytest.fixture(scope="session")
def golden(golden_arrays: dict[str, np.ndarray]) -> Callable[[str], torch.Tensor]:
    """The same as tensors."""
    return lambda key: torch.from_numpy(golden_arrays[key])
