"""Finetuning: all weights, and the code, adapt to the views; regularised so that new views stay a face.

The paper, equation 3: absolute difference, interlevel loss, predicted normals whose second-order gradients reach the
density, and the squared norm of the weights through which the direction acts. Opacity, orientation and what proposals
are taught elsewhere are ours to ask for.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from preface.geometry import Box
from preface.model import losses
from preface.model.fitting.configuration import FinetuningConfig
from preface.model.fitting.elsewhere import interlevel_elsewhere
from preface.model.fitting.heads import Correction, head_renderer
from preface.model.fitting.observations import view_loader
from preface.model.model import PriorModel, Render
from preface.model.rays import Rays
from preface.model.training.data import TrainingData
from preface.model.training.prior_loss import color_terms, interlevel, opacity
from preface.model.training.schedule import LogLinear
from preface.model.training.trainer import LossTerm, Options, ParameterSet, Part, Trainer
from preface.shards import Loader, SingleRays


def finetuning_trainer(
    model: PriorModel,
    config: FinetuningConfig,
    steps: int,
    data: TrainingData,
    seed: int,
    micro_rays: int,
    device: torch.device,
    *,
    knows_heads: bool,
    correction: Correction | None = None,
) -> tuple[Trainer, Loader]:
    """What takes finetuning's steps, and what gives them their rays.

    Args:
        model: a head, on the device, with the layer that predicts normals if that is regularised.
        config: see there.
        steps: of the phase.
        data: the views.
        seed: of rays and samples.
        micro_rays: rays at a time.
        device: where.
        knows_heads: whether the weights are a prior's, whose proposals say where to look from the first step on;
            others are annealed as a prior is.
        correction: of the cameras, if there is one; fixed.
    """
    for parameter in model.parameters():
        parameter.requires_grad_()

    def share_done(step: int) -> float:
        return 1.0 if knows_heads else step / max(steps - 1, 1)

    sampler = SingleRays(data.train, seed, config.rays, config.foreground_share)
    trainer = Trainer(
        parameter_sets(model, config, steps),
        [*finetuning_terms(model, config, correction), *_elsewhere(model, config, data, seed)],
        head_renderer(
            model, seed, share_done, correction, normals=config.normals > 0 or config.orientation > 0
        ),
        Options(eps=config.eps, micro_rays=micro_rays),
        sampler.groups,
    )
    return trainer, view_loader(data, sampler, device)


def parameter_sets(model: PriorModel, config: FinetuningConfig, steps: int) -> list[ParameterSet]:
    """Each network and the code, clipped by themselves."""
    rate = LogLinear(config.rate, config.rate_last, max(steps, 1))
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    frozen = config.frozen_latent or not model.config.latent
    model.codes.requires_grad_(not frozen)
    return [
        ParameterSet(name, {names[id(p)]: p for p in parameters}, rate, config.clip or None)
        for name, parameters in model.parameter_groups().items()
        if not (name == "codes" and frozen)
    ]


def finetuning_terms(
    model: PriorModel, config: FinetuningConfig, correction: Correction | None = None
) -> list[LossTerm]:
    """The paper's objective, equation 3; and opacity and orientation, if asked for."""
    terms = [*color_terms("black"), LossTerm("interlevel", config.interlevel, interlevel)]
    if config.opacity > 0:
        terms.append(LossTerm("opacity", config.opacity, opacity))
    if config.normals > 0:
        terms.append(LossTerm("normals", config.normals, predicted_normals))
    if config.orientation > 0:
        terms.append(LossTerm("orientation", config.orientation, orientation_seen_through(correction)))
    if config.view_weights > 0:
        layer, features = model.nerf.view.weight, 3 + 6 * model.config.view_levels

        def view_weights(render: Render, part: Part) -> Tensor:
            return losses.view_weight_penalty(layer, features)

        terms.append(LossTerm("view_weights", config.view_weights, view_weights))
    return terms


def _elsewhere(model: PriorModel, config: FinetuningConfig, data: TrainingData, seed: int) -> list[LossTerm]:
    """What proposals are taught where no photograph was taken, if that is asked for."""
    if config.elsewhere == 0 or config.interlevel == 0:
        return []
    box = Box(data.scene.box[0], data.scene.box[1])
    taught = interlevel_elsewhere(model, box, data.scene.scene_scale, config.elsewhere, seed)
    return [LossTerm("interlevel_elsewhere", config.interlevel, taught)]


def predicted_normals(render: Render, part: Part) -> Tensor:
    """The mean over all rays of Ref-NeRF's disagreement of normals; those that miss the box have none."""
    assert render.normals is not None
    assert render.normals_pred is not None
    weights = render.levels[-1].weights
    return losses.predicted_normal(weights, render.normals, render.normals_pred) * render.share


def orientation_seen_through(correction: Correction | None) -> Callable[[Render, Part], Tensor]:
    """The mean over all rays of Ref-NeRF's penalty on normals that face away, by the directions that were rendered."""

    def orientation(render: Render, part: Part) -> Tensor:
        assert render.normals is not None
        rays = Rays.from_batch(part.batch)
        rays = rays if correction is None else correction.apply(rays, part.batch.view)
        some = rays if render.evaluated is None else rays[render.evaluated]
        return losses.orientation(render.levels[-1].weights, render.normals, some.viewdirs) * render.share

    return orientation
