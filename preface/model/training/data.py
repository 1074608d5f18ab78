"""What a prior is trained on: the identities of a split, the views held out, and what must be true of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from preface.artifacts import ArtifactError
from preface.model.configuration import ModelConfig
from preface.model.training.configuration import TrainingConfig
from preface.model.training.prior_files import Scene
from preface.shards import Dataset, Pick, ViewIndex
from preface.shards.streams import stream_key, without_replacement

_HOLDOUT = 102  # what this stream of random numbers is for; see preface.shards.streams


@dataclass(frozen=True, eq=False)
class TrainingData:
    """A split of a dataset.

    Attributes:
        dataset: opened.
        names: of the identities, in the order of their codes.
        row: int64 [N], the code's row of each identity of the dataset, -1 for those of other splits.
        train, held_out: which views are for what.
        scene: the space, for the checkpoint.
    """

    dataset: Dataset
    names: tuple[str, ...]
    row: np.ndarray
    train: ViewIndex
    held_out: ViewIndex
    scene: Scene

    @property
    def held_out_names(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the cameras of held-out views, by identity."""
        entries = self.dataset.manifest.identities
        found: dict[str, list[str]] = {}
        for identity, view in self.held_out.pairs.tolist():
            found.setdefault(entries[identity].identity, []).append(str(entries[identity].cameras[view]))
        return {name: tuple(views) for name, views in found.items()}

    @property
    def smallest_radius(self) -> float:
        """Of the cones of all training pixels where they first meet the box, scene units."""
        valid, tables = self.train.valid, self.dataset.tables
        footprint = 0.5 * (1 / tables["intrinsics"][valid][:, :2]).sum(axis=-1) * 2 / math.sqrt(12)
        return float((footprint * tables["near_far"][valid][:, 0]).min() * self.scene.scene_scale)


def open_data(dataset: Dataset, training: TrainingConfig, model: ModelConfig) -> TrainingData:
    """Choose the identities and views of a run.

    Raises:
        ArtifactError: the split does not exist or has no views, numbers are not finite, or somebody has no
            foreground and the model knows no background.
    """
    manifest = dataset.manifest
    if training.split not in manifest.splits:
        problem = f"there is no split '{training.split}', only {', '.join(manifest.splits) or 'none'}"
        raise ArtifactError(manifest.path, "splits", problem, "Choose one of them by --split")
    index = dataset.index(training.split)
    if not index.valid.any():
        problem = f"no identity of '{training.split}' has a view"
        raise ArtifactError(manifest.path, "splits", problem, "Build the shards again")
    check_finite(dataset, index)
    if model.background == "black":
        _check_foreground(dataset, index)
    held = hold_out(index.valid, training.holdout_views, training.seed)
    people = index.identities
    row = np.full(len(dataset), -1)
    row[people] = np.arange(len(people))
    depths = dataset.tables["near_far"][index.valid]
    scene = Scene(
        manifest.box,
        (float(depths[:, 0].min()), float(depths[:, 1].max())),
        manifest.scene_scale,
        (manifest.width, manifest.height),
    )
    names = tuple(dataset.names[person] for person in people)
    train, held_out = replace(index, valid=index.valid & ~held), replace(index, valid=held)
    return TrainingData(dataset, names, row, train, held_out, scene)


def hold_out(valid: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Views to keep out of training: `count` of each identity, but never its last one.

    Args:
        valid: bool [N, V].
        count: views per identity.
        seed: chooses them.

    Returns:
        bool [N, V], a part of `valid`.
    """
    held = np.zeros_like(valid)
    people = np.flatnonzero(valid.sum(axis=1) > 1)
    if count and len(people):
        order = without_replacement(stream_key(seed, 0, _HOLDOUT), len(people), valid[people], valid.shape[1])
        for person, views in zip(people, order, strict=True):
            held[person, views[: min(count, int(valid[person].sum()) - 1)]] = True
    return held


def check_finite(dataset: Dataset, index: ViewIndex) -> None:
    """Refuse cameras with numbers that are none.

    Raises:
        ArtifactError: naming the first.
    """
    for name in ("intrinsics", "canonical_from_camera", "near_far"):
        finite = np.isfinite(dataset.tables[name]).reshape(*index.valid.shape, -1).all(axis=-1)
        wrong = np.argwhere(index.valid & ~finite)
        if len(wrong):
            identity, view = wrong[0].tolist()
            problem = f"is not finite for view {view} of '{dataset.names[identity]}'"
            raise ArtifactError(dataset.manifest.path, name, problem, "Build the shards again")


def _check_foreground(dataset: Dataset, index: ViewIndex) -> None:
    counts = np.where(index.valid, dataset.tables["foreground_count"], 0).sum(axis=1)
    empty = [dataset.names[person] for person in index.identities if counts[person] == 0]
    if empty:
        shown = ", ".join(empty[:5]) + (f" and {len(empty) - 5} more" if len(empty) > 5 else "")
        problem = f"no foreground in any view of {shown}: on black there is nothing to learn"
        remedy = "Build the shards with masks, leave them out, or train with --model.background modelled"
        raise ArtifactError(dataset.manifest.path, "foreground_count", problem, remedy)


@dataclass(frozen=True, eq=False)
class WholeViews:
    """A sampler whose step i is all pixels of the i-th of these views, in raster order.

    Attributes:
        index: to pick from.
        pairs: int64 [n, 2], identity and view.
    """

    index: ViewIndex
    pairs: np.ndarray

    groups = 1

    def pick(self, step: int, rank: int, world: int) -> Pick:
        """All pixels of a view, whoever asks."""
        identity, view = self.pairs[step : step + 1].T
        return self.index.pick(identity, view, np.arange(self.index.width * self.index.height)[None])

    def __len__(self) -> int:
        return len(self.pairs)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter((int(identity), int(view)) for identity, view in self.pairs)


def spread(index: ViewIndex, count: int) -> np.ndarray:
    """`count` of an index's views, spread over its identities; all of them for 0; int64 [n, 2]."""
    pairs = index.pairs
    if not 0 < count < len(pairs):
        return pairs
    return pairs[np.linspace(0, len(pairs) - 1, count).round().astype(np.int64)]


def frontal_view(data: TrainingData, identity: int) -> int:
    """The view of an identity that is seen from the most frontal place, training or not."""
    poses = data.dataset.tables["canonical_from_camera"][identity]
    center = poses[:, :, 3]
    valid = data.train.valid[identity] | data.held_out.valid[identity]
    ahead = center[:, 2] / np.maximum(np.linalg.norm(center, axis=-1), 1e-9)
    return int(np.argmax(np.where(valid, ahead, -np.inf)))
