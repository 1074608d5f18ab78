"""Proposals, taught where no photograph was taken.

A few views say where a head is along their own rays, and the interlevel loss teaches proposals no more than that: after
long finetuning they miss surfaces that other views see, though the density knows them. So some rays of each step are
turned about the head and rendered once more, without colours, and the density teaches the proposals there, too. The
density itself learns nothing from these rays. Not in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from preface.geometry import Box
from preface.model import losses
from preface.model.fitting.cameras import rays_between_faces, rotated
from preface.model.fitting.heads import code_of
from preface.model.model import PriorModel, Render
from preface.model.rays import Rays
from preface.model.training.prior_loss import jitter
from preface.model.training.trainer import Part

_TURN = math.pi  # rays turn about the vertical axis by at most this much, either way: all around
_TILT = math.radians(20)  # and before that up or down
_STREAM = 102  # what this stream of random numbers is for; see preface.shards.streams


def interlevel_elsewhere(
    model: PriorModel, box: Box, scale: float, share: float, seed: int
) -> Callable[[Render, Part], Tensor]:
    """The interlevel loss of rays between and beyond the views, as a term of the trainer.

    Args:
        model: a head; only its proposal network receives gradients.
        box: canonical frame, metres.
        scale: scene units per metre.
        share: of the rays of a step, in (0, 1], that are turned and rendered again.
        seed: of the turns and of the places of samples.

    Returns:
        The term: a mean over the turned rays, of which those that miss the box have none.
    """
    rounds = len(model.config.samples)

    def interlevel(render: Render, part: Part) -> Tensor:
        batch = part.batch
        device = batch.origins.device
        drawn = torch.from_numpy(jitter(seed, part.step, part.first, len(batch), rounds + 2, _STREAM)).to(
            device
        )
        chosen = _chosen(part, share).nonzero()[:, 0].to(device)
        drawn = drawn[chosen]
        rays = turned_about(Rays.from_batch(batch)[chosen], 2 * drawn[:, :2] - 1, box, scale)
        assert rays.hit is not None
        met = rays.hit[:, 0].nonzero()[:, 0]
        *proposals, last = model.rounds(rays[met], code_of(model), jitter=drawn[met, 2:])
        known = ((level.sdist, level.weights) for level in proposals)
        return losses.interlevel(last.sdist, last.weights, known) * (len(met) / (share * len(batch)))

    return interlevel


def _chosen(part: Part, share: float) -> Tensor:
    """Which rays of a part are turned, bool [n]: evenly spread by their numbers in the step, however it is cut."""
    numbers = torch.arange(part.first, part.first + len(part.batch) + 1, dtype=torch.float64)
    return (numbers * share).floor().diff() > 0


def turned_about(rays: Rays, turns: Tensor, box: Box, scale: float) -> Rays:
    """Rays as cameras elsewhere around the box would see them.

    Args:
        rays: n of them, scene units.
        turns: [n, 2] in [-1, 1]: share of half a turn about the vertical axis, and of the largest tilt.
        box: canonical frame, metres, about whose centre they are turned.
        scale: scene units per metre.

    Returns:
        Rays with `near`, `far` and `hit` as `Box.intersect` gives them; those that miss the box keep near and far.
    """
    centre = torch.as_tensor((box.minimum + box.maximum) / 2 * scale).to(rays.origins)
    none = torch.zeros_like(turns[:, 0])
    tilt = torch.stack([_TILT * turns[:, 1], none, none], dim=-1)
    turn = torch.stack([none, _TURN * turns[:, 0], none], dim=-1)

    def moved(vectors: Tensor) -> Tensor:
        return rotated(turn, rotated(tilt, vectors))

    origins, directions = moved(rays.origins - centre) + centre, moved(rays.directions)
    return rays_between_faces(rays, origins, directions, moved(rays.viewdirs), box, scale)
