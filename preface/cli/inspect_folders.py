"""Which artefacts `preface-inspect` finds at a path: in a folder by their names, else by what they say of themselves.

A folder that holds none of the names that commands read, such as that of an evaluation, an export, or the photographs
of a head, stands for what lies in it and one level below.
"""

import os
from collections.abc import Iterator
from pathlib import Path

from preface.artifacts import ArtifactError, load_json
from preface.cli.inspect_exports import RAYS, TRANSFORMS, TRANSFORMS_FILE, is_rays, is_transforms

Found = list[tuple[Path, str | None]]

# What files of these names in a folder are.
_NAMES = {
    "capture.json": "preface/capture",
    "corners.json": "preface/corners",
    "rig.json": "preface/rig",
    "alignment.json": "preface/alignment-index",
    "template.json": "preface/template",
    "manifest.json": "preface/shards",
    "model.json": "preface/prior",
    "metrics.json": "preface/metrics",
}
_SHARDS = "shard-*.safetensors"


def artifacts_at(path: Path) -> Found:
    """The artefacts at a path and their schemas, None where that is not known yet.

    Raises:
        ArtifactError: a folder without any.
    """
    if not path.is_dir():
        return [(path, _kind_of_file(path))]
    found = _named(path)
    if not found and list(path.glob(_SHARDS)):
        problem = "holds shards and no manifest.json: building was not finished"
        raise ArtifactError(path, "folder", problem, "Run preface-build-shards again")
    if all(schema == "preface/template" for _, schema in found):  # it lies beside much
        found += [entry for entry in _further(path) if entry not in found]
    if not found:
        problem = f"holds none of {', '.join(_NAMES)}, nor a folder subjects, and neither do its folders"
        perhaps = _json_files(path)  # which do not say what they are
        such = f", such as {perhaps[0]}" if perhaps else ""
        raise ArtifactError(path, "folder", problem, f"Name an artefact or the folder that holds it{such}")
    return found


def _kind_of_file(path: Path) -> str | None:
    if path.match(_SHARDS):
        return "preface/shard"
    if is_rays(path):
        return RAYS
    return TRANSFORMS if path.name == TRANSFORMS_FILE and is_transforms(path) else None


def _named(path: Path) -> Found:
    """The artefacts in a folder whose names say what they are."""
    found: Found = [(path / name, schema) for name, schema in _NAMES.items() if os.path.lexists(path / name)]
    # Shards and the priors trained on them carry a copy of the alignment's template, which is not what is meant.
    if list(path.glob(_SHARDS)) or os.path.lexists(path / "model.json"):
        found = [entry for entry in found if entry[1] != "preface/template"]
    if (path / "subjects").is_dir() and not os.path.lexists(path / "capture.json"):
        found.insert(0, (path, "preface/capture"))  # its manifest is inferred
    return found


def _further(folder: Path) -> Iterator[tuple[Path, str | None]]:
    """What files of any name say that they are, and what folders below hold."""
    for file in _json_files(folder):
        schema = _declared(file)
        if schema is not None:
            yield file, schema
    yield from ((file, RAYS) for file in sorted(folder.glob("*.safetensors")) if is_rays(file))
    for below in sorted(entry for entry in folder.iterdir() if entry.is_dir()):
        yield from _named(below)
    # Of a folder per person, as nerfstudio has them, and of the folder of one.
    for file in sorted([*folder.glob(TRANSFORMS_FILE), *folder.glob(f"*/{TRANSFORMS_FILE}")]):
        if is_transforms(file):
            yield file, TRANSFORMS


def _json_files(folder: Path) -> list[Path]:
    """Those of a folder, and the rigs of its takes."""
    return [*sorted(folder.glob("*.json")), *sorted(folder.glob("rigs/*.json"))]


def _declared(file: Path) -> str | None:
    """The schema of ours that a file says it has; others' files, also those that are no JSON, say none."""
    try:
        schema = load_json(file).get("schema")
    except ArtifactError:
        return None
    return schema if isinstance(schema, str) and schema.startswith("preface/") else None
