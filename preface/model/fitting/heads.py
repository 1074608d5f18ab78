"""The model of one head: the prior's networks and one code, or random weights and none; and how its rays are rendered.

A head is rendered between the faces of the box and in front of black, whatever its prior was: that is what the masked
views that it is fitted to show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from preface.geometry import Box
from preface.model.configuration import ModelConfig
from preface.model.fitting.cameras import CameraCorrections
from preface.model.model import PriorModel, Render
from preface.model.rays import Rays
from preface.model.training.prior_loss import jitter
from preface.model.training.trainer import Part


def head_of_prior(prior: PriorModel, code: Tensor) -> PriorModel:
    """The prior's networks with one code [latent]; a copy."""
    head = PriorModel(prior.config.within_the_box(), 1).to(code.device)
    head.load_state_dict({**prior.state_dict(), "codes": code[None]})
    return head


def head_from_scratch(model: ModelConfig, seed: int) -> PriorModel:
    """Random weights as a function of the seed, and no code: the architecture without what a prior learned."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PriorModel(replace(model.within_the_box(), latent=0, predicted_normals=False), 1)


def with_predicted_normals(model: PriorModel, seed: int) -> PriorModel:
    """The model with the layer that predicts normals, random as a function of the seed (the paper, finetuned model).

    A model that has it is returned as it is.
    """
    if model.config.predicted_normals:
        return model
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        found = PriorModel(replace(model.config, predicted_normals=True), len(model.codes))
    found.load_state_dict({**found.state_dict(), **model.state_dict()})
    return found.to(model.codes.device)


def code_of(model: PriorModel) -> Tensor | None:
    """The code [1, latent] as the model takes it; None for a model without."""
    return model.codes if model.config.latent else None


@dataclass(frozen=True, eq=False)
class Correction:
    """Corrections of cameras, and what they need to know.

    Attributes:
        cameras: a row per view fitted to.
        rows: int64 [V], the row of each view of the identity.
        box: canonical frame, metres.
        scale: scene units per metre.
    """

    cameras: CameraCorrections
    rows: Tensor
    box: Box
    scale: float

    def apply(self, rays: Rays, view: Tensor) -> Rays:
        """The corrected rays, whose views are int64 [n]."""
        return self.cameras.apply(rays, self.rows[view], self.box, self.scale)


def head_renderer(
    model: PriorModel,
    seed: int,
    share_done: Callable[[int], float],
    correction: Correction | None = None,
    *,
    normals: bool = False,
) -> Callable[[Part], Render]:
    """Render parts of a step with a head.

    Args:
        model: with one code or none.
        seed: of the places of samples.
        share_done: of a step, for annealing; 1 for networks that know where to look.
        correction: of the cameras, if there is one.
        normals: whether the density's normals are found, and with them those that a layer predicts.
    """
    rounds = len(model.config.samples)

    def render(part: Part) -> Render:
        batch = part.batch
        noise = torch.from_numpy(jitter(seed, part.step, part.first, len(batch), rounds))
        rays = Rays.from_batch(batch)
        return model(
            rays if correction is None else correction.apply(rays, batch.view),
            code_of(model),
            train_frac=share_done(part.step),
            jitter=noise.to(batch.origins.device),
            normals=normals,
        )

    return render
