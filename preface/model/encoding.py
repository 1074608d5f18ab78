"""The position's encoding as the networks take it: the values of `coord`, written feature by feature.

`coord.project_frustums` and `coord.integrated_pos_enc` have derivatives and define the encoding. Where no
derivative by position is asked for, which is everywhere but in normals, this is the same in fewer passes over
memory: one row per feature, so that every operation runs along samples, and nothing is copied into place.
"""

from __future__ import annotations

import torch
from torch import Tensor

from preface.model import coord


@torch.no_grad()
def encode_intervals(
    origins: Tensor, directions: Tensor, tdist: Tensor, radii: Tensor, basis: Tensor, levels: int
) -> Tensor:
    """Encode the intervals of rays, without derivatives.

    Args:
        origins, directions: [m, 3], scene units.
        tdist: [m, k + 1], ascending ray parameters.
        radii: [m, 1], of the cones at t = 1.
        basis: [3, b].
        levels: of the encoding.

    Returns:
        [m k, 2 levels b]: all sines, level by level, then all cosines; a transposed view, contiguous along
        samples, which matrix products take as it is.
    """
    anchor, offset, t_var, r_var = coord.frustums_about_anchor(tdist, radii)
    axes = coord.project_axes(origins, directions, anchor, basis)
    middle, along, across = (x.T.contiguous()[:, :, None] for x in axes)  # [b, m, 1]
    mean = middle + along * offset
    decay = (along * along) * t_var
    decay.add_(across * r_var).mul_(-0.5)
    return waves(mean.flatten(1), decay.flatten(1), levels).T


def waves(angles: Tensor, decay: Tensor, levels: int) -> Tensor:
    """exp(4^l decay) sin and cos of 2^l angles, [2 levels b, p] of [b, p]; the arguments are overwritten."""
    rows = angles.new_empty((2, levels, *angles.shape))
    attenuation = torch.empty_like(angles)
    for sine, cosine in zip(rows[0], rows[1], strict=True):
        torch.exp(decay, out=attenuation)
        torch.sin(angles, out=sine).mul_(attenuation)
        torch.cos(angles, out=cosine).mul_(attenuation)
        angles.mul_(2)  # exact, as by four
        decay.mul_(4)
    return rows.flatten(0, 2)
