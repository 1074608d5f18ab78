"""The device that a flag names; apart from `output`, because it needs PyTorch."""

import torch

from preface.cli.usage import UsageError
from preface.model.training.ranks import forbid_tf32


def usable_device(name: str) -> torch.device:
    """A device by its name: cpu, cuda or cuda:N; CUDA computes in float32 from then on.

    Raises:
        UsageError: there is none of that name here.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"--device: {name} cannot be used here ({str(error).splitlines()[0]})") from error
    if device.type == "cuda":
        forbid_tf32()
    return device
