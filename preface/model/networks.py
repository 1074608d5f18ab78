"""The proposal and the NeRF network, conditioned on a code in every layer at next to no cost.

In the paper the code z is concatenated to the input x of every layer: y = W [x, z] + b. With W = [W_x, W_z]
that is W_x x + (W_z z + b), and the bracket is the same for all samples of an identity: it is computed once
per code (`CodeLinear.weight` is W_x, `CodeLinear.code_weight` W_z) and added as a bias. The tests keep the
concatenated form beside it.

Shapes: m rays with k samples each, p = m k positions, ray after ray; biases [m, features] are per ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from preface.model.configuration import NetworkConfig


class CodeLinear(nn.Module):
    """A linear layer of [x, code], kept as two weights: [out, in] for x and [out, latent] for the code."""

    def __init__(self, inputs: int, outputs: int, latent: int):
        """Make weights that are uniform as multinerf's (He et al. 2015, over all inputs), and zero biases."""
        super().__init__()
        limit = math.sqrt(6 / (inputs + latent))
        self.weight = nn.Parameter(torch.empty(outputs, inputs).uniform_(-limit, limit))
        self.code_weight = nn.Parameter(torch.empty(outputs, latent).uniform_(-limit, limit))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def concatenated(self) -> Tensor:
        """The weight [out, in + latent] of the layer as the paper writes it."""
        return torch.cat([self.weight, self.code_weight], dim=1)


def code_biases(layers: Sequence[CodeLinear], code: Tensor | None) -> Tensor:
    """What a code adds to the outputs of layers, and their biases, [g, sum of outputs] for codes [g, latent]."""
    bias = torch.cat([layer.bias for layer in layers])
    if code is None:
        return bias[None]
    return torch.addmm(bias, code, torch.cat([layer.code_weight for layer in layers]).T)


def add_per_ray(y: Tensor, bias: Tensor) -> Tensor:
    """Add the biases of rays [m, out] to their positions' y [m k, out], in place."""
    if len(bias):
        y.view(len(bias), -1, bias.shape[1]).add_(bias[:, None])
    return y


class Products:
    """Matrix products in the precision of their arguments, or in bfloat16 with float32 sums."""

    def __init__(self, matmul: Literal["fp32", "bf16"]):
        self._reduced = torch.bfloat16 if matmul == "bf16" else None

    def __call__(self, x: Tensor, weight: Tensor) -> Tensor:
        """x [p, in] times weight [out, in] transposed."""
        return torch.mm(self._cast(x), self._cast(weight).T)

    def hidden(self, x: Tensor, weight: Tensor, bias: Tensor, beside: tuple[Tensor, Tensor] | None) -> Tensor:
        """A layer with ReLU [p, out].

        Args:
            x: [p, in].
            weight: [out, in].
            bias: [m, out], of rays with p/m positions each.
            beside: a second input [p, e] and its weight [out, e].
        """
        y = self(x, weight)
        if beside is not None:
            y = torch.addmm(y, self._cast(beside[0]), self._cast(beside[1]).T)
        return self.biased(y, bias).relu_()

    def biased(self, y: Tensor, bias: Tensor) -> Tensor:
        """Add the biases of rays [m, out] to their positions' y [p, out], in place."""
        return add_per_ray(y, self._cast(bias))

    def _cast(self, values: Tensor) -> Tensor:
        return values if self._reduced is None else values.to(self._reduced)


