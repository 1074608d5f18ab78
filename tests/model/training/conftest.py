"""Makes the modules beside the tests importable, and a dataset of ball-shaped heads."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def balls(tmp_path_factory):
    """Three heads to train on and one held out, of six views; not to be changed."""
    import ball_heads

    folder = tmp_path_factory.mktemp("balls")
    ball_heads.write_dataset(folder)
    return folder


@pytest.fixture(autouse=True)
def _one_thread():
    """Sums do not depend on how work is shared out, and the tests' workers use every core already."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
