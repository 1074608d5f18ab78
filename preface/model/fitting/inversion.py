"""Inversion: the code with which the frozen prior comes closest to the views.

The paper, section 3.3.2 and supplementary material: patches at the prior's resolution, on black by the mask; the mean
absolute difference plus 0.2 LPIPS; Adam at a constant rate; zeros to start from. Patches lie anywhere in the image:
about the box of the foreground instead, they brought a code no further in as many steps (heads fill aligned views).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from preface.artifacts import ArtifactError
from preface.model.fitting.configuration import LEAST_PATCH, InversionConfig
from preface.model.fitting.heads import Correction, head_renderer
from preface.model.fitting.observations import view_loader
from preface.model.metrics.lpips import Lpips
from preface.model.metrics.lpips_weights import load_lpips
from preface.model.model import PriorModel, Render
from preface.model.training.data import TrainingData
from preface.model.training.prior_loss import color_terms, target_colors
from preface.model.training.trainer import LossTerm, Options, ParameterSet, Part, Trainer
from preface.shards import Loader, Patches


def patch_size(config: InversionConfig, data: TrainingData) -> int:
    """The side of patches: that of the configuration, or the largest that the views hold.

    Raises:
        ArtifactError: the views are too small for LPIPS.
    """
    width, height = data.scene.resolution
    size = min(config.patch, width, height)
    least = LEAST_PATCH[config.network] if config.lpips > 0 else 1
    if size < least:
        problem = f"views of {width}x{height} hold no patch of {least}x{least}, the least that LPIPS takes"
        remedy = "Use larger views, or --inversion.lpips 0"
        raise ArtifactError(data.dataset.manifest.path, "resolution", problem, remedy)
    return size


def inversion_trainer(
    model: PriorModel,
    config: InversionConfig,
    data: TrainingData,
    seed: int,
    micro_rays: int,
    device: torch.device,
    correction: Correction | None = None,
) -> tuple[Trainer, Loader]:
    """What takes inversion's steps, and what gives them their rays.

    The networks of the model are frozen: only its code has a gradient.

    Args:
        model: a head, on the device.
        config: see there.
        data: the views, at the prior's resolution.
        seed: of patches and samples.
        micro_rays: rays at a time; patches are kept whole.
        device: where.
        correction: of the cameras, if there is one; fixed.

    Raises:
        ArtifactError: the weights of LPIPS are missing, or the views too small for it.
    """
    size = patch_size(config, data)
    terms = color_terms("black")
    if config.lpips > 0:
        terms.append(LossTerm("lpips", config.lpips, perceptual(load_lpips(config.network).to(device), size)))
    for parameter in model.parameters():
        parameter.requires_grad_(parameter is model.codes)
    sampler = Patches(data.train, seed, config.patches, size)
    trainer = Trainer(
        [ParameterSet("codes", {"codes": model.codes}, lambda step: config.rate, None)],
        terms,
        head_renderer(model, seed, lambda step: 1.0, correction),
        Options(micro_rays=max(micro_rays, size * size)),
        sampler.groups,
    )
    return trainer, view_loader(data, sampler, device)


def perceptual(lpips: Lpips, size: int) -> Callable[[Render, Part], Tensor]:
    """The mean LPIPS between rendered and photographed patches of a size, as a loss term takes it."""

    def images(colors: Tensor) -> Tensor:
        """Colours [n size^2, 3] as images [n, 3, size, size]."""
        return colors.view(-1, size, size, 3).permute(0, 3, 1, 2)

    def value(render: Render, part: Part) -> Tensor:
        return lpips(images(render.rgb), images(target_colors(part.batch, "black"))).mean()

    return value
