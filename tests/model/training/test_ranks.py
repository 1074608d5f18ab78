"""The device of a process, and that it computes in float32."""

import pytest
import torch

from preface.model.training.ranks import device_of_rank


@pytest.fixture
def cuda(monkeypatch):
    """A machine with CUDA, as far as a choice of devices can tell, and PyTorch's own settings."""
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = True
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: None)
    yield
    torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = before


@pytest.mark.usefixtures("cuda")
@pytest.mark.parametrize(("wanted", "exact"), [("auto", True), ("cuda", True), ("cpu", False)])
def test_cuda_convolutions_and_products_are_not_rounded_to_tf32(wanted, exact, monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "2")
    device = device_of_rank(wanted)
    assert device == torch.device("cuda:2" if exact else "cpu")
    assert torch.backends.cudnn.allow_tf32 is not exact
    assert torch.backends.cuda.matmul.allow_tf32 is not exact
