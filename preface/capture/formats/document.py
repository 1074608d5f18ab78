"""A place in someone else's file: nested mappings, lists and numbers whose every error says where it is."""

import contextlib
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError, load_json
from preface.geometry.errors import GeometryError
from preface.plain_words import join_field, shown

MAX_BYTES = 64 * 2**20  # hundreds of cameras take less than 1 MiB
MAX_DIMENSIONS = 4  # of lists of numbers; OpenCV nests a vector in three


@dataclass(frozen=True)
class Node:
    """A value of a document with the file and the field that it stands in."""

    path: Path
    field: str
    value: Any

    def error(self, problem: str, remedy: str) -> ArtifactError:
        """An error at this place."""
        return ArtifactError(self.path, self.field or "file", problem, remedy)

    def __getitem__(self, key: str) -> "Node":
        found = self.find(key)
        if found is None:
            field = join_field(self.field, key)
            raise ArtifactError(self.path, field, "is missing", "Add it, or name the format of this file")
        return found

    def find(self, *keys: str) -> "Node | None":
        """The value of the first of ``keys`` that is there."""
        mapping = self.mapping()
        for key in keys:
            if key in mapping:
                return Node(self.path, join_field(self.field, key), mapping[key])
        return None

    def mapping(self) -> Mapping[str, Any]:
        """The value as a mapping."""
        if not isinstance(self.value, Mapping):
            raise self.error(f"is {self._shown()}", "Give named values here")
        return self.value

    def items(self) -> Iterator[tuple[str, "Node"]]:
        """The entries of a mapping."""
        for key in self.mapping():
            yield key, self[key]

    def entries(self) -> list["Node"]:
        """The entries of a list."""
        if not isinstance(self.value, list | tuple):
            raise self.error(f"is {self._shown()}", "Give a list here")
        return [Node(self.path, f"{self.field}[{i}]", value) for i, value in enumerate(self.value)]

    def text(self) -> str:
        """The value as a text."""
        if not isinstance(self.value, str):
            raise self.error(f"is {self._shown()}", "Give a text here")
        return self.value

    def integer(self) -> int:
        """The value as a whole number; 1024.0 is one."""
        value = self.value
        if not _is_finite(value) or value != int(value):
            raise self.error(f"is {self._shown()}", "Give a whole number here")
        return int(value)

    def number(self) -> float:
        """The value as a finite number."""
        if not _is_finite(self.value):
            raise self.error(f"is {self._shown()}", "Give a finite number here")
        return float(self.value)

    def array(self, *shape: int) -> np.ndarray:
        """The value as finite float64 numbers of one shape; without a shape, flat [n]."""
        flat: list[float] = []
        found = _flatten(self.value, flat)
        wanted = " x ".join(map(str, shape)) or "a list of"
        if found is None or (shape and found != shape):
            problem = "is no regular list of numbers" if found is None else f"has the shape {found}"
            raise self.error(problem, f"Give {wanted} finite numbers here")
        return np.array(flat, dtype=np.float64).reshape(shape or -1)

    def _shown(self) -> str:
        try:
            return shown(self.value)
        except (TypeError, ValueError, RecursionError):  # what Python's literals can hold and JSON cannot
            return f"of type {type(self.value).__name__}"

    @contextlib.contextmanager
    def geometry(self) -> Iterator[None]:
        """Turn a GeometryError ("name: problem; remedy") into an error at this place."""
        try:
            with np.errstate(all="ignore"):  # damaged numbers overflow, and are then refused as not finite
                yield
        except GeometryError as error:
            problem, _, remedy = str(error).partition("; ")
            remedy = remedy.rstrip(".") or "Correct it, or calibrate again"
            raise self.error(problem, remedy[:1].upper() + remedy[1:]) from error


def _is_finite(value: Any) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= sys.float_info.max  # exact for whole numbers of any size, and false for NaN


def _flatten(value: Any, into: list[float], depth: int = 0) -> tuple[int, ...] | None:
    """Append the numbers of nested lists and return their shape, or None if they have none."""
    if _is_finite(value):
        into.append(float(value))
        return ()
    if not isinstance(value, list | tuple) or depth == MAX_DIMENSIONS:
        return None
    shapes = [_flatten(item, into, depth + 1) for item in value]
    if not shapes:
        return (0,)
    return None if shapes[0] is None or any(s != shapes[0] for s in shapes) else (len(shapes), *shapes[0])


def read_bytes(path: Path) -> bytes:
    """Read a file of at most `MAX_BYTES`."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ArtifactError.from_os(path, "file", error) from error
    if len(data) > MAX_BYTES:
        problem = f"is larger than {MAX_BYTES // 2**20} MiB"
        raise ArtifactError(path, "file", problem, "Check that this is the right file")
    return data


def read_text(path: Path) -> str:
    """Read a UTF-8 text."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        problem = "the text is not UTF-8"
        raise ArtifactError(path, f"byte {error.start}", problem, "Save the file as UTF-8") from error


def json_document(path: Path) -> Node:
    """Read a JSON object."""
    return Node(path, "", load_json(path))


def lacks_json_key(path: Path, key: str) -> str | None:
    """Say why a path is no JSON file with a key, or None if it is."""
    if not path.is_file() or path.suffix.lower() != ".json":
        return "is no JSON file"
    return None if json_document(path).find(key) else f"has no '{key}'"


def toml_document(path: Path) -> Node:
    """Read a TOML file."""
    try:
        return Node(path, "", tomllib.loads(read_text(path)))
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        problem = f"not valid TOML ({error})"
        raise ArtifactError(path, "file", problem, "Correct the text there") from error
