"""Rays rendered with shortcuts: the model's own networks, asked only where the answer can be seen.

Four questions, each cheaper than the next: does a ray meet anything (`_met`), where along it may light stop
(`_proposed`, `_placed`), which of those samples matter (`_chosen`), and which of them show a colour or a normal
(`_colors`, `_normals`). Samples that are left out count as transparent; those without a colour, as black.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from preface.model import coord, encoding, losses, sampling, stepfun, volume
from preface.model.configuration import ModelConfig
from preface.model.folded import fold
from preface.model.levels import with_levels
from preface.model.matmul import Precision, choose_route
from preface.model.model import Level, PriorModel, Render
from preface.model.networks import Products
from preface.model.rays import Rays
from preface.model.rendering.image import SEEN, RenderRays, Space
from preface.model.rendering.mesh import model_field
from preface.model.rendering.occupancy import Occupancy, learn_occupancy
from preface.model.rendering.samples import encode_samples
from preface.model.rendering.shortcuts import Shortcuts
from preface.model.safe_math import interpolate_sorted

SAMPLES_AT_A_TIME = (
    16_384  # in the last round's network, so that memory goes with this and not with the batch
)
GRANULE = 1024  # samples; see `_rounded`

Histogram = tuple[Tensor, Tensor]  # sdist [m, k + 1] and weights [m, k]


def accelerated(
    model: PriorModel,
    code: Tensor | None,
    space: Space,
    shortcuts: Shortcuts,
    background: float,
    normals: bool,
) -> RenderRays:
    """As `preface.model.rendering.shortcuts.accelerate`."""
    if (code is None) != (model.config.latent == 0):
        given = "none" if code is None else f"one of {len(code)} numbers"
        raise ValueError(f"code: {given} was given to a model with codes of {model.config.latent}")
    model = _within_the_box(model)
    if shortcuts.matmul:
        shortcuts = dataclasses.replace(shortcuts, matmul=precision_of(model, shortcuts))
    if code is not None and shortcuts != Shortcuts():
        model, code = fold(model, code), None
    if shortcuts.changes_model:
        model = _changed(model, shortcuts)
    if not shortcuts.skips:
        return _whole(model, code, background, normals, shortcuts.predicted_normals)
    grid = None
    if shortcuts.occupancy:
        side = float((space.box.maximum - space.box.minimum).max()) * space.scale / shortcuts.occupancy
        density, device = model_field(model, None, side).density, model.basis.device
        grid = learn_occupancy(density, space, shortcuts.occupancy, shortcuts.empty_alpha, device)
    return ShortRenderer(model, grid, shortcuts, space.scale, background, normals)


def precision_of(model: PriorModel, shortcuts: Shortcuts) -> Precision:
    """The precision in which a model's products are formed with shortcuts, on the device where it is."""
    if shortcuts.matmul != "bf16":
        return shortcuts.matmul or model.config.matmul
    return _fastest_precision(model.basis.device.type, model.config.nerf.width)


@functools.cache
def _fastest_precision(device: str, width: int) -> Precision:
    """The precision in which layers of a width are multiplied fastest by a kind of device, found by trying, once.

    A processor without products of bfloat16 makes them from others, several times more slowly than float32's. On
    other devices they are the fastest.
    """
    if device != "cpu":
        return "bf16"
    half, full = (choose_route(precision, device, width).gflops for precision in ("bf16", "fp32"))
    return "bf16" if half > full else "fp32"


def _within_the_box(model: PriorModel) -> PriorModel:
    """The same networks, whose density outside the box counts as zero (the paper, for the final rendering).

    A prior that was trained between planes has a background of its own there, for the cameras that it was trained
    with; seen by others it would stand before the head.
    """
    shown = copy.copy(model)
    shown.config = model.config.within_the_box()
    return shown


def _whole(
    model: PriorModel, code: Tensor | None, background: float, normals: bool, predicted: bool
) -> RenderRays:
    def render(rays: Rays) -> Render:
        with torch.no_grad():
            seen = model(rays, None if code is None else code[None], background=background, normals=normals)
        instead = predicted and seen.normals_pred is not None
        return dataclasses.replace(seen, normals=None) if instead else seen

    return render


