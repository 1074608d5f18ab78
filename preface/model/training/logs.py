"""What a run writes down as it goes: ``log.jsonl``, TensorBoard's events, and a line for whoever watches."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from preface.artifacts import ArtifactError, write_bytes
from preface.model.training.event_file import EventFile

LOG_FILE = "log.jsonl"
EVENTS_FOLDER = "events"


class RunLog:
    """The log of a run: one JSON object per line, and the same numbers for TensorBoard.

    A run that is resumed from a step goes on behind what was logged up to that step; what a killed run logged
    beyond its last checkpoint is dropped, since those steps are taken again.

    Args:
        folder: of the run.
        step: steps taken so far.

    Raises:
        ArtifactError: a file cannot be read or written, now or later.
    """

    def __init__(self, folder: Path, step: int):
        self.path = folder / LOG_FILE
        write_bytes(self.path, "".join(_lines_up_to(self.path, step)).encode())
        try:
            (folder / EVENTS_FOLDER).mkdir(exist_ok=True)
            self._file = self.path.open("a", encoding="utf-8")
        except OSError as error:
            raise ArtifactError.from_os(self.path, "writing", error) from error
        self._events = EventFile(folder / EVENTS_FOLDER, step)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()
        self._events.__exit__(kind, error, traceback)

    def write(self, step: int, kind: str, values: Mapping[str, Any]) -> None:
        """Log values; numbers among them go to TensorBoard as `kind/name`, those of mappings as `kind/name/key`."""
        try:
            self._file.write(json.dumps({"step": step, "kind": kind, **values}) + "\n")
            self._file.flush()
        except OSError as error:
            raise ArtifactError.from_os(self.path, "writing", error) from error
        self._events.numbers(step, _flat(kind, values))

    def picture(self, step: int, name: str, png: bytes, size: tuple[int, int]) -> None:
        """Show a picture of (width, height) in TensorBoard; the caller has written it to a file."""
        self._events.picture(step, name, png, size)


def _flat(prefix: str, values: Mapping[str, Any]) -> dict[str, float]:
    flat: dict[str, float] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat.update(_flat(f"{prefix}/{name}", value))
        elif isinstance(value, int | float):
            flat[f"{prefix}/{name}"] = float(value)
    return flat


def _lines_up_to(path: Path, step: int) -> list[str]:
    """The lines of a log that belong to steps up to `step`; a last line that was cut off is dropped."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
        entries = [(json.loads(line), line) for line in lines if line.endswith("\n")]
        return [line for entry, line in entries if entry["step"] <= step]
    except OSError as error:
        raise ArtifactError.from_os(path, "reading", error) from error
    except (ValueError, KeyError, TypeError) as error:
        problem = f"has a line that is not of a training log ({error})"
        raise ArtifactError(path, "file", problem, "Move the file away and run again") from error


def read_log(path: Path, kind: str) -> list[dict[str, Any]]:
    """The entries of one kind ("train", "validation"), in order."""
    entries = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [entry for entry in entries if entry["kind"] == kind]
