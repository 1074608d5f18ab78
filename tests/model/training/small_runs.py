"""Runs that take a second or two."""

import json
import re
from dataclasses import replace
from pathlib import Path

import safetensors.torch
import torch

from preface.artifacts import SCHEMA_DIRECTORY
from preface.model.configuration import ModelConfig, NetworkConfig
from preface.model.training.configuration import RunConfig, TrainConfig, TrainingConfig

MODEL = ModelConfig(
    latent=8,
    proposal=NetworkConfig(1, 16),
    nerf=NetworkConfig(2, 32),
    bottleneck=8,
    view_width=8,
    view_levels=1,
    levels=5,
    samples=(12, 8),
)
TRAINING = TrainingConfig(steps=20, identities=3, views=2, rays=16, rate=1e-2, rate_last=1e-3, clip=0.0)
RUN = RunConfig(
    device="cpu", products="mkl", micro_rays=64, log_every=5, validate_every=10**6, validate_views=1
)


def config(shards: Path, output: Path, training=None, run=None, **model) -> TrainConfig:
    """A run with some fields changed."""
    return TrainConfig(
        shards=shards,
        output=output,
        preset="tiny",
        training=replace(TRAINING, **(training or {})),
        run=replace(RUN, **(run or {})),
        model=replace(MODEL, **model),
    )


def quiet(words: str) -> None:
    """Says nothing."""


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    """Everything that a checkpoint holds, by file and name."""
    return {
        f"{name}:{key}": value
        for name in ("model", "training_state")
        for key, value in safetensors.torch.load_file(folder / f"{name}.safetensors").items()
    }


def assert_equal_bits(one, other) -> None:
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert value.numpy().tobytes() == other[name].numpy().tobytes(), name


def words_of_log(path):
    """The kinds of a log's lines, and the words in them that data_specs/log.md does not have."""
    described = set(re.findall(r"`(\w+)`", (SCHEMA_DIRECTORY / "log.md").read_text()))
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    kinds = {entry["kind"] for entry in entries}
    groups = {name for entry in entries for key in ("gradient_norm", "rate") for name in entry.get(key, ())}
    return kinds, {*kinds, *groups, *(key for entry in entries for key in entry)} - described
