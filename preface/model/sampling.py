"""Where along its ray each round looks: near and far, annealing, dilation, resampling.

Mip-NeRF 360's scheme with its linear mapping of s in [0, 1] to t in [near, far]; no contraction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from preface.model import stepfun
from preface.model.configuration import ModelConfig


def sampled_domain(config: ModelConfig, train_frac: float) -> tuple[float, float]:
    """The part of the ray that is sampled, in s: all of it, or less while the near end is annealed."""
    if config.near_anneal_rate <= 0:
        return 0.0, 1.0
    begin = 1 - train_frac / config.near_anneal_rate
    return min(max(begin, 0.0), config.near_anneal_init), 1.0


def first_intervals(like: Tensor, domain: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """One interval over the whole domain, sdist [m, 2] and weights [m, 1], for rays like [m, 1]."""
    sdist = torch.cat([torch.full_like(like, domain[0]), torch.full_like(like, domain[1])], dim=-1)
    return sdist, torch.ones_like(like)


def resampled(
    config: ModelConfig,
    round_index: int,
    sdist: Tensor,
    weights: Tensor,
    train_frac: float = 1.0,
    jitter: Tensor | None = None,
) -> Tensor:
    """Place the intervals of a round by the weights of the round before.

    Args:
        config: of the model.
        round_index: of the round to place, from 0.
        sdist, weights: of the round before, [m, k + 1] and [m, k]; see `first_intervals` for the first.
        train_frac: share of training done, for annealing.
        jitter: [m, 1], where in its share of the mass each sample is taken, in [0, 1); the middle without.

    Returns:
        sdist [m, samples + 1], without derivatives.
    """
    with torch.no_grad():
        domain = sampled_domain(config, train_frac)
        dilation = _dilation(config, config.samples[:round_index], domain)
        if round_index and dilation > 0:
            edges, dilated = stepfun.max_dilate_weights(sdist, weights, dilation, domain, renormalize=True)
            sdist, weights = edges[..., 1:-1], dilated[..., 1:-1]
        anneal = stepfun.anneal_exponent(train_frac, config.anneal_slope)
        logits = stepfun.resampling_logits(sdist, weights, anneal)
        return stepfun.sample_intervals(sdist, logits, config.samples[round_index], jitter, domain)


def _dilation(config: ModelConfig, before: Sequence[int], domain: tuple[float, float]) -> float:
    """How far weights are widened, in s (Mip-NeRF 360, supplement)."""
    expected = (domain[1] - domain[0]) / math.prod(before)
    return config.dilation_bias + config.dilation_multiplier * expected


def ray_parameters(sdist: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """t [m, k + 1] of s in [0, 1]: near at 0, far at 1, linear between, ascending where s is.

    Not s far + (1 - s) near, which rounding makes descend on rays that graze the box.
    """
    return torch.minimum(near + sdist * (far - near), far)
