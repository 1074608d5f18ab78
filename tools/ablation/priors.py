"""The priors behind some rows: trained as the full prior was, on fewer people or on images of half the size.

Steps, batches and everything else are those of the full prior's own configuration, so that only the data differ. People
are nested: those of a smaller prior are among those of each larger one.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ablation.design import FULL_PRIOR, HALF_PRIOR
from preface.artifacts import ArtifactError, provenance
from preface.model.configuration import ModelConfig
from preface.model.fitting.reduction import reduced_head
from preface.model.training.configuration import TRAINING_PRESETS, RunConfig, TrainConfig, TrainingConfig
from preface.model.training.prior import train_prior
from preface.model.training.prior_files import MODEL_FILE, Prior, read_prior
from preface.shards import Dataset
from preface.shards.building import build_manifest
from preface.shards.manifest import MANIFEST_FILE
from preface.shards.writer import ShardWriter

Say = Callable[[str], None]
HEADS_PER_SHARD = 16
UNUSED = "unused"  # split of those that a smaller prior does not see


@dataclass(frozen=True, eq=False)
class Priors:
    """The full prior, and the folder that the others are trained in."""

    full: Prior
    dataset: Dataset
    folder: Path
    run: RunConfig

    def path(self, name: str) -> Path:
        """The folder of a prior: `full`, `half-resolution` or `identities-N`."""
        return self.full.path.parent if name == FULL_PRIOR else self.folder / name

    def is_trained(self, name: str) -> bool:
        """Whether nothing is left to do for it."""
        path = self.path(name)
        return (path / MODEL_FILE).exists() and read_prior(path).finished

    def rays(self) -> int:
        """Rays of a training run."""
        training = self._training()
        return training.steps * training.identities * training.views * training.rays

    def train(self, name: str, say: Say) -> int:
        """Train a prior, or go on; returns the exit status.

        Raises:
            ArtifactError, TrainingError: as `train_prior`.
        """
        if self.is_trained(name):
            return 0
        shards = self._shards(name)
        configuration = self.full.configuration
        config = TrainConfig(
            shards=shards,
            output=self.path(name),
            preset=configuration["preset"],
            training=self._training(),
            run=self.run,
            model=ModelConfig.from_dict(configuration["model"]),
        )
        say(f"prior {name}: training as {self.full.path.parent} was")
        return train_prior(config, say).status

    def _training(self) -> TrainingConfig:
        return TrainingConfig(**self.full.configuration["training"])

    def _shards(self, name: str) -> Path:
        """The shards of a prior, made unless they are there."""
        folder = self.folder / f"{name}-shards"
        if (folder / MANIFEST_FILE).exists():
            return folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ArtifactError.from_os(folder, "writing", error) from error
        split = self._training().split
        if name == HALF_PRIOR:
            return halved_shards(self.dataset, self.full.identities, split, folder)
        count = int(name.rpartition("-")[2])
        return subset_shards(self.dataset, nested(self.full.identities, count), split, folder)


def run_config(preset: str, device: Any) -> RunConfig:
    """How priors are trained here: as their preset says, with few pictures."""
    usual = TRAINING_PRESETS[preset][1]
    return RunConfig(device=device, micro_rays=usual.micro_rays, final_views=8, faces_between=0)


def nested(names: Sequence[str], count: int) -> tuple[str, ...]:
    """`count` of the names in their order; a smaller choice is part of each larger one."""
    chosen = np.random.default_rng(0).permutation(len(names))[:count]
    return tuple(names[number] for number in sorted(chosen.tolist()))


def subset_shards(dataset: Dataset, names: Sequence[str], split: str, folder: Path) -> Path:
    """The same shards with some people in a split and all others in another; files are linked if they can be.

    Raises:
        ArtifactError: the folder cannot be written.
    """
    manifest = dataset.manifest
    for entry in manifest.shards:
        _link(manifest.path.parent / entry.file, folder / entry.file)
    others = [name for name in dataset.names if name not in set(names)]
    splits = {split: list(names), UNUSED if split != UNUSED else f"{UNUSED}-2": others}
    history = {"identities": list(names)}
    made = provenance(history, {MANIFEST_FILE: manifest.path})
    build_manifest(folder, len(manifest.shards), {k: v for k, v in splits.items() if v}, history, made)
    return folder


def _link(source: Path, target: Path) -> None:
    """A hard link, since links that lead out of a dataset's folder are refused; a copy on another disk."""
    try:
        target.unlink(missing_ok=True)
        try:
            os.link(source, target)
        except OSError:
            shutil.copyfile(source, target)
    except OSError as error:
        raise ArtifactError.from_os(target, "writing", error) from error


def halved_shards(dataset: Dataset, names: Sequence[str], split: str, folder: Path) -> Path:
    """Some people of a dataset at half the resolution, as fitting reduces views for inversion.

    Raises:
        ArtifactError: pixels cannot be read, or the folder not be written.
    """
    manifest = dataset.manifest
    size = (manifest.width // 2, manifest.height // 2)
    history = {"identities": list(names), "resolution": list(size)}
    made = provenance(history, {MANIFEST_FILE: manifest.path})
    parts = [names[begin : begin + HEADS_PER_SHARD] for begin in range(0, len(names), HEADS_PER_SHARD)]
    for number, part in enumerate(parts):
        with ShardWriter(folder, number, size, "raster", "halved") as shard:
            for person in map(dataset.names.index, part):
                shard.add(reduced_head(dataset, person, range(manifest.views), size))
    build_manifest(folder, len(parts), {split: list(names)}, history, made)
    return folder
