"""The folder that a run writes to: held by one process, and gone on with by the same configuration only."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, write_bytes
from preface.model.training.lock import only_run
from preface.model.training.logs import RunLog
from preface.model.training.ranks import Ranks
from preface.model.training.validation import as_png
from preface.reports.pictures import Picture

TEMPLATE_FILE = "template.json"  # beside the shards' manifest and beside model.json


@contextlib.contextmanager
def held_folder(folder: Path, ranks: Ranks) -> Iterator[None]:
    """Make a folder, and hold it in the process that writes.

    Raises:
        ArtifactError: it cannot be written, or another run holds it.
    """
    if not ranks.is_first:
        yield
        return
    _make(folder)
    with only_run(folder):
        yield


def require_same_run(path: Path, ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> None:
    """Refuse to go on with a run of another configuration; the name of a preset says nothing by itself.

    Args:
        path: of its model.json.
        ours, theirs: configurations, nested; the digest of what they were made from among them.

    Raises:
        ArtifactError: naming the fields that differ.
    """
    now, there = _flat(ours), _flat(theirs)
    wrong = [
        f"{name} is {there.get(name)} there and {now.get(name)} now"
        for name in sorted(now.keys() | there.keys())
        if now.get(name) != there.get(name) and name not in ("preset", "quality")
    ]
    if wrong:
        remedy = "Give the same flags to go on, or another --output to begin anew"
        raise ArtifactError(path, "configuration", "; ".join(wrong), remedy)


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat.update(
            _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
        )
    return flat


def show(path: Path, log: RunLog, step: int, name: str, picture: Picture) -> Path:
    """Write a picture to a file, and to the log by its name.

    Raises:
        ArtifactError: the disk refuses.
    """
    _make(path.parent)
    png = as_png(picture)
    write_bytes(path, png)
    log.picture(step, name, png, (picture.shape[1], picture.shape[0]))
    return path


def carry_template(shards: Path, folder: Path) -> None:
    """Copy the template of shards beside a prior: a new person is placed on it before a fit. Not all shards have one.

    Raises:
        ArtifactError: it cannot be read, or the folder not be written.
    """
    source = shards / TEMPLATE_FILE
    if not source.exists():
        return
    try:
        content = source.read_bytes()
    except OSError as error:
        raise ArtifactError.from_os(source, "reading", error) from error
    write_bytes(folder / TEMPLATE_FILE, content)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArtifactError.from_os(folder, "writing", error) from error
