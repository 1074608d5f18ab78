"""How rays of the shards become a loss of the prior: the render of a part, and what is asked of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from preface.model import losses
from preface.model.model import PriorModel, Render
from preface.model.rays import Rays
from preface.model.training.configuration import TrainingConfig
from preface.model.training.trainer import LossTerm, Part
from preface.shards import Batch
from preface.shards.streams import bits, stream_key

_JITTER = 101  # what this stream of random numbers is for; see preface.shards.streams


def jitter(seed: int, step: int, first: int, rays: int, rounds: int, stream: int = _JITTER) -> np.ndarray:
    """Where samples lie within their intervals, float32 [rays, rounds] in [0, 1).

    A pure function of the seed, the step and the ray's number in it, however rays are split into parts and
    over processes. Another `stream` gives other numbers.
    """
    drawn = bits(stream_key(seed, step, stream), first * rounds, rays * rounds)
    return ((drawn >> np.uint64(40)).astype(np.float32) * np.float32(2.0**-24)).reshape(rays, rounds)


def target_colors(batch: Batch, background: str) -> Tensor:
    """What rays should see, [n, 3]: the photograph, on black if the background is black.

    Rays that miss the box should then see black whatever is there: a model within the box has no part in it.
    """
    return batch.rgb * (batch.alpha * batch.hit) if background == "black" else batch.rgb


def rays_of(batch: Batch, model: PriorModel, planes: Tensor, views: int) -> Rays:
    """The rays of a batch: between the faces of the box, or the planes of their view if that is not modelled.

    Args:
        batch: of n rays.
        model: says which.
        planes: [N * V, 2], near and far of each view, scene units.
        views: V.
    """
    if model.config.clip_to_box:
        return Rays.from_batch(batch)
    return Rays.from_batch(batch, planes[batch.identity * views + batch.view])


def renderer(
    model: PriorModel, rows: Tensor, planes: Tensor, views: int, seed: int, steps: int
) -> Callable[[Part], Render]:
    """Render parts of a step with the codes of their identities.

    Args:
        model: trained.
        rows: int64 [N], row of `codes` of each identity of the dataset.
        planes, views: as `rays_of` takes them.
        seed, steps: of the run.
    """
    rounds = len(model.config.samples)

    def render(part: Part) -> Render:
        batch = part.batch
        noise = torch.from_numpy(jitter(seed, part.step, part.first, len(batch), rounds))
        return model(
            rays_of(batch, model, planes, views),
            model.codes[rows[batch.identity[:: part.group]]],
            train_frac=part.step / max(steps - 1, 1),
            jitter=noise.to(batch.origins.device),
        )

    return render


def interlevel(render: Render, part: Part) -> Tensor:
    """The mean over all rays of the interlevel loss; those that miss the box have none."""
    last = render.levels[-1]
    proposals = ((level.sdist, level.weights) for level in render.levels[:-1])
    return losses.interlevel(last.sdist, last.weights, proposals) * render.share


def prior_terms(background: str, config: TrainingConfig) -> list[LossTerm]:
    """The prior's objective (the paper, equation 2, and opacity if asked for), and what is measured beside it."""
    terms = [*color_terms(background), LossTerm("interlevel", config.interlevel, interlevel)]
    return [*terms, LossTerm("opacity", config.opacity, opacity)] if config.opacity > 0 else terms


def opacity(render: Render, part: Part) -> Tensor:
    """The mean absolute difference between opacity and mask; rays that miss the box have neither."""
    return losses.l1(render.acc, (part.batch.alpha * part.batch.hit)[:, 0])


def color_terms(background: str) -> list[LossTerm]:
    """The mean absolute difference of colours, and what the PSNR of rays that meet the box is computed from."""

    def l1(render: Render, part: Part) -> Tensor:
        return losses.l1(render.rgb, target_colors(part.batch, background))

    def squared(render: Render, part: Part) -> Tensor:
        error = (render.rgb - target_colors(part.batch, background)) ** 2
        return (error.mean(dim=-1) * part.batch.hit[:, 0]).mean()

    def hit(render: Render, part: Part) -> Tensor:
        return part.batch.hit.float().mean()

    found: list[tuple[str, float, Any]] = [
        ("l1", 1.0, l1),
        ("squared_error", 0.0, squared),
        ("hit", 0.0, hit),
    ]
    return [LossTerm(*one) for one in found]
