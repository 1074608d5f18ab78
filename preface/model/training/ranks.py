"""Several processes that train one model: who they are, and sums over them.

Each process draws its share of a step's groups (`preface.shards.samplers`), and the gradients are added up in one
buffer before they are clipped, so that every process takes the step that a single one would have taken.
DistributedDataParallel averages per-process means instead, which is another loss when shares are unequal, and it
knows nothing of micro-batches; hence one explicit all-reduce.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

# The others wait while the first process renders validation views.
_PATIENCE = timedelta(hours=6)


@dataclass(frozen=True)
class Ranks:
    """The processes of a run: this is number `rank` of `world`."""

    rank: int = 0
    world: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this process writes."""
        return self.rank == 0

    def add_up(self, tensor: Tensor) -> None:
        """Replace a tensor by its sum over all processes."""
        if self.world > 1:
            dist.all_reduce(tensor)

    def copy_from_first(self, tensors: Iterable[Tensor]) -> None:
        """Replace tensors by those of the first process."""
        if self.world > 1:
            for tensor in tensors:
                dist.broadcast(tensor, src=0)

    def any(self, number: int) -> int:
        """The largest of the processes' numbers."""
        if self.world == 1:
            return number
        largest = torch.tensor(number, device="cuda" if dist.get_backend() == "nccl" else "cpu")
        dist.all_reduce(largest, dist.ReduceOp.MAX)
        return int(largest)


@contextlib.contextmanager
def joined_ranks(device: torch.device) -> Iterator[Ranks]:
    """Join the processes that torchrun started, or be the only one.

    Args:
        device: "cuda" uses NCCL, anything else gloo.
    """
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield Ranks()
        return
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=_PATIENCE)
    try:
        yield Ranks(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()


def device_of_rank(wanted: str) -> torch.device:
    """The device of this process: `wanted`, or for "auto" CUDA if there is one; torchrun's local rank picks which.

    Raises:
        ValueError: CUDA is wanted and there is none.
    """
    name = ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted
    if name == "cuda":
        if not torch.cuda.is_available():
            raise ValueError("--device cuda: this PyTorch sees no CUDA device; use --device cpu")
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
        forbid_tf32()
        return device
    return torch.device(name)


def forbid_tf32() -> None:
    """Make CUDA compute float32 products and convolutions in float32, not in TF32 with its ten bits.

    PyTorch allows TF32 to convolutions unless told otherwise. LPIPS is made of those: its figures, and the loss of
    inversion, would be others than on a CPU and than the reference's.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
