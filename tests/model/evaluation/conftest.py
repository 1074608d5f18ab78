"""Ball-shaped heads to evaluate: photographs whose every pixel is known in closed form, and models of them."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "training"))

from preface.shards import Dataset


@pytest.fixture(scope="session")
def shards(tmp_path_factory) -> Path:
    """Four balls in six views of 24x32, the last one held out; not to be changed."""
    import ball_heads

    folder = tmp_path_factory.mktemp("balls")
    ball_heads.write_dataset(folder)
    return folder


@pytest.fixture(scope="session")
def dataset(shards):
    """The same, opened."""
    with Dataset(shards) as opened:
        yield opened


@pytest.fixture(scope="session")
def prior(tmp_path_factory) -> Path:
    """A prior of three of them that held out a view of each; not to be changed."""
    import untrained

    names = ["id0000", "id0001", "id0002"]
    held_out = {name: (f"camera{number + 1}",) for number, name in enumerate(names)}
    return untrained.write_model(tmp_path_factory.mktemp("prior"), names, held_out)


@pytest.fixture
def head(tmp_path) -> Callable[..., Path]:
    """A function that writes a head of `id0000` which was fitted to some of its views."""
    import untrained

    def make(name: str, views, seed=0, **model) -> Path:
        fit = untrained.fitted_to(views)
        return untrained.write_model(tmp_path / name, ["id0000"], fit=fit, seed=seed, **model)

    return make


@pytest.fixture(autouse=True)
def _one_thread():
    """The tests' workers use every core already."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
