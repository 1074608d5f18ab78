"""Volume rendering: from densities along a ray to weights, colour, opacity and depth.

Shapes: rays [...], n intervals between n + 1 ray parameters `tdist` [..., n + 1]; `weights` [..., n] say how
much of what a ray sees lies in each interval.
"""

from __future__ import annotations

import torch
from torch import Tensor

from preface.model.safe_math import full_precision, interpolate_sorted, softplus

DENSITY_BIAS = -1.0  # multinerf's; starts a network at softplus(-1) = 0.31 instead of 0.69
COLOR_PADDING = 0.001  # colours reach [-0.001, 1.001], so that 0 and 1 are attained at finite inputs
_FARAWAY_WEIGHT = 1e-10  # decides the depth of a ray that meets nothing, and nothing else


@full_precision
def density_from_raw(raw: Tensor) -> Tensor:
    """Density of a network's output [...]: softplus(raw - 1), per scene unit."""
    return softplus(raw + DENSITY_BIAS)


@full_precision
def color_from_raw(raw: Tensor) -> Tensor:
    """Colour of a network's output [..., 3]: a sigmoid widened to [-0.001, 1.001], sRGB-encoded."""
    return torch.sigmoid(raw) * (1 + 2 * COLOR_PADDING) - COLOR_PADDING


@full_precision
def compute_alpha_weights(
    density: Tensor, tdist: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Turn densities into weights (Max 1995; NeRF, equation 3).

    alpha = 1 - exp(-x) is taken as -expm1(-x): for raw densities below -14 the former is zero in float32.
    An infinite density is a wall if its interval has any length, and nothing if it has none.

    Args:
        density: [..., n], >= 0, per scene unit; inf is allowed.
        tdist: [..., n + 1], ascending ray parameters, finite.
        directions: [..., 3], of any length; t times the direction is in scene units.

    Returns:
        weights: [..., n], share of the ray's light that each interval gives; alpha times trans.
        alpha: [..., n], opacity of each interval.
        trans: [..., n], share of light that reaches each interval.
    """
    lengths = (tdist[..., 1:] - tdist[..., :-1]) * torch.linalg.vector_norm(directions, dim=-1, keepdim=True)
    infinite = density == torch.inf
    depth = torch.where(infinite, 0.0, density) * lengths
    depth = torch.where(infinite & (lengths > 0), torch.inf, depth)
    alpha = -torch.expm1(-depth)
    before = torch.cumsum(depth[..., :-1], dim=-1)
    trans = torch.exp(-torch.cat([torch.zeros_like(depth[..., :1]), before], dim=-1))
    return alpha * trans, alpha, trans


@full_precision
def accumulated_alpha(weights: Tensor) -> Tensor:
    """Opacity [...] of rays: the sum of weights [..., n], which rounding may carry past 1, held at 1."""
    return weights.sum(dim=-1).clamp_max(1.0)


@full_precision
def composite(weights: Tensor, values: Tensor, background: Tensor | float = 0.0) -> Tensor:
    """Blend what a ray meets over a background.

    Args:
        weights: [..., n].
        values: [..., n, c], colours or anything else that blends.
        background: [..., c] or a number; black by default.

    Returns:
        [..., c].
    """
    blended = (weights[..., None] * values).sum(dim=-2)
    return blended + (1 - accumulated_alpha(weights))[..., None] * background


@full_precision
def depth_mean(weights: Tensor, tdist: Tensor) -> Tensor:
    """Geometric mean of the ray parameter over what a ray meets (multinerf's `distance_mean`).

    Args:
        weights: [..., n].
        tdist: [..., n + 1], ray parameters, >= 0.

    Returns:
        [...], between the first and the last ray parameter; the last for a ray that meets nothing.
    """
    middles = (tdist[..., 1:] + tdist[..., :-1]) / 2
    logs = torch.log(middles.clamp_min(torch.finfo(middles.dtype).tiny))
    last = torch.log(tdist[..., -1].clamp_min(torch.finfo(middles.dtype).tiny))
    summed = (weights * logs).sum(dim=-1) + _FARAWAY_WEIGHT * last
    mean = torch.exp(summed / (weights.sum(dim=-1) + _FARAWAY_WEIGHT))
    return torch.minimum(torch.maximum(mean, tdist[..., 0]), tdist[..., -1])


@full_precision
def depth_median(weights: Tensor, tdist: Tensor, far: Tensor) -> Tensor:
    """Ray parameter at which a ray has lost half of its light, the background counted as lying at `far`.

    Args:
        weights: [..., n].
        tdist: [..., n + 1], ascending ray parameters.
        far: [..., 1], >= the last of them.

    Returns:
        [...]; past the last ray parameter where the ray keeps more than half of its light.
    """
    lost = torch.cumsum(weights, dim=-1).clamp_max(1.0)
    lost = torch.cat([torch.zeros_like(lost[..., :1]), lost, torch.ones_like(lost[..., :1])], dim=-1)
    half = torch.full_like(lost[..., :1], 0.5)
    return interpolate_sorted(half, lost, torch.cat([tdist, far], dim=-1))[..., 0]
