"""One task: build one shard, unless it is finished or somebody else is at it. It may run anywhere, any number of times.

A task is described by a `ShardTask` and done by `run_task`, a plain function of it: a pool of processes, Dask and a
Slurm array all call the same one. Its recipe is a digest of all that decides the shard's bytes: sources (by their
SHA-256), cameras, alignment, configuration, and the versions of what touches pixels. A finished shard of the same
recipe is verified and kept; one of another recipe is built anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError, sha256
from preface.shards.building import claim, is_finished
from preface.shards.dataset.heads import HeadMaker
from preface.shards.dataset.people import LeftOut, Person, View
from preface.shards.dataset.plan import ShardTask
from preface.shards.format import shard_name
from preface.shards.shard import Shard
from preface.shards.writer import ShardWriter

# Raise this when the builder makes other bytes of the same inputs: all shards are then built anew.
BUILDER = 4
# What touches pixels; an upgrade may change their last bit.
PACKAGES = ("opencv-contrib-python-headless", "OpenEXR", "mediapipe", "onnxruntime", "numpy")


@dataclass(frozen=True)
class TaskResult:
    """What became of a task.

    Attributes:
        number: of the shard.
        state: "built", "kept" (it was finished), "claimed" (somebody else is at it), or "empty" (not one of its
            people can be used, and there is no shard).
        identities: who is in the shard, in its order.
        left_out: people and views that are not.
        sha256: of the shard, empty if there is none.
    """

    number: int
    state: str
    identities: tuple[str, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    sha256: str = ""


def run_task(task: ShardTask) -> TaskResult:
    """Build a shard; see the header of this file.

    Raises:
        ArtifactError: a source changed while it was read, the disk refuses, or, with `strict`, something cannot be
            used.
    """
    with claim(task.folder, task.number) as mine:
        if not mine:
            return TaskResult(task.number, "claimed")
        sources = _Sources(task)
        recipe = recipe_of(task, sources.digests)
        maker = HeadMaker(task.configuration, task.choices)
        if is_finished(task.folder, task.number, recipe):
            kept = _kept(task, sources, maker)
            if kept is not None:
                return kept
            (task.folder / shard_name(task.number)).unlink()
        return _build(task, sources, maker, recipe)


def _build(task: ShardTask, sources: _Sources, maker: HeadMaker, recipe: str) -> TaskResult:
    left_out: list[LeftOut] = []
    built: list[str] = []
    path = task.folder / shard_name(task.number)
    writer = ShardWriter(
        task.folder, task.number, task.configuration.size, task.configuration.pixel_order, recipe
    )
    try:
        with writer as shard:
            for person in task.people:
                head, missing = maker.make(sources.without_changed(person), task.cameras, sources.digests)
                sources.check(person)
                missing = [*sources.changed(person), *missing]
                if missing and task.strict:
                    raise strict_error(path, missing[0])
                left_out += missing
                if head is not None:
                    shard.add(head)
                    built.append(person.identity)
            if not built:
                raise _EmptyShardError
    except _EmptyShardError:
        return TaskResult(task.number, "empty", (), tuple(left_out))
    return TaskResult(task.number, "built", tuple(built), tuple(left_out), sha256(path))


class _EmptyShardError(Exception):
    """Nobody is left for a shard; raised through the writer, which then leaves nothing behind."""


def _kept(task: ShardTask, sources: _Sources, maker: HeadMaker) -> TaskResult | None:
    """The result of a shard that was finished before; None if it lacks somebody who can be used now."""
    path = task.folder / shard_name(task.number)
    with Shard(path) as shard:
        people = {entry["identity"]: entry["metadata"] for entry in shard.people}
    left_out: list[LeftOut] = []
    for person in task.people:
        if person.identity in people:
            reasons = people[person.identity].get("left_out", {})
            known = {view.camera for view in person.views}
            left_out += [LeftOut(person.identity, c, why) for c, why in reasons.items() if c in known]
            continue
        head, missing = maker.make(sources.without_changed(person), task.cameras, sources.digests)
        if head is not None:  # what failed was the disk or the network, not the photographs
            return None
        left_out += [*sources.changed(person), *missing]
    if left_out and task.strict:
        raise strict_error(path, left_out[0])
    return TaskResult(task.number, "kept", tuple(people), tuple(left_out), sha256(path))


def strict_error(path: Path, left_out: LeftOut) -> ArtifactError:
    """What --strict stops with; `path` is that of the shard or the capture."""
    field = left_out.identity if left_out.camera is None else f"{left_out.identity}.{left_out.camera}"
    remedy = "Correct that, or build without --strict to leave it out"
    return ArtifactError(path, field, left_out.reason.rstrip("."), remedy)


# ---------------------------------------------------------------------------------------- sources


class _Sources:
    """The files of a task: their digests, and whether they are still the files that were digested."""

    def __init__(self, task: ShardTask):
        self._states: dict[Path, tuple[int, ...]] = {}
        self.digests: dict[Path, str] = {}
        for person in task.people:
            for file in _files(person):
                if file not in self.digests:
                    self._states[file] = _state(file)
                    self.digests[file] = sha256(file)

    def check(self, person: Person) -> None:
        """Raise ArtifactError if a file of a person was written to since it was digested."""
        for file in _files(person):
            if _state(file) != self._states[file]:
                raise ArtifactError(
                    file, "file", "changed while it was read", "Run again when it is complete"
                )

    def changed(self, person: Person) -> list[LeftOut]:
        """The views whose photographs are not those that were aligned."""
        reason = "the photograph has changed since it was aligned; run preface-align again"
        return [LeftOut(person.identity, v.camera, reason) for v in person.views if self._is_changed(v)]

    def without_changed(self, person: Person) -> Person:
        """The person without those views, which are named in the metadata."""
        missing = {entry.camera: entry.reason for entry in self.changed(person) if entry.camera}
        views = tuple(view for view in person.views if view.camera not in missing)
        return replace(person, views=views, left_out={**person.left_out, **missing})

    def _is_changed(self, view: View) -> bool:
        return view.aligned_sha256 not in (None, self.digests[view.photograph])


def _files(person: Person) -> list[Path]:
    named = [(view.photograph, view.mask, view.plate) for view in person.views]
    return [file for files in named for file in files if file is not None]


def _state(file: Path) -> tuple[int, ...]:
    try:
        status = file.stat()
    except OSError as error:
        raise ArtifactError.from_os(file, "file", error) from error
    return status.st_ino, status.st_size, status.st_mtime_ns


# ----------------------------------------------------------------------------------------- recipe


def recipe_of(task: ShardTask, digests: Mapping[Path, str]) -> str:
    """The digest of all that decides a shard's bytes, 64 hexadecimal digits."""
    content = {
        "builder": BUILDER,
        "packages": {name: _version(name) for name in PACKAGES},
        "configuration": task.configuration.content(),
        "cameras": task.cameras,
        "foreground": {
            take: [choice.method, choice.background_kind, choice.given_first]
            for take, choice in task.choices.items()
            if take in {person.take for person in task.people}
        },
        "people": [_described(person, digests) for person in task.people],
    }
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _described(person: Person, digests: Mapping[Path, str]) -> dict[str, Any]:
    return {
        "identity": person.identity,
        "take": person.take,
        "canonical_from_rig": _digits(person.canonical_from_rig.matrix),
        "keypoints": _digits(person.keypoints),
        "metadata": person.metadata,
        "left_out": person.left_out,
        "views": [
            {
                "camera": view.camera,
                "name": view.name,
                "lens": [view.rig_camera.camera.model, _digits(view.rig_camera.camera.params)],
                "pose": _digits(view.rig_camera.camera_from_rig.matrix),
                "aligned": view.aligned_sha256,
                "files": [f and digests[f] for f in (view.photograph, view.mask, view.plate)],
            }
            for view in person.views
        ],
    }


def _digits(numbers: np.ndarray) -> str:
    return np.asarray(numbers, "<f8").tobytes().hex()


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def use_one_thread() -> None:
    """Let OpenCV of this process compute on one thread: processes are as many as cores."""
    import cv2

    cv2.setNumThreads(1)
