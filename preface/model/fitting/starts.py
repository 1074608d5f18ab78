"""Where inversion's code starts: the rows of the paper's ablation of initialisation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from preface.model import losses
from preface.model.fitting.configuration import Start
from preface.model.fitting.heads import head_of_prior
from preface.model.model import PriorModel
from preface.model.rays import Rays
from preface.model.training.prior_loss import target_colors
from preface.shards import Batch


def start_code(prior: PriorModel, start: Start, views: Sequence[Batch], seed: int) -> Tensor:
    """A code [latent] to start from.

    Args:
        prior: with the codes of its identities.
        start: `zeros`; `noise`, normal with the root mean square of the prior's codes; `mean` of them; `nearest`
            or `furthest` of them. The paper takes neighbours in the embedding of a face recognition network
            (FaceNet), which says who looks alike; here it is the mean absolute difference of the colours that a
            code renders in the views from theirs, which is what a fit minimises, and needs no other network.
        views: rays of the views; looked at for neighbours only.
        seed: of the noise.
    """
    codes = prior.codes.detach()
    if start == "zeros":
        return torch.zeros_like(codes[0])
    if start == "noise":
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(codes.shape[1], generator=generator).to(codes)
        return noise * codes.square().mean().sqrt()
    if start == "mean":
        return codes.mean(dim=0)
    head = head_of_prior(prior, codes[0])
    distances = torch.stack([_distance(head, code, views) for code in codes])
    return codes[int(distances.argmin() if start == "nearest" else distances.argmax())].clone()


def _distance(head: PriorModel, code: Tensor, views: Sequence[Batch]) -> Tensor:
    """Mean absolute difference of the colours of views from those rendered with a code [latent]."""
    found = []
    with torch.no_grad():
        for batch in views:
            seen = head(Rays.from_batch(batch), code[None], normals=False)
            found.append(losses.l1(seen.rgb, target_colors(batch, "black")))
    return torch.stack(found).mean()
