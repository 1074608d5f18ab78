"""Ball-shaped heads as in the tests of training, a prior of three of them, and a head that it has not seen."""

import sys
from pathlib import Path

import pytest
import torch

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "training")]


@pytest.fixture(scope="session")
def balls(tmp_path_factory):
    """Three heads to train on and one held out, of six views; not to be changed."""
    import ball_heads

    folder = tmp_path_factory.mktemp("balls")
    ball_heads.write_dataset(folder)
    return folder


@pytest.fixture(scope="session")
def prior(balls, tmp_path_factory):
    """A prior of the three; not to be changed."""
    import small_fits

    folder = tmp_path_factory.mktemp("prior") / "prior"
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    small_fits.train(balls, folder)
    torch.set_num_threads(threads)
    return folder


@pytest.fixture
def data(balls):
    """The views of the unseen head that are fitted to."""
    import small_fits

    from preface.model.fitting.observations import observe
    from preface.shards import Dataset

    with Dataset(balls) as dataset:
        yield observe(dataset, small_fits.UNSEEN, small_fits.VIEWS, None)


@pytest.fixture
def correction(data):
    """None yet, of the second and the fifth camera."""
    from preface.geometry import Box
    from preface.model.fitting.cameras import CameraCorrections
    from preface.model.fitting.heads import Correction

    rows = torch.tensor([-1, 0, -1, -1, 1, -1])
    box = Box(data.scene.box[0], data.scene.box[1])
    return Correction(CameraCorrections(2), rows, box, data.scene.scene_scale)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    """Sums do not depend on how work is shared out, and the tests' workers use every core already."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
