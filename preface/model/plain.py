"""The model without conditioning and without speed: multinerf's networks, as the yardstick of ours.

It exists to load multinerf's parameters and to be compared, so it is written to be read: concatenation,
`torch.nn.Linear`, no chunking. Layer sizes are those of the parameters that are loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from preface.model import coord, losses, sampling, stepfun, volume

LEVELS = 12  # of the position's encoding
VIEW_LEVELS = 4
SKIP_AFTER = 4  # the encoding is appended to the output of this trunk layer, where there is one


@dataclass(frozen=True, eq=False)
class PlainRays:
    """Rays in scene units: origins, directions, viewdirs [n, 3]; radii, near, far [n, 1]."""

    origins: Tensor
    directions: Tensor
    viewdirs: Tensor
    radii: Tensor
    near: Tensor
    far: Tensor


@dataclass(frozen=True, eq=False)
class Level:
    """One round of sampling: sdist [n, k + 1] in [0, 1], tdist [n, k + 1], density and weights [n, k]."""

    sdist: Tensor
    tdist: Tensor
    density: Tensor
    weights: Tensor


@dataclass(frozen=True, eq=False)
class PlainRender:
    """What rays see.

    Attributes:
        levels: the rounds of sampling, the last of them the NeRF network's.
        rgb: [n, 3].
        acc, distance_mean, distance_median: [n].
        normals, normals_pred: [n, k, 3], of the density and predicted.
    """

    levels: tuple[Level, ...]
    rgb: Tensor
    acc: Tensor
    distance_mean: Tensor
    distance_median: Tensor
    normals: Tensor
    normals_pred: Tensor


class Trunk(nn.Module):
    """Layers with ReLU from an encoded position [..., e] to features, and the density head."""

    def __init__(self, encoding: int, depth: int, width: int):
        super().__init__()
        inputs = [encoding] + [width + (encoding if i == SKIP_AFTER else 0) for i in range(depth)]
        self.layers = nn.ModuleList(nn.Linear(inputs[i], width) for i in range(depth))
        self.density = nn.Linear(inputs[-1], 1)

    def forward(self, encoding: Tensor) -> tuple[Tensor, Tensor]:
        """Return the raw density [...] and the features [..., width]."""
        features = encoding
        for index, layer in enumerate(self.layers):
            features = torch.relu(layer(features))
            if index == SKIP_AFTER:
                features = torch.cat([features, encoding], dim=-1)
        return self.density(features)[..., 0], features


class PlainModel(nn.Module):
    """A proposal network, used for all rounds but the last, and a NeRF network with predicted normals."""

    basis: Tensor

    def __init__(
        self,
        proposal: tuple[int, int],
        nerf: tuple[int, int],
        bottleneck: int,
        view_width: int,
        samples: tuple[int, ...] = (24, 24, 16),
        dilation: tuple[float, float] = (0.0025, 0.5),
    ):
        """Make the layers.

        Args:
            proposal, nerf: depth and width of the trunks.
            bottleneck: width of what the colour sees of the features.
            view_width: width of the view layer.
            samples: intervals per round.
            dilation: absolute, and relative to the expected length of an interval.
        """
        super().__init__()
        basis = coord.icosahedron_basis()
        encoding, features = 2 * LEVELS * basis.shape[1], nerf[1]
        self.samples, self.dilation = samples, dilation
        self.proposal = Trunk(encoding, *proposal)
        self.nerf = Trunk(encoding, *nerf)
        self.normals = nn.Linear(features, 3)
        self.bottleneck = nn.Linear(features, bottleneck)
        self.view = nn.Linear(bottleneck + 3 + 6 * VIEW_LEVELS, view_width)
        self.color = nn.Linear(view_width, 3)
        self.register_buffer("basis", basis, persistent=False)

    def forward(self, rays: PlainRays, train_frac: float = 1.0) -> PlainRender:
        """Render rays against black, deterministically."""
        sdist, weights = torch.cat([torch.zeros_like(rays.near), torch.ones_like(rays.far)], -1), None
        levels: list[Level] = []
        for index in range(len(self.samples)):
            sdist = self._resample(sdist, weights, index, stepfun.anneal_exponent(train_frac)).detach()
            tdist = sampling.ray_parameters(sdist, rays.near, rays.far)
            mean, var = coord.project_frustums(rays.origins, rays.directions, tdist, rays.radii, self.basis)
            last = index == len(self.samples) - 1
            if last:
                raw, features, normals = self._density_and_normals(mean, var)
            else:
                raw, features = self.proposal(coord.integrated_pos_enc(mean, var, 0, LEVELS))
            density = volume.density_from_raw(raw)
            weights = volume.compute_alpha_weights(density, tdist, rays.directions)[0]
            levels.append(Level(sdist, tdist, density, weights))
        return self._render(rays, tuple(levels), features, normals)

    def _resample(self, sdist: Tensor, weights: Tensor | None, index: int, anneal: float) -> Tensor:
        """Place the intervals of a round by the weights of the round before."""
        if weights is None:
            weights = torch.ones_like(sdist[..., 1:])
        else:
            absolute, relative = self.dilation
            expected = 1 / np.prod(self.samples[:index])
            edges, dilated = stepfun.max_dilate_weights(
                sdist, weights, absolute + relative * float(expected), domain=(0.0, 1.0), renormalize=True
            )
            sdist, weights = edges[..., 1:-1], dilated[..., 1:-1]
        logits = stepfun.resampling_logits(sdist, weights, anneal)
        return stepfun.sample_intervals(sdist, logits, self.samples[index], domain=(0.0, 1.0))

    def _density_and_normals(self, mean: Tensor, var: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Evaluate the NeRF trunk and the normals of its density, which keep their graph."""
        with torch.enable_grad():
            mean = mean if mean.requires_grad else mean.requires_grad_()
            raw, features = self.nerf(coord.integrated_pos_enc(mean, var, 0, LEVELS))
            (gradient,) = torch.autograd.grad(raw.sum(), mean, create_graph=True)
        in_space = (gradient[..., None, :] * self.basis).sum(dim=-1)
        return raw, features, losses.normals_from_density_gradient(in_space)

    def _render(
        self, rays: PlainRays, levels: tuple[Level, ...], features: Tensor, normals: Tensor
    ) -> PlainRender:
        last = levels[-1]
        bottleneck = self.bottleneck(features)
        view = coord.pos_enc(rays.viewdirs, 0, VIEW_LEVELS)[..., None, :]
        seen = torch.cat([bottleneck, view.expand(*bottleneck.shape[:-1], -1)], dim=-1)
        rgb = volume.color_from_raw(self.color(torch.relu(self.view(seen))))
        return PlainRender(
            levels=levels,
            rgb=volume.composite(last.weights, rgb),
            acc=volume.accumulated_alpha(last.weights),
            distance_mean=volume.depth_mean(last.weights, last.tdist),
            distance_median=volume.depth_median(last.weights, last.tdist, rays.far),
            normals=normals,
            normals_pred=losses.normals_from_density_gradient(self.normals(features)),
        )


