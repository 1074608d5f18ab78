"""Finding small corrections of the cameras, between inversion and finetuning.

Not in the paper, which names the error of its calibration as a limit of its results. Inversion gives a face of the
prior that lies where faces lie; the cameras are brought to agree with it while nothing else moves. Whatever may move
with them takes over part of their error: with the code free as well, cameras that were off by 6.3 mm at the head came
back to 2.3 mm instead of 1.1, and right ones went astray by 3.8 mm instead of 2.5 (a `small` prior, two views).

Right cameras go astray because the face is only somebody like the head. So corrections are kept only where they make
the views agree much better (`gain`); a fit that does not keep them is the fit that never sought any. One that does
inverts again, with corrected cameras and from the same start, and both are left as they are from there on.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from preface.model.fitting.configuration import CamerasConfig
from preface.model.fitting.heads import Correction, code_of, head_renderer
from preface.model.fitting.observations import grids, view_loader
from preface.model.model import PriorModel, Render
from preface.model.rays import Rays
from preface.model.training.data import TrainingData
from preface.model.training.prior_loss import color_terms, target_colors
from preface.model.training.schedule import LogLinear
from preface.model.training.trainer import LossTerm, Options, ParameterSet, Part, Trainer
from preface.shards import Loader, SingleRays

_JUDGED_GRID = 48  # pixels per side of a view on which corrections are judged


def refinement_trainer(
    model: PriorModel,
    config: CamerasConfig,
    data: TrainingData,
    seed: int,
    micro_rays: int,
    device: torch.device,
    correction: Correction,
) -> tuple[Trainer, Loader]:
    """What takes the steps of refinement, and what gives them their rays: those of the boxes around the head.

    Args:
        model: a head after inversion, on the device; frozen here.
        config: see there.
        data: the views, at the prior's resolution.
        seed: of rays and samples.
        micro_rays: rays at a time.
        device: where.
        correction: of the views in `data`; only it has a gradient.
    """
    for parameter in model.parameters():
        parameter.requires_grad_(False)
    cameras = correction.cameras

    def moved(render: Render, part: Part) -> Tensor:
        return cameras.penalty(correction.scale)

    rate = LogLinear(config.rate, config.rate_last, config.steps)
    parameters = {f"cameras.{name}": parameter for name, parameter in cameras.named_parameters()}
    sampler = SingleRays(data.train, seed, config.rays, 1.0)
    trainer = Trainer(
        [ParameterSet("cameras", parameters, rate, None)],
        [*color_terms("black"), LossTerm("cameras", config.weight, moved)],
        head_renderer(model, seed, lambda step: 1.0, correction),
        Options(micro_rays=micro_rays),
        sampler.groups,
    )
    return trainer, view_loader(data, sampler, device)


def gain(model: PriorModel, correction: Correction, data: TrainingData, device: torch.device) -> float:
    """How much better a head meets the views with corrected cameras: dB of the mean squared error, on black.

    Args:
        model: after inversion, on the device.
        correction: of the views in `data`.
        data: the views.
        device: where.
    """
    before, after = 0.0, 0.0
    with torch.no_grad():
        for batch in grids(data, _JUDGED_GRID, device):
            given, truth = Rays.from_batch(batch), target_colors(batch, "black")
            corrected = correction.apply(given, batch.view)
            before, after = (
                total + float(mse_loss(model(rays, code_of(model), normals=False).rgb, truth))
                for total, rays in ((before, given), (after, corrected))
            )
    return 10 * math.log10(before / after) if after > 0 and before > 0 else 0.0


def said_of_gain(found: float, least: float) -> str:
    """The judgement on corrections that gained so much, dB, of what it takes."""
    words = "kept" if found >= least else "the cameras stay as they were"
    return f"cameras: views are met {found:+.2f} dB better, of the {least:g} dB that it takes: {words}"
