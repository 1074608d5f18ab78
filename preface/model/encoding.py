"""The position's encoding as the networks take it: the values of `coord`, written feature by feature.

`coord.project_frustums` and `coord.integrated_pos_enc` have derivatives and define the encoding. Where none by the
rays is asked for, which is everywhere but in cameras that are refined, this is the same in fewer passes over memory:
one row per feature, so that every operation runs along samples, and nothing is copied into place. Normals need
derivatives by position, but not through the waves: a sine's is a cosine, which the encoding holds already.
"""

from __future__ import annotations

import torch
from torch import Tensor

from preface.model import coord
from preface.model.safe_math import full_precision


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


@full_precision
def slope_in_space(encoded: Tensor, slope: Tensor, basis: Tensor, levels: int) -> Tensor:
    """The gradient by position of a function of encodings, from its gradient by the encodings.

    With S = a sin(2^l x) and C = a cos(2^l x), whose attenuation a does not depend on the position x along a direction
    b of the basis, dS/dx = 2^l C and dC/dx = -2^l S. So derivatives of the result, by weights of a network behind
    `slope`, bypass sines and exponentials: second-order gradients cost little more than the products they consist of.

    Args:
        encoded: [p, 2 levels b].
        slope: [p, 2 levels b], what the function's value changes by with each feature.
        basis: [3, b].
        levels: of the encoding.

    Returns:
        [p, 3], per scene unit.
    """
    rows = (2, levels, basis.shape[1], len(encoded))
    sine, cosine = encoded.T.view(rows)
    turned = torch.stack((cosine, -sine)) * coord.powers_of_two(0, levels, encoded)[..., None]
    along = (turned * slope.T.view(rows)).sum(dim=(0, 1))
    return (basis[..., None] * along).sum(dim=1).T  # no product of matrices, whose precision may be reduced
