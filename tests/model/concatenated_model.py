"""The model as the paper draws it, slowly: the code concatenated to the input of every layer.

It takes its parameters from a `PriorModel`, so that derivatives land in the same place, and shares with it only
the pure functions. Every ray is rendered, with codes [n, latent] given per ray, in float64 if the model is.
"""

import torch
from torch import Tensor
from torch.nn.functional import linear

from preface.model import coord, losses, stepfun, volume


def with_code(x: Tensor, codes: Tensor) -> Tensor:
    """[n, k, f] and [n, latent] -> [n, k, f + latent]."""
    return torch.cat([x, codes[:, None].expand(-1, x.shape[1], -1)], dim=-1)


def conditioned(layer, x: Tensor, codes: Tensor) -> Tensor:
    return linear(with_code(x, codes), layer.concatenated(), layer.bias)


def trunk(network, encoded: Tensor, codes: Tensor) -> Tensor:
    x = encoded
    for index, layer in enumerate(network.layers):
        x = torch.relu(conditioned(layer, x, codes))
        if index == network.skip:
            x = torch.cat([x, encoded], dim=-1)
    return x


def render(model, rays, codes: Tensor, train_frac: float = 1.0, jitter: Tensor | None = None) -> dict:
    """What rays see against black, with the density's normals; the last round's weights and sdist too."""
    config, nerf, proposal = model.config, model.nerf, model.proposal
    sdist = torch.cat([torch.zeros_like(rays.near), torch.ones_like(rays.far)], -1)
    weights, levels = torch.ones_like(rays.near), []
    expected = 1.0
    for index, samples in enumerate(config.samples):
        if index:
            sdist, weights = stepfun.max_dilate_weights(
                sdist,
                weights,
                config.dilation_bias + config.dilation_multiplier * expected,
                domain=(0.0, 1.0),
                renormalize=True,
            )
            sdist, weights = sdist[..., 1:-1], weights[..., 1:-1]
        anneal = stepfun.anneal_exponent(train_frac, config.anneal_slope)
        logits = stepfun.resampling_logits(sdist, weights, anneal)
        place = None if jitter is None else jitter[:, index : index + 1]
        sdist = stepfun.sample_intervals(sdist, logits, samples, place, (0.0, 1.0)).detach()
        tdist = rays.near + sdist * (rays.far - rays.near)
        expected /= samples
        mean, var = coord.project_frustums(rays.origins, rays.directions, tdist, rays.radii, model.basis)
        last = index == len(config.samples) - 1
        with torch.enable_grad():
            mean = mean.detach().requires_grad_(last)
            encoded = coord.integrated_pos_enc(mean, var, 0, model.levels)
            network = nerf if last else proposal
            features = trunk(network, encoded, codes)
            raw = conditioned(network.density, features, codes)[..., 0]
        weights = volume.compute_alpha_weights(volume.density_from_raw(raw), tdist, rays.directions)[0]
        levels.append((sdist, weights))
    (gradient,) = torch.autograd.grad(raw.sum(), mean, create_graph=True)
    normals = losses.normals_from_density_gradient((gradient[..., None, :] * model.basis).sum(-1))
    bottleneck = conditioned(nerf.bottleneck, features, codes)
    view = coord.pos_enc(rays.viewdirs, 0, config.view_levels)[:, None].expand(-1, bottleneck.shape[1], -1)
    rgb = nerf.color(torch.relu(nerf.view(torch.cat([bottleneck, view], -1))))
    predicted = None
    if nerf.normals is not None:
        predicted = losses.normals_from_density_gradient(conditioned(nerf.normals, features, codes))
    return {
        "rgb": volume.composite(weights, volume.color_from_raw(rgb)),
        "levels": levels,
        "normals": normals,
        "normals_pred": predicted,
    }
