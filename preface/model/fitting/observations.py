"""The views that a head is fitted to: found in the shards, held against the prior's space, checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from preface.artifacts import ArtifactError, read_artifact
from preface.model.training.data import TrainingData, check_finite
from preface.model.training.folder import TEMPLATE_FILE
from preface.model.training.prior_files import Prior, Scene
from preface.plain_words import suggestion
from preface.shards import Batch, Dataset, Loader, Pick, Sampler, ViewIndex

SAME_PLACE = 1e-6  # metres; boxes that differ by less are one
_GRID = 64  # pixels per side that are looked at where all would be too many
_LEAST_INSIDE = 0.05  # of a view's foreground, that has to be seen within the box


def observe(
    dataset: Dataset, identity: str | None, cameras: Sequence[str], prior: Prior | None
) -> TrainingData:
    """Find the views of an identity.

    Args:
        dataset: opened.
        identity: whose; None where the dataset holds but one.
        cameras: names of the views to fit to.
        prior: whose space the views have to be in; None takes the shards' own.

    Returns:
        The views of one identity: `train` holds those to fit to, `held_out` its others.

    Raises:
        ArtifactError: unknown names, views without foreground or that do not see the box, numbers that are not
            finite, or shards of another space than the prior's.
    """
    manifest = dataset.manifest
    person = _person(dataset, identity)
    entry = manifest.identities[person]
    views = [_view(dataset, person, camera) for camera in cameras]
    everything = dataset.index().only([person])
    valid = np.zeros_like(everything.valid)
    valid[person, views] = True
    train = replace(everything, valid=valid)
    check_finite(dataset, train)
    box = dataset.tables["box"][person]
    if prior is not None:
        _require_same_space(dataset, entry.identity, box, prior)
    scale = manifest.scene_scale if prior is None else prior.scene.scene_scale
    depths = dataset.tables["near_far"][valid]
    near_far = (float(depths[:, 0].min()), float(depths[:, 1].max()))
    row = np.full(len(dataset), -1)
    row[person] = 0
    data = TrainingData(
        dataset,
        (entry.identity,),
        row,
        train,
        replace(everything, valid=everything.valid & ~valid),
        Scene(box, near_far, scale, (manifest.width, manifest.height)),
    )
    _check_seen(data, cameras, views)
    return data


def view_numbers(data: TrainingData, cameras: Sequence[str]) -> np.ndarray:
    """Numbers of views by the names of their cameras, int64 [n, 2], identity and view, in the order of the names."""
    person = int(data.train.identities[0])
    known = data.dataset.manifest.identities[person].cameras
    return np.array([(person, known.index(camera)) for camera in cameras], dtype=np.int64)


def template_gap(dataset: Dataset, prior: Prior) -> float | None:
    """How far the template of the shards' people is from that of the prior's.

    Returns:
        The root mean square distance of their five keypoints, metres; None where one of them is not known.

    Raises:
        ArtifactError: a template that is none.
    """
    files = [path.parent / TEMPLATE_FILE for path in (dataset.manifest.path, prior.path)]
    if not all(file.exists() for file in files):
        return None
    one, other = (read_artifact(file, "preface/template")["keypoints"] for file in files)
    between = np.array([one[name] for name in one]) - np.array([other[name] for name in one])
    return float(np.sqrt((between**2).sum(axis=1).mean()))


def _person(dataset: Dataset, identity: str | None) -> int:
    names = dataset.names
    if identity in names:
        return names.index(identity)
    if identity is None and len(names) == 1:
        return 0
    problem = (
        f"holds {len(names)} identities, and none was chosen"
        if identity is None
        else f"knows no '{identity}'"
    )
    near = "Choose one by --identity" if identity is None else suggestion(identity, names)
    raise ArtifactError(dataset.manifest.path, "identities", problem, near)


def _view(dataset: Dataset, person: int, camera: str) -> int:
    entry = dataset.manifest.identities[person]
    known = [name for name in entry.cameras if name is not None]
    if camera not in known:
        problem = f"'{entry.identity}' has no view of a camera '{camera}', but {len(known)} others"
        raise ArtifactError(dataset.manifest.path, "cameras", problem, suggestion(camera, known))
    return entry.cameras.index(camera)


def _require_same_space(dataset: Dataset, identity: str, box: np.ndarray, prior: Prior) -> None:
    theirs = prior.scene.box
    if np.abs(box - theirs).max() <= SAME_PLACE:
        return
    wanted = " ".join(f"{number:g}" for number in theirs.reshape(-1))
    problem = (
        f"of '{identity}' is {box.tolist()}, and the prior in {prior.path.parent} lives in {theirs.tolist()}"
    )
    remedy = f"Build the shards with --box {wanted}, or use a prior that was trained on shards with this box"
    raise ArtifactError(dataset.manifest.path, "box", problem, remedy)


@dataclass(frozen=True, eq=False)
class PixelGrids:
    """A sampler whose step i is a grid of pixels of the i-th of some views.

    Attributes:
        index: to pick from.
        pairs: int64 [n, 2], identity and view.
        side: pixels along each axis, at most; all of them in smaller images.
    """

    index: ViewIndex
    pairs: np.ndarray
    side: int

    groups = 1

    def pick(self, step: int, rank: int, world: int) -> Pick:
        """The grid of a view, whoever asks."""
        x, y = (
            ((np.arange(min(self.side, size)) + 0.5) * size / min(self.side, size)).astype(np.int64)
            for size in (self.index.width, self.index.height)
        )
        identity, view = self.pairs[step : step + 1].T
        return self.index.pick(identity, view, (y[:, None] * self.index.width + x).reshape(1, -1))


def view_loader(data: TrainingData, sampler: Sampler, device: torch.device | str) -> Loader:
    """What forms a sampler's batches; pixels are read as they are needed, not those of everybody in the shards."""
    return Loader(data.dataset, sampler, device=device, placement="mmap", scale=data.scene.scene_scale)


def grids(data: TrainingData, side: int, device: torch.device | str = "cpu") -> list[Batch]:
    """A grid of pixels of each view fitted to."""
    loader = view_loader(data, PixelGrids(data.train, data.train.pairs, side), device)
    return [loader.batch(number) for number in range(len(data.train.pairs))]


def _check_seen(data: TrainingData, cameras: Sequence[str], views: Sequence[int]) -> None:
    """Refuse views without foreground, or whose foreground is not within the box."""
    names = dict(zip(views, cameras, strict=True))
    tables, path = data.dataset.tables, data.dataset.manifest.path
    for (person, view), batch in zip(data.train.pairs.tolist(), grids(data, _GRID), strict=True):
        who = f"view {names[view]} of '{data.names[0]}'"
        if tables["foreground_count"][person, view] == 0:
            remedy = "Build the shards with a mask of it, or choose another view"
            raise ArtifactError(
                path, "foreground_count", f"{who} has no foreground: nothing to fit to", remedy
            )
        weight = batch.alpha.sum()
        inside = float((batch.alpha * batch.hit).sum() / weight) if weight > 0 else float(batch.hit.any())
        if inside < _LEAST_INSIDE:
            problem = f"{who} sees its foreground outside the box ({inside:.0%} of it within)"
            remedy = "Check the camera's pose and the alignment, or choose another view"
            raise ArtifactError(path, "canonical_from_camera", problem, remedy)