def load_multinerf(arrays: Mapping[str, np.ndarray], prefix: str = "model_param/") -> PlainModel:
    """Build an unconditioned model from multinerf's parameters.

    The trunks' depths follow from the number of layers: PropMLP_0 has the density last, NerfMLP_0 density,
    predicted normals, bottleneck, view layer and colour.

    Args:
        arrays: `{prefix}{NerfMLP_0,PropMLP_0}/Dense_{i}/{kernel,bias}`; kernels are [in, out]. An opened
            npz file will do.
        prefix: what the names begin with.

    Raises:
        KeyError: an array is missing.
        ValueError: the arrays do not have the shapes of such a model.
    """
    nerf, proposal = (_dense_layers(arrays, f"{prefix}{name}") for name in ("NerfMLP_0", "PropMLP_0"))
    if len(nerf) < 6 or len(proposal) < 2:
        raise ValueError(
            f"{prefix}: {len(nerf)} layers of NerfMLP_0 and {len(proposal)} of PropMLP_0; a trunk and its "
            "heads need at least 6 and 2"
        )
    model = PlainModel(
        proposal=(len(proposal) - 1, proposal[0][0].shape[1]),
        nerf=(len(nerf) - 5, nerf[0][0].shape[1]),
        bottleneck=nerf[-3][0].shape[1],
        view_width=nerf[-2][0].shape[1],
    )
    heads = [model.nerf.density, model.normals, model.bottleneck, model.view, model.color]
    ours = [*model.proposal.layers, model.proposal.density, *model.nerf.layers, *heads]
    for layer, (kernel, bias) in zip(ours, [*proposal, *nerf], strict=True):
        if tuple(layer.weight.shape) != kernel.T.shape or tuple(layer.bias.shape) != bias.shape:
            raise ValueError(
                f"{prefix}: a kernel of shape {kernel.shape} stands where {tuple(layer.weight.T.shape)} "
                "is expected; these are not the parameters of an unconditioned model with predicted normals"
            )
        layer.weight.data.copy_(torch.from_numpy(kernel.T.copy()))
        layer.bias.data.copy_(torch.from_numpy(bias.copy()))
    return model


def _dense_layers(arrays: Mapping[str, np.ndarray], name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernel [in, out] and bias [out] of the layers of one network, in order."""
    count = sum(key.startswith(f"{name}/") and key.endswith("/kernel") for key in arrays)
    return [(arrays[f"{name}/Dense_{i}/kernel"], arrays[f"{name}/Dense_{i}/bias"]) for i in range(count)]
