"""The device of a flag."""

import pytest
import torch

from preface.cli.devices import usable_device
from preface.cli.usage import UsageError


@pytest.fixture
def settings():
    """PyTorch's own, also afterwards."""
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = True
    yield
    torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = before


@pytest.mark.usefixtures("settings")
@pytest.mark.parametrize(("name", "allowed"), [("cpu", True), ("cuda", False), ("cuda:1", False)])
def test_figures_are_not_rounded_to_tf32_on_cuda(name, allowed, monkeypatch):
    monkeypatch.setattr(torch, "empty", lambda *_, **__: None)  # as if there were one
    assert usable_device(name) == torch.device(name)
    assert torch.backends.cudnn.allow_tf32 is allowed


@pytest.mark.parametrize("name", ["cuda:77", "gpu"])
def test_a_device_that_is_not_there_is_named(name):
    with pytest.raises(UsageError, match=f"--device: {name} cannot be used here"):
        usable_device(name)
