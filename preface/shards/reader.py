"""A dataset of shards: open it, look at its views, verify it.

    dataset = Dataset("shards/")
    dataset.pixels(3, 0)                    # [H, W, 4] of the fourth identity's first view
    dataset.verify()                        # [] if every byte is what was written

Opening checks the manifest and its digest, the structure of every shard, and the checksums of all tables.
The pixels of a view are checked at their first touch, `verify` checks everything. What is guaranteed when a
file changes while it is open stands in `preface.shards.files`.
"""

from __future__ import annotations

import os
from types import TracebackType

import numpy as np
import torch

from preface.artifacts import ArtifactError
from preface.shards.format import PAGE
from preface.shards.manifest import read_manifest
from preface.shards.rays import LensError, RayTable
from preface.shards.samplers import ViewIndex
from preface.shards.shard import Shard
from preface.shards.streams import permutation

_RESTORE = "Restore the files from a copy, or build the shards again"


class Dataset:
    """A folder of shards, opened.

    Identities are numbered 0 to N - 1 in the order of the manifest, views 0 to V - 1 within each.

    Args:
        path: the folder, or its ``manifest.json``.

    Attributes:
        manifest: see `preface.shards.manifest.Manifest`.
        names: of the identities.
        shards: opened.
        shard_of, place_of: int64 [N], the shard that an identity is in, and its number there.
        tables: name -> array [N, ...], the tables of all shards (see `preface.shards.format`).

    Raises:
        ArtifactError: the manifest or a shard is missing, malformed, damaged, or does not fit the others.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.manifest = read_manifest(path)
        self.shards: list[Shard] = []
        try:
            for number in range(len(self.manifest.shards)):
                self.shards.append(self._open(number))
        except BaseException:
            self.close()
            raise
        if not self.shards:
            raise ArtifactError(self.manifest.path, "shards", "there are none", "Build the shards again")
        self.names = tuple(entry.identity for entry in self.manifest.identities)
        sizes = [shard.layout.identities for shard in self.shards]
        self.shard_of = np.repeat(np.arange(len(sizes)), sizes)
        self.place_of = np.concatenate([np.arange(size) for size in sizes])
        per_identity = [n for n in self.shards[0].tables if n not in ("notes", "tables_crc32c")]
        self.tables = {
            name: np.concatenate([shard.tables[name] for shard in self.shards]) for name in per_identity
        }

    def _open(self, number: int) -> Shard:
        """Open a shard and hold it against the manifest."""
        entry, manifest = self.manifest.shards[number], self.manifest
        shard = Shard(manifest.path.parent / entry.file)
        layout = shard.layout
        expected = (manifest.width, manifest.height, manifest.views, manifest.pixel_order)
        same = (
            (layout.width, layout.height, layout.views, layout.pixel_order) == expected
            and layout.file_bytes == entry.bytes
            and int(shard.tables["tables_crc32c"][0]) == entry.tables_crc32c
            and [person["identity"] for person in shard.people] == [e.identity for e in entry.identities]
            and shard.tables["view_crc32c"].tolist() == [list(e.crc32c) for e in entry.identities]
        )
        if not same:
            shard.close()
            raise ArtifactError(shard.path, "file", "is not the one that the manifest describes", _RESTORE)
        return shard

    def __enter__(self) -> Dataset:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        for shard in self.shards:
            shard.close()

    def __len__(self) -> int:
        return len(self.names)

    @property
    def pixel_bytes(self) -> int:
        """Bytes of all pixels."""
        return sum(shard.layout.offsets["pixels"][1] for shard in self.shards)

    @property
    def bytes_per_ray(self) -> float:
        """Bytes of all shards by the number of their pixels."""
        return sum(shard.layout.file_bytes for shard in self.shards) / (self.pixel_bytes / 4)

    def identities_of(self, split: str) -> np.ndarray:
        """The numbers of a split's identities, int64.

        Raises:
            KeyError: the manifest has no such split.
        """
        wanted = set(self.manifest.splits[split])
        return np.flatnonzero([name in wanted for name in self.names])

    def index(self, split: str | None = None) -> ViewIndex:
        """What samplers choose from: all identities, or those of a split."""
        order = self.manifest.pixel_order
        boxes, valid = self.tables["foreground_box"], self.tables["view_valid"] == 1
        everything = ViewIndex(valid, self.manifest.width, self.manifest.height, order, boxes)
        return everything if split is None else everything.only(self.identities_of(split))

    def pixels(self, identity: int, view: int) -> np.ndarray:
        """The image of a view, uint8 [H, W, 4], checked against its checksum.

        Raises:
            ArtifactError: the pixels are not what was written, or cannot be read.
        """
        shard = self.shards[self.shard_of[identity]]
        stored = shard.read_view(int(self.place_of[identity]), view)
        if self.manifest.pixel_order == "permuted":
            stored = stored[permutation(len(stored))[1]]
        return stored.reshape(self.manifest.height, self.manifest.width, 4)

    def ray_table(self, scale: float, device: torch.device) -> RayTable:
        """The table that rays of all views are formed from, column identity * V + view.

        Args:
            scale: 1 for metres, or the manifest's `scene_scale` for the model's units.
            device: where rays are formed.

        Raises:
            ArtifactError: a lens folds inside its image.
        """
        tables = self.tables
        missing = (tables["view_valid"] == 0)[..., None]
        # A missing view is never sampled; it gets a camera only so that the table has no infinities.
        intrinsics = np.where(missing, np.eye(1, 12)[0] + np.eye(1, 12, 1)[0], tables["intrinsics"])
        views = self.manifest.views
        try:
            return RayTable.build(
                intrinsics.reshape(-1, 12),
                tables["canonical_from_camera"].reshape(-1, 3, 4),
                np.repeat(tables["box"], views, axis=0),
                tables["near_far"].reshape(-1, 2),
                (self.manifest.width, self.manifest.height),
                scale,
                device,
            )
        except LensError as error:
            raise ArtifactError(
                self.manifest.path, "intrinsics", str(error), "Build the shards again"
            ) from error

    def map(self, number: int) -> np.ndarray:
        """The pixels of a shard mapped into memory, int32 [K * V * H * W], read-only and not yet checked."""
        shard = self.shards[number]
        return shard.file.map(PAGE, shard.layout.offsets["pixels"][1]).view("<i4")

    def verify(self) -> list[ArtifactError]:
        """Read every byte again and list what is not as it was written."""
        problems: list[ArtifactError] = []
        try:
            read_manifest(self.manifest.path)
        except ArtifactError as error:
            problems.append(error)
        for entry, shard in zip(self.manifest.shards, self.shards, strict=True):
            try:
                with Shard(shard.path) as again:
                    problems += again.problems(entry.sha256)
            except ArtifactError as error:
                problems.append(error)
        return problems


def verify(path: str | os.PathLike[str]) -> list[ArtifactError]:
    """Read every byte of a dataset and list what is wrong with it; empty if nothing is."""
    try:
        with Dataset(path) as dataset:
            return dataset.verify()
    except ArtifactError as error:
        return [error]
