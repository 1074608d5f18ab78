"""The files of an alignment: ``template.json``, ``<identity>.json`` for each person, and the index.

See ``data_specs/alignment.md``, ``template.md`` and ``alignment-index.md``. The index, ``alignment.json``, is written
last: a folder that has one is complete.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.placement import Placement
from preface.align.subject import SubjectAlignment
from preface.align.template import Template
from preface.artifacts import ArtifactError, read_artifact, write_artifact
from preface.geometry import GeometryError, Rigid

TEMPLATE_SCHEMA = "preface/template"
INDEX_SCHEMA = "preface/alignment-index"
TEMPLATE_FILE, INDEX_FILE = "template.json", "alignment.json"
# How far the mean of a template's keypoints may be from the origin, in shares of its size: digits of a hand.
CENTRED = 1e-3


# ---------------------------------------------------------------------------------- template


def write_template(path: str | os.PathLike[str], template: Template) -> Path:
    """Write ``template.json`` atomically.

    Raises:
        ArtifactError: the disk refuses.
    """
    content: dict[str, Any] = {
        "schema": TEMPLATE_SCHEMA,
        "schema_version": 1,
        "units": "metre",
        "scheme": template.scheme,
        "keypoints": by_keypoint(template.keypoints),
        "spread": by_keypoint(template.spread),
        "canonical_from_rig": {
            "quaternion_wxyz": template.canonical_from_rig.quaternion_wxyz,
            "translation": template.canonical_from_rig.translation,
        },
        "procrustes": template.procrustes,
        "identities": template.identities,
    }
    if template.provenance is not None:
        content["provenance"] = template.provenance
    if template.metadata:
        content["metadata"] = template.metadata
    return write_artifact(path, content)


def read_template(path: str | os.PathLike[str]) -> Template:
    """Read a template: ``template.json``, or the folder of an alignment.

    Raises:
        ArtifactError: malformed, a pose that is none, or keypoints whose mean is not the origin.
    """
    path = Path(path) / TEMPLATE_FILE if Path(path).is_dir() else Path(path)
    payload = read_artifact(path, TEMPLATE_SCHEMA)
    keypoints = np.array([payload["keypoints"][name] for name in CANONICAL_KEYPOINTS], dtype=np.float64)
    size = np.linalg.norm(keypoints - keypoints.mean(0), axis=-1).max()
    if not np.linalg.norm(keypoints.mean(0)) <= CENTRED * size:
        problem = f"their mean is {np.round(keypoints.mean(0), 6).tolist()}, not the origin"
        raise ArtifactError(path, "keypoints", problem, "Give them in the canonical frame")
    pose = payload["canonical_from_rig"]
    try:
        canonical_from_rig = Rigid.from_quaternion(pose["quaternion_wxyz"], pose["translation"])
    except GeometryError as error:
        name, _, rest = str(error).partition(": ")
        problem, _, remedy = rest.partition("; ")
        raise ArtifactError(
            path, f"canonical_from_rig.{name}", problem, remedy.capitalize() or "Correct it"
        ) from error
    return Template(
        scheme=payload["scheme"],
        keypoints=keypoints,
        canonical_from_rig=canonical_from_rig,
        identities=tuple(payload["identities"]),
        procrustes=payload["procrustes"],
        spread=np.array([payload["spread"][name] for name in CANONICAL_KEYPOINTS], dtype=np.float64),
        provenance=payload.get("provenance"),
        metadata=payload.get("metadata", {}),
    )


def by_keypoint(values: np.ndarray) -> dict[str, Any]:
    """Name -> value of those of five values that are finite."""
    named = zip(CANONICAL_KEYPOINTS, np.asarray(values), strict=True)
    return {name: value.tolist() for name, value in named if np.isfinite(value).all()}


def from_keypoints(payload: Mapping[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    """The inverse of `by_keypoint`: [5, *shape], NaN where there is none."""
    values = np.full((len(CANONICAL_KEYPOINTS), *shape), np.nan)
    for index, name in enumerate(CANONICAL_KEYPOINTS):
        if name in payload:
            values[index] = payload[name]
    return values


# ------------------------------------------------------------------------------------- index


@dataclass(frozen=True)
class AlignedEntry:
    """A person who is aligned.

    Attributes:
        identity, take: their names.
        file: relative to the index.
        views: ids of the cameras that are used.
        keypoints: names of those that the person has.
        flags: codes of what is odd.
    """

    identity: str
    take: str
    file: str
    views: tuple[str, ...]
    keypoints: tuple[str, ...]
    flags: tuple[str, ...]

    @staticmethod
    def of(identity: str, take: str, subject: SubjectAlignment, placement: Placement) -> AlignedEntry:
        """The entry of a person."""
        named = zip(CANONICAL_KEYPOINTS, subject.keypoints.good, strict=True)
        return AlignedEntry(
            identity=identity,
            take=take,
            file=alignment_file(identity),
            views=subject.cameras,
            keypoints=tuple(name for name, good in named if good),
            flags=tuple(flag.code for flag in placement.flags),
        )


@dataclass(frozen=True)
class ExcludedEntry:
    """A person who is not, and why, as part of a sentence."""

    identity: str
    take: str
    reason: str


@dataclass(frozen=True)
class AlignmentIndex:
    """Who is in an alignment and who is not, in the manifest's order.

    Attributes:
        scheme: the landmark scheme of all.
        aligned, excluded: people.
        warnings: whole sentences for the user.
    """

    scheme: str
    aligned: tuple[AlignedEntry, ...]
    excluded: tuple[ExcludedEntry, ...]
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, Any] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)


def alignment_file(identity: str) -> str:
    """The name of a person's file.

    Raises:
        ArtifactError: the name is that of another file of the folder.
    """
    name = f"{identity}.json"
    if name.casefold() in (TEMPLATE_FILE, INDEX_FILE):
        problem = f"'{identity}' is the name of another file of an alignment"
        raise ArtifactError(name, "identity", problem, "Rename the person in the capture")
    return name


def write_index(folder: str | os.PathLike[str], index: AlignmentIndex) -> Path:
    """Write ``alignment.json`` into the folder of an alignment, atomically and after all else.

    Raises:
        ArtifactError: a name twice, a file that is not there, or the disk refuses.
    """
    path = Path(folder) / INDEX_FILE
    _check_names(path, _names(index.aligned, index.excluded))
    for place, file in enumerate([TEMPLATE_FILE, *(entry.file for entry in index.aligned)]):
        if not (path.parent / file).is_file():
            where = f"aligned[{place - 1}].file" if place else "template"
            raise ArtifactError(path, where, f"there is no {file}", "Write it before the index")
    content: dict[str, Any] = {
        "schema": INDEX_SCHEMA,
        "schema_version": 1,
        "scheme": index.scheme,
        "template": TEMPLATE_FILE,
        "aligned": [vars(entry) for entry in index.aligned],
        "excluded": [vars(entry) for entry in index.excluded],
    }
    for key in ("warnings", "provenance", "metadata"):
        if getattr(index, key):
            content[key] = getattr(index, key)
    return write_artifact(path, content)


def read_index(path: str | os.PathLike[str]) -> AlignmentIndex:
    """Read ``alignment.json``, or that of a folder.

    Raises:
        ArtifactError: malformed, a name twice, or a file of it that is missing.
    """
    path = Path(path) / INDEX_FILE if Path(path).is_dir() else Path(path)
    payload = read_artifact(path, INDEX_SCHEMA)
    aligned = tuple(AlignedEntry(**_tuples(entry)) for entry in payload["aligned"])
    excluded = tuple(ExcludedEntry(**entry) for entry in payload["excluded"])
    _check_names(path, _names(aligned, excluded))
    for place, entry in enumerate(aligned):
        if not (path.parent / entry.file).is_file():
            problem = f"there is no {entry.file}"
            raise ArtifactError(
                path, f"aligned[{place}].file", problem, "Copy the whole folder, or align again"
            )
    return AlignmentIndex(
        payload["scheme"],
        aligned,
        excluded,
        tuple(payload.get("warnings", ())),
        payload.get("provenance"),
        payload.get("metadata", {}),
    )


def _names(aligned: Sequence[AlignedEntry], excluded: Sequence[ExcludedEntry]) -> list[str]:
    return [entry.identity for entry in aligned] + [entry.identity for entry in excluded]


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _check_names(path: Path, names: Sequence[str]) -> None:
    folded = [name.casefold() for name in names]
    for index, name in enumerate(folded):
        if name in folded[:index]:
            problem = f"'{names[index]}' appears twice, or differs from another in case only"
            raise ArtifactError(path, "identity", problem, "Remove one or rename it")
