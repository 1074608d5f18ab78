"""Building a dataset of shards: one task per shard, claimed, repeatable; the manifest last.

    with claim(folder, number) as mine:                  # False: somebody else is at it
        if mine and not is_finished(folder, number, recipe):
            with ShardWriter(folder, number, size, "raster", recipe) as shard:
                ...
    build_manifest(folder, shards, splits, configuration, provenance)   # once all are there

A shard is a function of what is added to it and appears under its name as a whole. Hence claims only save
work: two processes that write one shard after all (on a file system without locks) write the same bytes.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError, sha256
from preface.shards.files import remove_leftovers
from preface.shards.format import shard_name
from preface.shards.manifest import MANIFEST_FILE, SCHEMA, SCHEMA_VERSION, write_manifest
from preface.shards.shard import Shard


@contextlib.contextmanager
def claim(folder: str | os.PathLike[str], number: int) -> Iterator[bool]:
    """Claim a shard among processes and machines; the claim ends with the process, however it ends.

    Yields:
        Whether the shard is ours. On a file system without locks it always is (see the header). What killed
        writers of the shard left behind is removed.

    Raises:
        ArtifactError: the folder does not allow a file.
    """
    with _claimed(Path(folder) / shard_name(number)) as mine:
        yield mine


@contextlib.contextmanager
def _claimed(path: Path) -> Iterator[bool]:
    """Claim a file that is to be written, as `claim` does."""
    try:
        descriptor = os.open(
            path.with_name(f".{path.name}.claim"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666
        )
    except OSError as error:
        raise ArtifactError.from_os(path, "writing", error) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        except OSError:  # no locks here
            yield True
            return
        remove_leftovers(path)
        yield True
    finally:
        os.close(descriptor)


def is_finished(folder: str | os.PathLike[str], number: int, recipe: str) -> bool:
    """Whether a shard is there, was made by this recipe, and every byte of it is what was written.

    A shard of another recipe or with an error is removed, and the manifest with it, since neither is true.
    """
    path = Path(folder) / shard_name(number)
    if not path.exists():
        return False
    try:
        with Shard(path) as shard:
            problems = shard.problems()
            if not problems and shard.recipe == recipe:
                return True
    except ArtifactError:
        pass
    path.with_name(MANIFEST_FILE).unlink(missing_ok=True)
    path.unlink(missing_ok=True)
    return False


def build_manifest(
    folder: str | os.PathLike[str],
    shards: int,
    splits: Mapping[str, Sequence[str]],
    configuration: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> Path:
    """Verify shards 0 to `shards` - 1 and write the manifest; claims and leftovers are removed.

    Args:
        folder: of the dataset.
        shards: how many there are.
        splits: name -> identities, each in exactly one.
        configuration: of the builder, JSON types.
        provenance: as `preface.artifacts.provenance` returns it.

    Raises:
        ArtifactError: a shard is missing, damaged or unlike the first, or the disk refuses.
    """
    folder = Path(folder)
    entries, boxes, first = [], [], None
    for number in range(shards):
        with Shard(folder / shard_name(number)) as shard:
            damaged = shard.problems()
            if damaged:
                raise damaged[0]
            first = first or shard.layout
            for name in ("views", "width", "height", "pixel_order"):
                ours, theirs = getattr(shard.layout, name), getattr(first, name)
                if ours != theirs:
                    problem = f"is {ours}, and {theirs} in the first shard"
                    raise ArtifactError(shard.path, name, problem, "Build all shards alike")
            boxes.append(shard.tables["box"])
            entries.append(_manifest_entry(shard))
    if first is None:
        raise ArtifactError(folder, "shards", "there are none", "Build at least one")
    box = np.stack([np.concatenate(boxes)[:, 0].min(0), np.concatenate(boxes)[:, 1].max(0)])
    payload = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "resolution": {"width": first.width, "height": first.height},
        "views": first.views,
        "pixel_order": first.pixel_order,
        "box": box,
        "scene_scale": 2 / float((box[1] - box[0]).max()),
        "splits": {name: list(names) for name, names in splits.items()},
        "shards": entries,
        "configuration": dict(configuration),
        "provenance": dict(provenance),
    }
    with _claimed(folder / MANIFEST_FILE):
        path = write_manifest(folder, payload)
    for number in range(shards):
        with claim(folder, number):
            pass  # taking a claim removes what killed writers left, and nothing of writers that live
    for name in [MANIFEST_FILE, *(shard_name(number) for number in range(shards))]:
        (folder / f".{name}.claim").unlink(missing_ok=True)
    return path


def _manifest_entry(shard: Shard) -> dict[str, Any]:
    checksums = shard.tables["view_crc32c"].tolist()
    people = [{**person, "crc32c": crcs} for person, crcs in zip(shard.people, checksums, strict=True)]
    return {
        "file": shard.path.name,
        "bytes": shard.layout.file_bytes,
        "sha256": sha256(shard.path),
        "tables_crc32c": int(shard.tables["tables_crc32c"][0]),
        "identities": people,
    }
