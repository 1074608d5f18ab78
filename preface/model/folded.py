"""A model for one code: the code folded into plain biases, with the same call but without a code."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from preface.model.model import PriorModel
from preface.model.networks import CodeLinear, Trunk


def fold(model: PriorModel, code: Tensor) -> PriorModel:
    """Build the unconditioned model that renders what `model` renders with a code.

    Args:
        model: with codes.
        code: [latent].

    Returns:
        A model with `latent` 0 and no codes, on the same device; its parameters are copies.

    Raises:
        ValueError: a code of another length.
    """
    if code.shape != (model.config.latent,):
        raise ValueError(f"code: {list(code.shape)} where [{model.config.latent}] is expected")
    plain = PriorModel(dataclasses.replace(model.config, latent=0), 0).to(code.device)
    with torch.no_grad():
        for ours, theirs in ((plain.proposal, model.proposal), (plain.nerf, model.nerf)):
            _fold(ours, theirs, code)
        for name in ("view", "color"):
            getattr(plain.nerf, name).load_state_dict(getattr(model.nerf, name).state_dict())
    return plain


def _fold(plain: Trunk, conditioned: Trunk, code: Tensor) -> None:
    for ours, theirs in zip(plain.conditioned(), conditioned.conditioned(), strict=True):
        ours.weight.copy_(theirs.weight)
        ours.bias.copy_(_folded_bias(theirs, code))


def _folded_bias(layer: CodeLinear, code: Tensor) -> Tensor:
    return torch.addmv(layer.bias, layer.code_weight, code)