class Trunk(nn.Module):
    """Layers with ReLU from an encoded position to features, and the density head."""

    def __init__(self, encoding: int, config: NetworkConfig, latent: int):
        super().__init__()
        width, skip = config.width, config.skip
        inputs = [encoding] + [
            width + (encoding if index == skip else 0) for index in range(config.depth - 1)
        ]
        self.skip, self.width = skip, width
        self.layers = nn.ModuleList(CodeLinear(n, width, latent) for n in inputs)
        # Appended after the last layer too, where that is the skip's, as multinerf does.
        self.features = width + (encoding if skip == config.depth - 1 else 0)
        self.density = CodeLinear(self.features, 1, latent)

    def trunk_layers(self) -> list[CodeLinear]:
        """The layers of the trunk, in order."""
        return [layer for layer in self.layers if isinstance(layer, CodeLinear)]

    def conditioned(self) -> list[CodeLinear]:
        """The layers that see the code, in the order of their biases."""
        return [*self.trunk_layers(), self.density]

    def biases(self, code: Tensor | None, group: Tensor | None, rays: int) -> list[Tensor]:
        """Biases [rays, out] of each layer, for rays with codes `code[group]`, or one code without a group."""
        layers = self.conditioned()
        together = code_biases(layers, code)
        each = together.expand(rays, -1) if group is None else together.index_select(0, group)
        return list(each.split([len(layer.bias) for layer in layers], dim=1))

    def trunk(self, encoding: Tensor, biases: Sequence[Tensor], products: Products) -> Tensor:
        """Features [p, features] of encodings [p, e]."""
        features = encoding
        for index, (layer, bias) in enumerate(zip(self.trunk_layers(), biases, strict=False)):
            weight: Tensor = layer.weight
            beside = None
            if index and index == self.skip + 1:
                beside, weight = (encoding, weight[:, self.width :]), weight[:, : self.width]
            features = products.hidden(features, weight, bias, beside)
        if self.features > self.width:
            features = torch.cat([features, encoding.to(features)], dim=-1)
        return features

    def raw_density(self, features: Tensor, bias: Tensor) -> Tensor:
        """Density before its activation, float32 [p], of features [p, features]; bias: [m, 1], of the head."""
        raw = torch.mv(features.to(self.density.weight), self.density.weight[0])
        return add_per_ray(raw[:, None], bias)[:, 0]


class ProposalNetwork(Trunk):
    """Density alone."""

    def forward(self, encoding: Tensor, biases: Sequence[Tensor], products: Products) -> Tensor:
        """Raw density [p] of encodings [p, e]."""
        return self.raw_density(self.trunk(encoding, biases, products), biases[len(self.layers)])


class NerfNetwork(Trunk):
    """Density, colour by direction, and, if asked for, predicted normals."""

    def __init__(
        self,
        encoding: int,
        config: NetworkConfig,
        latent: int,
        bottleneck: int,
        view: tuple[int, int],
        normals: bool,
    ):
        """Make the layers; view: inputs and width of the layer that sees the direction."""
        super().__init__(encoding, config, latent)
        self.bottleneck = CodeLinear(self.features, bottleneck, latent)
        self.view = nn.Linear(bottleneck + view[0], view[1])
        self.color = nn.Linear(view[1], 3)
        self.normals = CodeLinear(self.features, 3, latent) if normals else None
        for layer in (self.view, self.color):
            limit = math.sqrt(6 / layer.in_features)
            nn.init.uniform_(layer.weight, -limit, limit)
            nn.init.zeros_(layer.bias)

    def conditioned(self) -> list[CodeLinear]:
        """The layers that see the code, in the order of their biases."""
        normals = [] if self.normals is None else [self.normals]
        return [*super().conditioned(), self.bottleneck, *normals]

    def raw_color(self, features: Tensor, bias: Tensor, view: Tensor, products: Products) -> Tensor:
        """Colour before its activation, float32 [p, 3].

        Args:
            features: [p, features].
            bias: [m, bottleneck], of the bottleneck.
            view: [m, v], encoded directions.
            products: in which precision.
        """
        bottleneck = bias.shape[1]
        seen = products.biased(products(features, self.bottleneck.weight), bias)
        # The direction is the same along a ray, so it too becomes a bias.
        direction = torch.addmm(self.view.bias, view, self.view.weight[:, bottleneck:].T)
        hidden = products.hidden(seen, self.view.weight[:, :bottleneck], direction, None)
        return torch.addmm(self.color.bias, hidden.to(self.color.weight), self.color.weight.T)

    def raw_normals(self, features: Tensor, bias: Tensor) -> Tensor:
        """The predicted density gradient, float32 [p, 3]; bias: [m, 3], of the head."""
        assert self.normals is not None
        return add_per_ray(torch.mm(features.to(self.normals.weight), self.normals.weight.T), bias)
