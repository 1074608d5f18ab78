"""Single samples of rays, encoded whatever ray they belong to: what shortcuts that skip samples need.

`preface.model.encoding` encodes all intervals of all rays; here each chosen interval stands by itself.
"""

from __future__ import annotations

import torch
from torch import Tensor

from preface.model import coord, encoding
from preface.model.rays import Rays


@torch.no_grad()
def encode_samples(rays: Rays, tdist: Tensor, chosen: Tensor, basis: Tensor, levels: int) -> Tensor:
    """Encode some intervals of rays, without derivatives.

    Args:
        rays: m of them.
        tdist: [m, k + 1], ascending ray parameters.
        chosen: int64 [p], numbers ray * k + place of the intervals.
        basis: [3, b].
        levels: of the encoding.

    Returns:
        [p, 2 levels b], the chosen rows of `preface.model.encoding.encode_intervals`.
    """
    anchor, offset, t_var, r_var = coord.frustums_about_anchor(tdist, rays.radii)
    axes = coord.project_axes(rays.origins, rays.directions, anchor, basis)
    ray = torch.div(chosen, tdist.shape[1] - 1, rounding_mode="floor")
    middle, along, across = (part.T.contiguous().index_select(1, ray) for part in axes)
    shift, t_var, r_var = (x.reshape(-1).index_select(0, chosen) for x in (offset, t_var, r_var))
    mean = middle.addcmul_(along, shift)
    decay = along.square_().mul_(t_var).addcmul_(across, r_var).mul_(-0.5)
    return encoding.waves(mean, decay, levels).T


@torch.no_grad()
def encode_points(points: Tensor, variance: float, basis: Tensor, levels: int) -> Tensor:
    """Encode positions [p, 3] as Gaussians of one variance along every direction; as `encode_samples`."""
    mean = (basis[..., None] * points.T[:, None]).sum(
        dim=0
    )  # no matrix product, whose precision may be reduced
    return encoding.waves(mean, torch.full_like(mean, -0.5 * variance), levels).T
