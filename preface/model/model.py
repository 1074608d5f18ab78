"""The identity-conditioned Mip-NeRF 360: rays and codes in, colours, opacities, depths and normals out.

Encodings, places of samples, weights and compositing are float32 whatever surrounds them; the products inside
the networks are what `ModelConfig.matmul` says. Memory goes with rays times samples times widths: callers cut
batches into chunks and add gradients up (`preface.model.training.trainer.Options.micro_rays`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from preface.model import coord, encoding, losses, sampling, volume
from preface.model.configuration import ConfigurationError, ModelConfig
from preface.model.networks import NerfNetwork, Products, ProposalNetwork
from preface.model.rays import Rays


@dataclass(frozen=True, eq=False)
class Level:
    """One round: sdist [m, k + 1] in [0, 1], tdist [m, k + 1], density and weights [m, k]."""

    sdist: Tensor
    tdist: Tensor
    density: Tensor
    weights: Tensor


@dataclass(frozen=True, eq=False)
class Render:
    """What n rays see, m of which were evaluated.

    Attributes:
        levels: the rounds, the last of them the NeRF network's, for the rays evaluated.
        rgb: [n, 3].
        acc: [n], opacity.
        distance_mean, distance_median: [n], in ray parameters; `far` of rays that were not evaluated.
        normals: [m, k, 3], of the density; None where not asked for.
        normals_pred: [m, k, 3], predicted; None without the head, or where not asked for.
        evaluated: int64 [m], the rays evaluated; None where all were.
    """

    levels: tuple[Level, ...]
    rgb: Tensor
    acc: Tensor
    distance_mean: Tensor
    distance_median: Tensor
    normals: Tensor | None = None
    normals_pred: Tensor | None = None
    evaluated: Tensor | None = None

    @property
    def share(self) -> float:
        """m/n: what a mean over evaluated rays is to be multiplied with for the mean over all."""
        return len(self.levels[-1].weights) / max(len(self.rgb), 1)


class PriorModel(nn.Module):
    """A proposal network, used for every round but the last, a NeRF network, and the codes of identities."""

    basis: Tensor

    def __init__(self, config: ModelConfig, identities: int):
        """Make the networks and the codes.

        Args:
            config: with `levels` as a number (`ModelConfig.resolved`).
            identities: how many codes; 0 if they are kept elsewhere.

        Raises:
            ConfigurationError: `levels` is still `auto`.
        """
        super().__init__()
        if not isinstance(config.levels, int):
            raise ConfigurationError(
                "levels: 'auto' depends on the photographs; call resolved(smallest_radius) first"
            )
        self.config, self.levels = config, config.levels
        basis = coord.icosahedron_basis()
        features = 2 * self.levels * basis.shape[1]
        view = 3 + 6 * config.view_levels
        self.proposal = ProposalNetwork(features, config.proposal, config.latent)
        self.nerf = NerfNetwork(
            features,
            config.nerf,
            config.latent,
            config.bottleneck,
            (view, config.view_width),
            config.predicted_normals,
        )
        self.codes = nn.Parameter(config.code_std * torch.randn(identities, config.latent))
        self.products = Products(config.matmul)
        self.register_buffer("basis", basis, persistent=False)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The parameters by network, for clipping as multinerf does: one norm for each group."""
        return {
            "proposal": list(self.proposal.parameters()),
            "nerf": list(self.nerf.parameters()),
            "codes": [self.codes],
        }

    def forward(
        self,
        rays: Rays,
        code: Tensor | None = None,
        group: Tensor | None = None,
        *,
        train_frac: float = 1.0,
        jitter: Tensor | None = None,
        background: Tensor | float | None = None,
        normals: bool = False,
    ) -> Render:
        """Render rays.

        Args:
            rays: n of them.
            code: [g, latent]; None for a model without codes.
            group: int64 [n], row of `code` per ray; None if rays are g equal runs, one after the other.
            train_frac: share of training done, for annealing.
            jitter: [n, rounds] in [0, 1), where each ray's samples lie in their intervals; None for the
                middle, which makes the result a function of rays and parameters.
            background: [n, 3] or a number, behind the model; black by default.
            normals: whether to find the density's normals and, by the head that predicts them, those.

        Raises:
            ValueError: codes that do not fit the model or the rays.
        """
        group = self._groups(len(rays), code, group)
        evaluated = None
        if self.config.clip_to_box and rays.hit is not None and not bool(rays.hit.all()):
            evaluated = rays.hit[:, 0].nonzero()[:, 0]
        some = rays if evaluated is None else rays[evaluated]
        if evaluated is not None:
            group = None if group is None else group[evaluated]
            jitter = None if jitter is None else jitter[evaluated]
        levels, sdist, tdist = self._found(some, code, group, train_frac, jitter)
        biases = self.nerf.biases(code, group, len(some))
        features, raw, found = self._final(some, tdist, biases, normals)
        levels = (*levels, self._level(some, sdist, tdist, raw))
        depth = len(self.nerf.layers)
        view = coord.pos_enc(some.viewdirs, 0, self.config.view_levels)
        color = self.nerf.raw_color(features, biases[depth + 1], view, self.products)
        predicted = None
        if self.nerf.normals is not None and found is not None:
            predicted = self.nerf.raw_normals(features, biases[depth + 2]).view(found.shape)
            predicted = losses.normals_from_density_gradient(predicted)
        return _assemble(rays, some, evaluated, levels, color, background, (found, predicted))

    def rounds(
        self, rays: Rays, code: Tensor | None = None, *, jitter: Tensor | None = None
    ) -> tuple[Level, ...]:
        """Where rays find something, without its colour: what teaches proposals alone.

        Args:
            rays: n of them, all evaluated.
            code: [1, latent]; None for a model without codes.
            jitter: [n, rounds], see `forward`.

        Returns:
            The rounds, as `Render.levels`; no derivative reaches the NeRF network.

        Raises:
            ValueError: codes that do not fit the model.
        """
        group = self._groups(len(rays), code, None)
        levels, sdist, tdist = self._found(rays, code, group, 1.0, jitter)
        with torch.no_grad():
            biases = self.nerf.biases(code, group, len(rays))
            raw = self._final(rays, tdist, biases, normals=False)[1]
        return (*levels, self._level(rays, sdist, tdist, raw))

    def _found(
        self, rays: Rays, code: Tensor | None, group: Tensor | None, train_frac: float, jitter: Tensor | None
    ) -> tuple[tuple[Level, ...], Tensor, Tensor]:
        """All rounds but the last, and where that one looks."""
        biases = self.proposal.biases(code, group, len(rays))
        levels = self._propose(rays, biases, train_frac, jitter)
        return levels, *self._place(rays, levels, len(self.config.samples) - 1, train_frac, jitter)

    def _groups(self, rays: int, code: Tensor | None, group: Tensor | None) -> Tensor | None:
        """The row of `code` per ray; None if there is but one, or none."""
        if (code is None) != (self.config.latent == 0):
            raise ValueError(f"code: a model with latent {self.config.latent} was given {_shape(code)}")
        if code is None:
            return None
        if code.dim() != 2 or code.shape[1] != self.config.latent:
            raise ValueError(
                f"code: {_shape(code)} where [identities, {self.config.latent}] is expected; a single code "
                "is code[None]"
            )
        if group is not None:
            if group.shape != (rays,):
                raise ValueError(f"group: {_shape(group)} for {rays} rays")
            return group
        if len(code) == 1:
            return None
        if rays % max(len(code), 1):
            raise ValueError(f"group: {rays} rays are not {len(code)} equal runs; say which code each has")
        return torch.arange(len(code), device=code.device).repeat_interleave(rays // max(len(code), 1))

    def _propose(
        self, rays: Rays, biases: Sequence[Tensor], train_frac: float, jitter: Tensor | None
    ) -> tuple[Level, ...]:
        """All rounds but the last."""
        levels: tuple[Level, ...] = ()
        for index in range(len(self.config.samples) - 1):
            sdist, tdist = self._place(rays, levels, index, train_frac, jitter)
            raw = self.proposal(self._encode(rays, tdist), biases, self.products)
            levels = (*levels, self._level(rays, sdist, tdist, raw))
        return levels

    def _place(
        self, rays: Rays, levels: tuple[Level, ...], index: int, train_frac: float, jitter: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Where a round looks, sdist and tdist."""
        if levels:
            sdist, weights = levels[-1].sdist, levels[-1].weights
        else:
            sdist, weights = sampling.first_intervals(
                rays.near, sampling.sampled_domain(self.config, train_frac)
            )
        place = None if jitter is None else jitter[:, index : index + 1]
        sdist = sampling.resampled(self.config, index, sdist, weights, train_frac, place)
        return sdist, sampling.ray_parameters(sdist, rays.near, rays.far)

    def _encode(self, rays: Rays, tdist: Tensor) -> Tensor:
        return encoding.encode_intervals(
            rays.origins, rays.directions, tdist, rays.radii, self.basis, self.levels
        )

    def _moving_encoding(self, rays: Rays, tdist: Tensor) -> Tensor:
        """As `_encode`, with derivatives by the rays."""
        mean, var = coord.project_frustums(rays.origins, rays.directions, tdist, rays.radii, self.basis)
        return coord.integrated_pos_enc(mean, var, 0, self.levels).flatten(0, 1)

    def _level(self, rays: Rays, sdist: Tensor, tdist: Tensor, raw: Tensor) -> Level:
        density = volume.density_from_raw(raw.view(tdist[:, 1:].shape))
        weights = volume.compute_alpha_weights(density, tdist, rays.directions)[0]
        return Level(sdist, tdist, density, weights)

    def _final(
        self, rays: Rays, tdist: Tensor, biases: Sequence[Tensor], normals: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Features, raw density and, if wanted, the normals of the density, of the last round.

        Derivatives reach rays that ask for them (cameras that are refined) through this round alone.
        """
        head = biases[len(self.nerf.layers)]
        moving = torch.is_grad_enabled() and (rays.origins.requires_grad or rays.directions.requires_grad)
        encoded = self._moving_encoding(rays, tdist) if moving else self._encode(rays, tdist)
        keep = torch.is_grad_enabled()
        with torch.enable_grad() if normals else contextlib.nullcontext():
            if normals and not moving:
                encoded.requires_grad_()
            features = self.nerf.trunk(encoded, biases, self.products)
            raw = self.nerf.raw_density(features, head)
            if not normals:
                return features, raw, None
            (slope,) = torch.autograd.grad(raw.sum(), encoded, create_graph=keep)
        given = encoded if moving else encoded.detach()
        in_space = encoding.slope_in_space(given, slope, self.basis, self.levels)
        found = losses.normals_from_density_gradient(in_space).view(*tdist[:, 1:].shape, 3)
        return (features, raw, found) if keep else (features.detach(), raw.detach(), found)


def _assemble(
    rays: Rays,
    some: Rays,
    evaluated: Tensor | None,
    levels: tuple[Level, ...],
    color: Tensor,
    background: Tensor | float | None,
    normals: tuple[Tensor | None, Tensor | None],
) -> Render:
    """Composite, and put the rays that were evaluated back among those that were not."""
    last = levels[-1]
    color = volume.color_from_raw(color.view(*last.weights.shape, 3))
    behind: Tensor | float = 0.0 if background is None else background
    part = behind[evaluated] if isinstance(behind, Tensor) and evaluated is not None else behind
    rgb = volume.composite(last.weights, color, part)
    acc = volume.accumulated_alpha(last.weights)
    mean = volume.depth_mean(last.weights, last.tdist)
    median = volume.depth_median(last.weights, last.tdist, some.far)
    if evaluated is not None:
        empty = torch.zeros_like(rays.origins) + behind
        far = rays.far[:, 0]
        rgb = empty.index_copy(0, evaluated, rgb)
        acc = torch.zeros_like(far).index_copy(0, evaluated, acc)
        mean, median = far.index_copy(0, evaluated, mean), far.index_copy(0, evaluated, median)
    return Render(levels, rgb, acc, mean, median, *normals, evaluated)


def _shape(tensor: Tensor | None) -> str:
    return "none" if tensor is None else f"a tensor {list(tensor.shape)}"
