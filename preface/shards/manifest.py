"""``manifest.json``: what a folder of shards holds. Written last, so that a folder that has one is complete.

See ``data_specs/shards.md``. Reading needs the standard library only: what follows is checked here, without
jsonschema, and the manifest's own digest covers every byte of it. `preface-inspect` checks the schema too.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import (
    ArtifactError,
    json_types,
    load_json,
    resolve_inside,
    validate,
    write_bytes,
)
from preface.plain_words import json_text
from preface.shards.checksums import NO_DIGEST, text_digest
from preface.shards.format import PIXEL_ORDERS, PixelOrder, shard_name

SCHEMA, SCHEMA_VERSION = "preface/shards", 1
MANIFEST_FILE = "manifest.json"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_RESTORE = "Restore the file from a copy, or build the shards again"


@dataclass(frozen=True)
class IdentityEntry:
    """An identity of a shard.

    Attributes:
        identity, take: names.
        cameras: name of each view's camera, None where the identity has no such view.
        crc32c: of each view's pixels.
        sources: per view the source's name and SHA-256, None where there is none.
        metadata: of the capture, free.
    """

    identity: str
    take: str
    cameras: tuple[str | None, ...]
    crc32c: tuple[int, ...]
    sources: tuple[Mapping[str, str] | None, ...]
    metadata: Mapping[str, Any]


@dataclass(frozen=True)
class ShardEntry:
    """A shard: its file beside the manifest, what must be found there, and who is in it."""

    file: str
    bytes: int
    sha256: str
    tables_crc32c: int
    identities: tuple[IdentityEntry, ...]


@dataclass(frozen=True, eq=False)
class Manifest:
    """A folder of shards.

    Attributes:
        path: the manifest's file.
        width, height: of all views, pixels.
        views: V, the most views of an identity.
        pixel_order: see `preface.shards.format`.
        box: float64 [2, 3], corners of the box around all, canonical frame, metres.
        scene_scale: 1 / longest half side of the box, 1/metre: what the model multiplies lengths with.
        splits: name -> identities, each identity in exactly one.
        shards: in the order of their numbers.
        configuration, provenance: how the shards were made.
    """

    path: Path
    width: int
    height: int
    views: int
    pixel_order: PixelOrder
    box: np.ndarray
    scene_scale: float
    splits: Mapping[str, tuple[str, ...]]
    shards: tuple[ShardEntry, ...]
    configuration: Mapping[str, Any]
    provenance: Mapping[str, Any]

    @property
    def identities(self) -> tuple[IdentityEntry, ...]:
        """All identities in the order of their numbers."""
        return tuple(entry for shard in self.shards for entry in shard.identities)


def write_manifest(folder: str | os.PathLike[str], payload: Mapping[str, Any]) -> Path:
    """Add the digest to a manifest's content, validate it and write it atomically.

    Raises:
        ArtifactError: the content is no manifest, or the disk refuses.
    """
    path = Path(folder) / MANIFEST_FILE
    content = json_types({**payload, "digest": NO_DIGEST}, path, "")
    validate(content, path, SCHEMA)
    blank = f"{json_text(content)}\n".encode()
    declared, digest = text_digest(blank)
    if declared != NO_DIGEST:
        raise ArtifactError(path, "configuration", "contains what reads as a digest", "Rename that key")
    return write_bytes(
        path, blank.replace(f'"digest": "{NO_DIGEST}"'.encode(), f'"digest": "{digest}"'.encode())
    )


def read_manifest(path: str | os.PathLike[str]) -> Manifest:
    """Read ``manifest.json``, or that of a folder.

    Raises:
        ArtifactError: unreadable, of a future version, changed since it was written, or not consistent.
    """
    path = Path(path) / MANIFEST_FILE if Path(path).is_dir() else Path(path)
    payload = load_json(path)
    _check_kind(path, payload)
    _check_digest(path)
    try:
        manifest = _parse(path, payload)
    except (KeyError, TypeError, ValueError) as error:
        problem = f"is not a manifest of version {SCHEMA_VERSION} ({type(error).__name__}: {error})"
        raise ArtifactError(path, "file", problem, _RESTORE) from error
    _check_names(manifest)
    return manifest


def _check_kind(path: Path, payload: Mapping[str, Any]) -> None:
    if payload.get("schema") != SCHEMA:
        problem = f"is {payload.get('schema')!r}"
        raise ArtifactError(path, "schema", problem, f"A manifest of shards says {SCHEMA!r}")
    version = payload.get("schema_version")
    if isinstance(version, int) and version > SCHEMA_VERSION:
        problem = f"is {version}, but this preface knows versions up to {SCHEMA_VERSION}"
        raise ArtifactError(path, "schema_version", problem, "Upgrade preface to read this file")
    if type(version) is not int or version != SCHEMA_VERSION:
        raise ArtifactError(path, "schema_version", f"is {version!r}", f"Write {SCHEMA_VERSION}")


def _check_digest(path: Path) -> None:
    try:
        declared, actual = text_digest(path.read_bytes())
    except OSError as error:
        raise ArtifactError.from_os(path, "reading", error) from error
    if declared != actual:
        problem = (
            f"is {declared}, and that of the text is {actual}: the file was changed since it was written"
        )
        raise ArtifactError(path, "digest", problem, _RESTORE)


def _parse(path: Path, payload: Mapping[str, Any]) -> Manifest:
    resolution, box = payload["resolution"], np.array(payload["box"], dtype=np.float64)
    if payload["pixel_order"] not in PIXEL_ORDERS:
        raise ValueError(f"pixel_order {payload['pixel_order']!r} is unknown")
    if box.shape != (2, 3) or not (np.isfinite(box).all() and (box[0] < box[1]).all()):
        raise ValueError(f"box {payload['box']} has no two corners with the smaller one first")
    return Manifest(
        path=path,
        width=int(resolution["width"]),
        height=int(resolution["height"]),
        views=int(payload["views"]),
        pixel_order=payload["pixel_order"],
        box=box,
        scene_scale=float(payload["scene_scale"]),
        splits={name: tuple(names) for name, names in payload["splits"].items()},
        shards=tuple(_parse_shard(shard) for shard in payload["shards"]),
        configuration=payload["configuration"],
        provenance=payload["provenance"],
    )


def _parse_shard(shard: Mapping[str, Any]) -> ShardEntry:
    identities = tuple(
        IdentityEntry(
            identity=entry["identity"],
            take=entry["take"],
            cameras=tuple(entry["cameras"]),
            crc32c=tuple(entry["crc32c"]),
            sources=tuple(entry["sources"]),
            metadata=entry["metadata"],
        )
        for entry in shard["identities"]
    )
    sizes = int(shard["bytes"]), int(shard["tables_crc32c"])
    return ShardEntry(shard["file"], sizes[0], shard["sha256"], sizes[1], identities)


def _check_names(manifest: Manifest) -> None:
    """Refuse names that are unsafe or double, and splits that do not divide the identities."""

    def refuse(field: str, problem: str) -> ArtifactError:
        return ArtifactError(manifest.path, field, problem, "Build the shards again with other names")

    seen: dict[str, str] = {}
    for entry in manifest.identities:
        check_name(manifest.path, entry.identity)
        if entry.identity.casefold() in seen:
            raise refuse(
                "identities", f"{entry.identity!r} is there twice, upper and lower case being the same"
            )
        seen[entry.identity.casefold()] = entry.identity
        if len(entry.cameras) != manifest.views or len(entry.crc32c) != manifest.views:
            raise refuse(f"identities.{entry.identity}", f"does not list {manifest.views} views")
    for number, shard in enumerate(manifest.shards):
        if shard.file != shard_name(number):
            raise refuse(f"shards[{number}].file", f"is {shard.file!r} instead of {shard_name(number)!r}")
        resolve_inside(manifest.path, f"shards[{number}].file", shard.file)
    divided = sorted(name for names in manifest.splits.values() for name in names)
    if divided != sorted(seen.values()):
        raise refuse("splits", "do not hold each identity exactly once")


def check_name(path: Path, name: str) -> None:
    """Refuse an identity's name that is no safe file name.

    Raises:
        ArtifactError: naming `path`.
    """
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        problem = f"{name!r} has characters other than letters, digits, '.', '_', '-', or none, or over 100"
        raise ArtifactError(path, "identities", problem, "Rename the identity in the capture")
