"""Priors and heads of ball-shaped people that were never trained: files as a run writes them, in no time."""

from pathlib import Path

import ball_heads
import small_runs
import torch

from preface.artifacts import provenance
from preface.model.model import PriorModel
from preface.model.training.checkpoint import WEIGHTS, write_checkpoint
from preface.model.training.prior_files import Prior, Scene, prior_payload

SCALE = 1 / 0.15  # of the balls' box


def write_model(folder: Path, identities, held_out=None, fit=None, seed=0, **model) -> Path:
    """A model of these identities with random weights; a head if `fit` says what it was fitted to."""
    folder.mkdir(parents=True, exist_ok=True)
    config = small_runs.replace(small_runs.MODEL, **model)
    described = Prior(
        path=folder / "model.json",
        model=config,
        identities=tuple(identities),
        scene=Scene(ball_heads.BOX, (0.8, 1.3), SCALE, (ball_heads.WIDTH, ball_heads.HEIGHT)),
        configuration={},
        step=1,
        steps=1,
        held_out=held_out or {},
        validation={},
        products="",
        provenance=provenance({}, {}),
        files={},
        fit=fit,
    )
    torch.manual_seed(seed)
    weights = PriorModel(config, len(identities)).state_dict()
    write_checkpoint(folder, prior_payload(described), {WEIGHTS: weights})
    return folder


def fitted_to(views, identity="id0000") -> dict:
    """What a head says of its fit."""
    return {
        "identity": identity,
        "views": list(views),
        "shards": {"manifest": "0" * 64, "path": "shards"},
        "resolution": {"width": ball_heads.WIDTH, "height": ball_heads.HEIGHT},
        "prior": None,
        "inversion": {"steps": 0, "loss": None},
        "finetuning": {"steps": 1},
        "cameras": {},
        "quality": "draft",
    }
