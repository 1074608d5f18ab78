"""Fits that take a second or two, to heads made of balls."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import small_runs
import torch
from small_runs import quiet

from preface.model.fitting.configuration import (
    CamerasConfig,
    FinetuningConfig,
    FitConfig,
    FitRunConfig,
    InversionConfig,
)
from preface.model.fitting.heads import code_of
from preface.model.fitting.observations import observe
from preface.model.rays import Rays
from preface.model.training.data import WholeViews
from preface.model.training.prior import train_prior
from preface.model.training.prior_files import read_prior
from preface.model.training.prior_loss import target_colors
from preface.shards import Dataset, Loader

UNSEEN, VIEWS = "id0003", ("camera1", "camera4")
INVERSION = InversionConfig(steps=8, patches=2, patch=12, rate=3e-2, lpips=0.0)
CAMERAS = CamerasConfig(steps=4, rays=64, least_gain=0)
FINETUNING = FinetuningConfig(steps=8, rays=64, rate=1e-3, rate_last=1e-4)
RUN = FitRunConfig(device="cpu", products="mkl", micro_rays=512, log_every=2, preview_every=0)


def train(shards: Path, folder: Path, **model) -> None:
    """Train the prior."""
    training = {"steps": 100, "views": 2, "rays": 32, "holdout_views": 0}
    train_prior(
        small_runs.config(shards, folder, training, {"micro_rays": 512, "faces_between": 0}, **model), quiet
    )


def config(
    shards: Path, prior, output: Path, inversion=None, finetuning=None, run=None, cameras=None, **rest
) -> FitConfig:
    """A fit with some fields changed."""
    chosen = {"identity": UNSEEN, "views": VIEWS, "quality": "draft", "model": small_runs.MODEL, **rest}
    return FitConfig(
        shards=shards,
        output=output,
        prior=prior,
        inversion=replace(INVERSION, **(inversion or {})),
        cameras=replace(CAMERAS, **(cameras or {})),
        finetuning=replace(FINETUNING, **(finetuning or {})),
        run=replace(RUN, **(run or {})),
        **chosen,
    )


def held_out_psnr(shards: Path, head: Path) -> float:
    """Of all pixels of the views of the identity that it was not fitted to, on black, dB."""
    described = read_prior(head)
    with Dataset(shards) as dataset:
        data = observe(dataset, described.fit["identity"], described.fit["views"], None)
        return psnr_of(described.load_model(), data, data.held_out.pairs)


def psnr_of(model, data, pairs) -> float:
    views = WholeViews(data.train, pairs)
    loader = Loader(data.dataset, views, placement="mmap", scale=data.scene.scene_scale)
    errors = []
    with torch.no_grad():
        for number in range(len(pairs)):
            batch = loader.batch(number)
            seen = model(Rays.from_batch(batch), code_of(model), normals=False).rgb
            errors.append(float(((seen - target_colors(batch, "black")) ** 2).mean()))
    return -10 * np.log10(np.mean(errors))
