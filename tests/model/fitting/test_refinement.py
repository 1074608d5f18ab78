"""Refinement of cameras: it meets the views better by moving cameras alone, and says by how much."""

from dataclasses import replace

import pytest
import small_fits
import torch

from preface.model.fitting.cameras import CameraCorrections
from preface.model.fitting.heads import Correction, head_of_prior
from preface.model.fitting.refinement import gain, refinement_trainer
from preface.model.training.prior_files import read_prior

CPU = torch.device("cpu")


@pytest.fixture
def head(prior):
    networks = read_prior(prior).load_model()
    return head_of_prior(networks, networks.codes.detach().mean(dim=0))


def test_views_are_met_better_and_nothing_moves_but_the_cameras(head, data, correction):
    assert gain(head, correction, data, CPU) == 0
    before = {name: value.clone() for name, value in head.state_dict().items()}
    config = replace(small_fits.CAMERAS, steps=15, rays=128)
    trainer, loader = refinement_trainer(head, config, data, 0, 4096, CPU, correction)
    for step in range(config.steps):
        trainer.step(step, loader.batch(step))
    assert gain(head, correction, data, CPU) > 0
    for parameter in correction.cameras.parameters():
        assert parameter.abs().sum(dim=1).min() > 0  # of both cameras
        assert parameter.abs().max() < config.steps * config.rate * 1.1
    for name, value in head.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_cameras_that_look_away_lose(head, data, correction):
    with torch.no_grad():
        correction.cameras.translation[:, 1] = 0.3
    assert gain(head, correction, data, CPU) < -1


def test_the_pull_holds_cameras_where_they_were(head, data, correction):
    config = replace(small_fits.CAMERAS, steps=5, rays=64, weight=1e4)
    trainer, loader = refinement_trainer(head, config, data, 0, 4096, CPU, correction)
    for step in range(5):
        trainer.step(step, loader.batch(step))
    free = Correction(CameraCorrections(2), correction.rows, correction.box, correction.scale)
    trainer, loader = refinement_trainer(head, replace(config, weight=0.0), data, 0, 4096, CPU, free)
    for step in range(5):
        trainer.step(step, loader.batch(step))
    held, loose = (found.cameras.penalty(found.scale) for found in (correction, free))
    assert held < 0.5 * loose
