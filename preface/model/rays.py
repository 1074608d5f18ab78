"""Rays as the model takes them, from a batch of the shards or from anywhere else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from preface.shards import Batch


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in scene units (canonical metres times `scene_scale`), float32.

    Attributes:
        origins: [n, 3].
        directions: [n, 3], of any length; t times the direction is in scene units.
        viewdirs: [n, 3], of length one.
        radii: [n, 1], of the pixel's cone at t = 1.
        near, far: [n, 1], the t between which the ray is sampled, 0 <= near <= far.
        hit: bool [n, 1], whether the ray meets the box; None where all do.
    """

    origins: Tensor
    directions: Tensor
    viewdirs: Tensor
    radii: Tensor
    near: Tensor
    far: Tensor
    hit: Tensor | None = None

    def __len__(self) -> int:
        return len(self.origins)

    @staticmethod
    def from_batch(batch: Batch, planes: Tensor | None = None) -> Rays:
        """The rays of a batch whose loader has `scale` = the dataset's `scene_scale`.

        Args:
            batch: of n rays.
            planes: [n, 2], near and far depths to use in place of the box's faces, for a model that is not
                clipped to the box.
        """
        near, far = (batch.near, batch.far) if planes is None else (planes[:, :1], planes[:, 1:])
        return Rays(batch.origins, batch.directions, batch.viewdirs, batch.radii, near, far, batch.hit)

    def __getitem__(self, part: slice | Tensor) -> Rays:
        """Some of the rays: a slice, or an index int64 [m]."""
        return self._each(lambda x: x[part] if isinstance(part, slice) else x.index_select(0, part))

    def to(self, device: torch.device | str) -> Rays:
        """The same on another device."""
        return self._each(lambda x: x.to(device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> Rays:
        values: dict[str, Any] = {}
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            values[name] = None if value is None else change(value)
        return Rays(**values)
