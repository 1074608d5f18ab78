"""A model with more or fewer levels of the position's encoding than it was trained with.

Fewer, and it renders faster and smoother; more, and it can learn finer detail than the images that it was trained on
could show. Weights of new levels are zero: the model renders what it did, and learns them from there.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from preface.model.model import PriorModel
from preface.model.networks import Trunk


def with_levels(model: PriorModel, levels: int) -> PriorModel:
    """A copy of a model with so many levels of the encoding, the lowest of which are its own.

    Args:
        model: on any device, where the copy will be too.
        levels: 0 to 16.

    Raises:
        ConfigurationError: another number of levels.
    """
    config = dataclasses.replace(model.config, levels=levels)
    found = PriorModel(config, len(model.codes)).to(model.basis.device)
    values = model.state_dict()
    for name, network in (("proposal", model.proposal), ("nerf", model.nerf)):
        for key in _sees_encoding(network):
            weight = values[f"{name}.{key}"]
            values[f"{name}.{key}"] = _with_columns(weight, model.levels, levels, model.basis.shape[1])
    found.load_state_dict(values)
    return found


def _with_columns(weight: Tensor, known: int, levels: int, directions: int) -> Tensor:
    """A weight [out, in] whose last inputs are the encoding: sines, then cosines, each level by level."""
    others = weight.shape[1] - 2 * known * directions
    before = weight[:, others:].view(len(weight), 2, known, directions)
    after = before.new_zeros((len(weight), 2, levels, directions))
    kept = min(known, levels)
    after[:, :, :kept] = before[:, :, :kept]
    return torch.cat([weight[:, :others], after.flatten(1)], dim=1)


def _sees_encoding(network: Trunk) -> list[str]:
    """The weights whose last inputs are the encoded position."""
    names = ["layers.0.weight"]
    if network.skip + 1 < len(network.layers):
        names.append(f"layers.{network.skip + 1}.weight")
    if network.features > network.width:
        names += [
            f"{head}.weight" for head in ("density", "bottleneck", "normals") if getattr(network, head, None)
        ]
    return names
