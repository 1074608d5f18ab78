"""A batch of rays with their colours: what a trainer gets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from preface.shards.rays import RayBuffers, RayTable, form_rays

_FIELDS = {
    "origins": (3, torch.float32),
    "directions": (3, torch.float32),
    "viewdirs": (3, torch.float32),
    "radii": (1, torch.float32),
    "near": (1, torch.float32),
    "far": (1, torch.float32),
    "rgba": (4, torch.float32),
    "identity": (1, torch.int64),
    "view": (1, torch.int64),
    "hit": (1, torch.bool),
}
_FLAT = ("identity", "view")  # [n], and not [n, 1]
# One allocation per batch that is always of the same size, which an allocator gives back warm.
_ALIGNMENT = 64


@dataclass(frozen=True, eq=False)
class Batch:
    """Rays about the canonical origin, in metres times the `scale` of the loader.

    All fields live on one device and share one allocation; nothing else refers to it.

    Attributes:
        origins: float32 [n, 3], camera centres.
        directions: float32 [n, 3], of depth one: near, far and sample positions are depths.
        viewdirs: float32 [n, 3], of length one.
        radii: float32 [n, 1], of the cone at depth one (multinerf's: 2/sqrt(12) times the pixel's footprint).
        near, far: float32 [n, 1], where the ray enters and leaves the identity's box; of a ray that misses it,
            the depths between which the box lies in front of that camera.
        rgba: float32 [n, 4], sRGB-encoded colours and foreground share in [0, 1]: the stored byte / 255.
        identity: int64 [n], index into the dataset's identities.
        view: int64 [n], index into that identity's views.
        hit: bool [n, 1], whether the ray meets the box.
    """

    origins: Tensor
    directions: Tensor
    viewdirs: Tensor
    radii: Tensor
    near: Tensor
    far: Tensor
    rgba: Tensor
    identity: Tensor
    view: Tensor
    hit: Tensor

    @property
    def rgb(self) -> Tensor:
        """Colours [n, 3], not premultiplied; a view of `rgba`."""
        return self.rgba[:, :3]

    @property
    def alpha(self) -> Tensor:
        """Foreground shares [n, 1]; a view of `rgba`."""
        return self.rgba[:, 3:]

    def __len__(self) -> int:
        return len(self.origins)

    def to(self, device: torch.device) -> Batch:
        """The same on another device."""
        return Batch(**{name: getattr(self, name).to(device) for name in _FIELDS})

    @staticmethod
    def empty(rays: int, device: torch.device) -> Batch:
        """A batch with room for rays, not filled."""
        spaces, end = [], 0
        for columns, dtype in _FIELDS.values():
            spaces.append(end)
            end += math.ceil(rays * columns * dtype.itemsize / _ALIGNMENT) * _ALIGNMENT
        buffer = torch.empty(end, dtype=torch.uint8, device=device)
        # A view per type, and a field out of it at once: each call of torch takes as long as forming dozens of rays.
        typed = {dtype: buffer.view(dtype) for dtype in (torch.float32, torch.int64, torch.bool)}
        fields = {}
        for begin, (name, (columns, dtype)) in zip(spaces, _FIELDS.items(), strict=True):
            size, stride = ((rays,), (1,)) if name in _FLAT else ((rays, columns), (columns, 1))
            fields[name] = typed[dtype].as_strided(size, stride, begin // dtype.itemsize)
        return Batch(**fields)


def form_batch(
    table: RayTable, identity: Tensor, view: Tensor, views: int, pixel: Tensor, rgba: Tensor
) -> Batch:
    """Form a batch from pixels that were gathered; `preface.shards.compiled` has the compiled twin.

    Args:
        table: of all views of the dataset, identity by identity.
        identity, view: int64 [G].
        views: V of the dataset.
        pixel: int64 [G, P], raster indices.
        rgba: int32 [G, P], the pixels' four bytes.

    Returns:
        A batch of G * P rays on the table's device.
    """
    device = table.device
    identity, view = identity.to(device), view.to(device)
    batch = Batch.empty(pixel.numel(), device)
    rays = RayBuffers(
        batch.origins, batch.directions, batch.viewdirs, batch.radii, batch.near, batch.far, batch.hit
    )
    form_rays(table, identity * views + view, pixel.to(device), rays)
    batch.identity.view(pixel.shape).copy_(identity[:, None])
    batch.view.view(pixel.shape).copy_(view[:, None])
    channels = rgba.reshape(-1).view(torch.uint8).to(device)
    batch.rgba.view(-1).copy_(channels).div_(255)
    return batch