@dataclass(frozen=True, eq=False)
class ShortRenderer:
    """Renders rays with a folded model and, if asked for, a grid.

    Attributes:
        model: without codes.
        grid: of its density; None renders without one.
        shortcuts: which.
        scale: scene units per metre.
        background: grey value behind the head.
        normals: whether to find them.
    """

    model: PriorModel
    grid: Occupancy | None
    shortcuts: Shortcuts
    scale: float
    background: float
    normals: bool

    @torch.no_grad()
    def __call__(self, rays: Rays) -> Render:
        """What rays see; `levels` has the last round only, of the rays that met something.

        Rays go through the networks some at a time, whatever is given together.
        """
        met, some, bounds = self._met(rays)
        usual = max(1, SAMPLES_AT_A_TIME // self._samples(self.shortcuts.sample_share))
        parts = [slice(begin, begin + usual) for begin in range(0, max(len(met), 1), usual)]
        seen = [self._seen(some[part], None if bounds is None else bounds[part]) for part in parts]
        level, color, normals, predicted = (_joined(values) for values in zip(*seen, strict=True))
        rgb = volume.composite(level.weights, color, self.background)
        mean = volume.depth_mean(level.weights, level.tdist)
        median = volume.depth_median(level.weights, level.tdist, rays.far.index_select(0, met))
        far = rays.far[:, 0]
        return Render(
            (level,),
            torch.full_like(rays.origins, self.background).index_copy(0, met, rgb),
            torch.zeros_like(far).index_copy(0, met, volume.accumulated_alpha(level.weights)),
            far.index_copy(0, met, mean),
            far.index_copy(0, met, median),
            normals,
            predicted,
            met,
        )

    def _seen(self, rays: Rays, bounds: Tensor | None) -> tuple[Level, Tensor, Tensor | None, Tensor | None]:
        """The last round of rays, colours [m, k, 3], and normals of either kind."""
        histogram = self._proposed(rays, bounds)
        sdist = self._placed(rays, histogram)
        tdist = sampling.ray_parameters(sdist, rays.near, rays.far)
        chosen = self._chosen(sdist, tdist, histogram)
        biases = self.model.nerf.biases(None, None, 1)
        encoded = encode_samples(rays, tdist, chosen, self.model.basis, self.model.levels)
        features = self.model.nerf.trunk(encoded, biases, self.model.products)
        raw = self.model.nerf.raw_density(features, biases[len(self.model.nerf.layers)])
        density = _spread(volume.density_from_raw(raw), chosen, tdist[:, 1:].shape)
        weights = volume.compute_alpha_weights(density, tdist, rays.directions)[0]
        color = self._colors(rays, weights, chosen, features, biases)
        normals = self._normals(rays, tdist, weights, chosen, features, biases)
        return Level(sdist, tdist, density, weights), color, *normals

    def _samples(self, share: float) -> int:
        """Of the last round, per ray."""
        return max(1, round(share * self.model.config.samples[-1]))

    def _met(self, rays: Rays) -> tuple[Tensor, Rays, Tensor | None]:
        """The rays that meet the box and an occupied cube: their numbers, themselves, and bounds of their weights.

        They begin where they enter the first occupied cube and end where they leave the last, unless the bounds
        take the place of proposals and say so by themselves.
        """
        every = torch.arange(len(rays), device=rays.near.device)
        met = every if rays.hit is None else every[rays.hit[:, 0]]
        some = rays[met]
        if self.grid is None:
            return met, some, None
        cubes = self.grid.cubes(some)
        occupied = self.grid.meets(cubes)
        kept = occupied.any(dim=1).nonzero()[:, 0]
        met, some, cubes, occupied = met[kept], some[kept], cubes[kept], occupied[kept]
        if self.shortcuts.skipped_rounds:
            return met, some, self.grid.weight_bounds(some, cubes)
        ahead, behind = (_first(x) for x in (occupied, occupied.flip(1)))
        piece = (some.far - some.near) / self.grid.steps
        near, far = some.near + ahead * piece, torch.minimum(some.far, some.far - behind * piece)
        return met, dataclasses.replace(some, near=torch.minimum(near, far), far=far), None

    def _proposed(self, rays: Rays, bounds: Tensor | None) -> Histogram:
        """Where light stops, as far as it is known without the NeRF network."""
        config, model = self.model.config, self.model
        rounds = len(config.samples) - 1
        if bounds is None:
            histogram = sampling.first_intervals(rays.near, sampling.sampled_domain(config, 1.0))
        else:
            steps = bounds.shape[1]
            edges = torch.arange(steps + 1, device=bounds.device) / steps
            histogram = edges.expand(len(rays), -1), bounds
        biases = model.proposal.biases(None, None, 1)
        for index in range(min(self.shortcuts.skipped_rounds, rounds), rounds):
            sdist = self._resampled(histogram, index, config.samples[index], bounds is not None)
            tdist = sampling.ray_parameters(sdist, rays.near, rays.far)
            every = torch.arange(tdist[:, 1:].numel(), device=tdist.device)
            encoded = encode_samples(rays, tdist, every, model.basis, model.levels)
            density = volume.density_from_raw(model.proposal(encoded, biases, model.products))
            density = density.view(tdist[:, 1:].shape)
            weights = volume.compute_alpha_weights(density, tdist, rays.directions)[0]
            histogram, bounds = (sdist, weights), None
        return histogram

    def _resampled(self, histogram: Histogram, index: int, samples: int, bounded: bool) -> Tensor:
        """sdist of a round: as the model places it, but that bounds need no dilation."""
        sdist, weights = histogram
        if not bounded:
            config = _with_samples(self.model.config, index, samples)
            return sampling.resampled(config, index, sdist, weights)
        logits = stepfun.resampling_logits(sdist, weights)
        return stepfun.sample_intervals(sdist, logits, samples, domain=(0.0, 1.0))

    def _placed(self, rays: Rays, histogram: Histogram) -> Tensor:
        """sdist [m, k + 1] of the last round; rays with fewer samples end in intervals without length."""
        config, shortcuts = self.model.config, self.shortcuts
        last = len(config.samples) - 1
        usual, fewer = self._samples(shortcuts.sample_share), self._samples(shortcuts.short_share)
        bounded = shortcuts.skipped_rounds >= last and self.grid is not None
        if fewer >= usual:
            return self._resampled(histogram, last, usual, bounded)
        sdist, weights = histogram
        lengths = (rays.far - rays.near) * rays.directions.norm(dim=-1, keepdim=True)
        extent = _extent(weights, (sdist[:, 1:] - sdist[:, :-1]) * lengths)
        short = extent < shortcuts.short * self.scale
        found = sdist.new_empty((len(sdist), usual + 1))
        for which, samples in ((short, fewer), (~short, usual)):
            part = which.nonzero()[:, 0]
            placed = self._resampled((sdist[part], weights[part]), last, samples, bounded)
            found[part] = torch.cat([placed, placed[:, -1:].expand(-1, usual - samples)], dim=1)
        return found

    def _chosen(self, sdist: Tensor, tdist: Tensor, histogram: Histogram) -> Tensor:
        """Numbers int64 [p] of the intervals that have a length, and may have weight enough."""
        matters = tdist[:, 1:] > tdist[:, :-1]
        if self.shortcuts.weight_bound > 0 and histogram[1].shape[1] > 1:
            summed = pad(histogram[1].cumsum(dim=-1), (1, 0))
            reached = interpolate_sorted(sdist, histogram[0], summed)
            matters &= (reached[:, 1:] - reached[:, :-1]) > self.shortcuts.weight_bound
        return _rounded(matters.view(-1).nonzero()[:, 0])

    def _colors(
        self, rays: Rays, weights: Tensor, chosen: Tensor, features: Tensor, biases: list[Tensor]
    ) -> Tensor:
        """Colours [m, k, 3] of the chosen samples whose weight is more than nothing; zero elsewhere."""
        nerf = self.model.nerf
        lit = _rounded((weights.view(-1)[chosen] > self.shortcuts.color_bound).nonzero()[:, 0])
        chosen, features = chosen[lit], features[lit]
        ray = torch.div(chosen, weights.shape[1], rounding_mode="floor")
        view = coord.pos_enc(rays.viewdirs, 0, self.model.config.view_levels)[ray]
        raw = nerf.raw_color(features, biases[len(nerf.layers) + 1], view, self.model.products)
        return _spread(volume.color_from_raw(raw), chosen, weights.shape)

    def _normals(
        self,
        rays: Rays,
        tdist: Tensor,
        weights: Tensor,
        chosen: Tensor,
        features: Tensor,
        biases: list[Tensor],
    ) -> tuple[Tensor | None, Tensor | None]:
        """Normals [m, k, 3] of the density or, in their place, predicted; zero where they are not looked for."""
        if not self.normals:
            return None, None
        nerf, model = self.model.nerf, self.model
        if self.shortcuts.opaque_normals:
            opaque = (volume.accumulated_alpha(weights) > SEEN)[:, None]
            shown = opaque & (weights > self.shortcuts.color_bound)
            wanted = _rounded(shown.view(-1)[chosen].nonzero()[:, 0])
            chosen, features = chosen[wanted], features[wanted]
        if self.shortcuts.predicted_normals and nerf.normals is not None:
            raw = nerf.raw_normals(features, biases[len(nerf.layers) + 2])
            return None, _spread(losses.normals_from_density_gradient(raw), chosen, weights.shape)
        encoded = encode_samples(rays, tdist, chosen, model.basis, model.levels)
        with torch.enable_grad():
            again = nerf.trunk(encoded.requires_grad_(), biases, model.products)
            total = nerf.raw_density(again, biases[len(nerf.layers)]).sum()
            (slope,) = torch.autograd.grad(total, encoded)
        in_space = encoding.slope_in_space(encoded.detach(), slope, model.basis, model.levels)
        return _spread(losses.normals_from_density_gradient(in_space), chosen, weights.shape), None


def _changed(model: PriorModel, shortcuts: Shortcuts) -> PriorModel:
    """A copy of a folded model with products of another precision, or without its highest levels."""
    changed = with_levels(model, min(shortcuts.levels or model.levels, model.levels))
    changed.config = dataclasses.replace(changed.config, matmul=shortcuts.matmul or model.config.matmul)
    changed.products = Products(changed.config.matmul)
    return changed


def _with_samples(config: ModelConfig, index: int, samples: int) -> ModelConfig:
    counts = [*config.samples]
    counts[index] = samples
    return dataclasses.replace(config, samples=tuple(counts))


def _spread(values: Tensor, chosen: Tensor, shape: torch.Size) -> Tensor:
    """Values [p, ...] of the chosen intervals among all of them [m, k, ...]; zero elsewhere."""
    every = values.new_zeros((shape.numel(), *values.shape[1:]))
    return every.index_copy_(0, chosen, values).view(*shape, *values.shape[1:])


def _extent(weights: Tensor, lengths: Tensor) -> Tensor:
    """How far a histogram [m, k] reaches, [m]: of n bins with equal weights and lengths, n lengths."""
    tiny = torch.finfo(weights.dtype).tiny
    squares = (weights * weights / lengths.clamp_min(tiny)).sum(dim=-1)
    return weights.sum(dim=-1) ** 2 / squares.clamp_min(tiny)


def _rounded(chosen: Tensor) -> Tensor:
    """Numbers, the last repeated until they are a multiple of `GRANULE`.

    Tensors of ever new sizes would leave ever new holes in the memory that the process keeps, which would then grow
    with the image. To do a sample twice changes nothing.
    """
    missing = -len(chosen) % GRANULE
    return torch.cat([chosen, chosen[-1:].expand(missing)]) if len(chosen) else chosen


def _joined(values: Sequence[Any]) -> Any:
    """Levels or tensors of the parts of a batch, one after the other; None where there is none."""
    first = values[0]
    if first is None or len(values) == 1:
        return first
    if isinstance(first, Level):
        names = (field.name for field in dataclasses.fields(Level))
        return Level(*(torch.cat([getattr(value, name) for value in values]) for name in names))
    return torch.cat(list(values))


def _first(occupied: Tensor) -> Tensor:
    """Number [m, 1] of the first True."""
    return occupied.to(torch.uint8).argmax(dim=1, keepdim=True)
