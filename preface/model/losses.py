"""The terms of the training objectives, each a mean over rays in float32.

Weights of the terms are the trainer's. A batch without rays costs nothing and has zero gradients.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from preface.model import stepfun
from preface.model.safe_math import full_precision, normalize


def _mean(values: Tensor) -> Tensor:
    """Mean of all elements, and 0 in place of 0/0 where there are none."""
    return values.sum() / max(values.numel(), 1)


@full_precision
def l1(rendered: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of colours [..., 3] (the paper, equation 2, L_recon)."""
    return _mean((rendered - target).abs())


def interlevel(sdist: Tensor, weights: Tensor, proposals: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
    """Pull proposals up until they bound the final weights (Mip-NeRF 360, equation 13; L_prop).

    Only the proposals receive gradients.

    Args:
        sdist, weights: of the last level, [..., n + 1] and [..., n].
        proposals: the same of each earlier level, with any number of intervals.

    Returns:
        A scalar: the sum over levels of the mean over rays and intervals.
    """
    sdist, weights = sdist.detach(), weights.detach()
    total = weights.new_zeros((), dtype=torch.promote_types(weights.dtype, torch.float32))
    for proposal_sdist, proposal_weights in proposals:
        total = total + _mean(
            stepfun.lossfun_outer(sdist, weights, proposal_sdist.detach(), proposal_weights)
        )
    return total


@full_precision
def normals_from_density_gradient(gradient: Tensor) -> Tensor:
    """Unit normals [..., 3] against the density's gradient [..., 3]; zero where the density is flat.

    The gradient may be of the density before its activation, which has the same direction and does not
    vanish where the activation is flat (Ref-NeRF, equation 11). For `predicted_normal` to reach the
    density, the gradient has to be taken with `create_graph=True` and not be detached.
    """
    return -normalize(gradient)


@full_precision
def predicted_normal_per_ray(weights: Tensor, normals: Tensor, predicted: Tensor) -> Tensor:
    """Disagreement [...] of predicted normals with those of the density (Ref-NeRF, equation 12).

    sum_i w_i (1 - n_i . n'_i), as multinerf evaluates it: equal to the half squared distance for unit
    vectors, and 1 where the density is flat and has no normal.

    Args:
        weights: [..., n].
        normals, predicted: [..., n, 3]. Both, and the weights, receive gradients.
    """
    return (weights * (1 - (normals * predicted).sum(dim=-1))).sum(dim=-1)


def predicted_normal(weights: Tensor, normals: Tensor, predicted: Tensor) -> Tensor:
    """Mean over rays of `predicted_normal_per_ray` (the paper's L_normal)."""
    return _mean(predicted_normal_per_ray(weights, normals, predicted))


@full_precision
def orientation(weights: Tensor, normals: Tensor, viewdirs: Tensor) -> Tensor:
    """Penalise visible normals that face away from the camera (Ref-NeRF, equation 10); not in the paper.

    Args:
        weights: [..., n].
        normals: [..., n, 3], unit.
        viewdirs: [..., 3], unit, from the camera into the scene.

    Returns:
        A scalar, the mean over rays of sum_i w_i max(0, n_i . d)^2.
    """
    away = (normals * viewdirs[..., None, :]).sum(dim=-1).clamp_min(0)
    return _mean((weights * away * away).sum(dim=-1))


@full_precision
def view_weight_penalty(view_layer_weight: Tensor, view_features: int = 27) -> Tensor:
    """Squared norm of the weights through which the view direction acts (the paper's L_v).

    Args:
        view_layer_weight: [out, in] of the linear layer whose last inputs are the encoded direction.
        view_features: how many inputs those are; 27 for 4 levels and the direction itself.

    Raises:
        ValueError: the layer has fewer inputs than that.
    """
    if not 0 < view_features <= view_layer_weight.shape[-1]:
        raise ValueError(
            f"view_features: {view_features} inputs of a layer with {view_layer_weight.shape[-1]} cannot be "
            "the encoded direction; pass the weight [out, in] of the view layer"
        )
    columns = view_layer_weight[..., -view_features:]
    return (columns * columns).sum()
