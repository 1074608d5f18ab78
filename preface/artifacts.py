"""Versioned JSON artefacts: read, validate against ``data_specs/``, write atomically and durably.

An artefact is a JSON object that says ``schema`` and ``schema_version``. This module knows how such a
file may be malformed and how it is stored; it does not know what any artefact means. Every failure is
an `ArtifactError` that names the file, the field and the remedy.
"""

import contextlib
import errno
import hashlib
import json
import math
import os
import platform
import re
import secrets
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from preface.plain_words import in_plain_words, join_field, json_text, json_type, shown

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator

SCHEMA_DIRECTORY = Path(__file__).parent / "data_specs"  # a link to the top-level folder in a checkout
MAX_JSON_BYTES = 64 * 2**20  # a rig with full covariances of 100 cameras needs about 1 MiB
VERSIONED_PACKAGES = (
    "preface",
    "numpy",
    "scipy",
    "torch",
    "opencv-contrib-python-headless",
    "OpenEXR",
    "mediapipe",
    "pycolmap",
    "google-crc32c",
    "safetensors",
)
_OS_REMEDIES = {
    errno.ENOSPC: "Free some space on that disk and run again",
    errno.EDQUOT: "Free some of your quota on that disk and run again",
    errno.EFBIG: "Raise the file-size limit (ulimit -f) or use another disk, and run again",
    errno.EACCES: "Correct the permissions, or choose another place",
    errno.EPERM: "Correct the permissions, or choose another place",
    errno.EROFS: "That file system is read-only; choose another place",
    errno.ENOENT: "Correct the path, or create what is missing",
    errno.ENOTDIR: "Correct the path: one of its folders is a file",
    errno.EEXIST: "A file stands where a folder is to be; remove it, or choose another place",
    errno.EISDIR: "Correct the path: it names a folder, and a file is expected",
    errno.ENAMETOOLONG: "Choose a shorter name",
    errno.ELOOP: "Remove the symbolic links that lead in a circle",
}


class ArtifactError(Exception):
    """Something is wrong with a file: where, what, and how to correct it.

    Attributes:
        path: the file as the user named it.
        field: the place within it, such as ``subjects[3].take``, ``line 4, column 2`` or ``file``.
        problem: what is wrong there, without the closing period.
        remedy: what to do about it, without the closing period.
    """

    def __init__(self, path: str | os.PathLike[str], field: str, problem: str, remedy: str):
        super().__init__(path, field, problem, remedy)  # all four, so that workers can pickle it
        self.path = Path(path)
        self.field = field
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        line = f"{self.path}: {self.field}: {self.problem}. {self.remedy}."
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)  # names may hold control codes

    @classmethod
    def from_os(cls, path: str | os.PathLike[str], field: str, error: OSError) -> "ArtifactError":
        """Translate an `OSError` that struck while ``field`` ("reading", "writing") of ``path``."""
        problem = error.strerror or str(error)
        remedy = _OS_REMEDIES.get(error.errno or 0, "Check the disk and the permissions, and run again")
        return cls(path, field, problem[:1].lower() + problem[1:], remedy)


# ---------------------------------------------------------------------------------------- reading


def read_artifact(path: str | os.PathLike[str], schema_name: str) -> dict[str, Any]:
    """Read and validate an artefact.

    Args:
        path: the JSON file.
        schema_name: the schema it must declare, such as ``"preface/rig"``.

    Returns:
        The JSON object; numbers are Python ints and float64, exactly as written.

    Raises:
        ArtifactError: unreadable, not strict JSON, another or a future schema, or invalid against it.
    """
    payload = load_json(path)
    validate(payload, path, schema_name)
    return payload


def load_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read one strict JSON object: UTF-8, finite numbers, no key twice, at most `MAX_JSON_BYTES`."""

    def refuse(problem: str, remedy: str, field: str = "file") -> ArtifactError:
        return ArtifactError(path, field, problem, remedy)

    def unique_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        if len(result) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise refuse("the key appears twice in one object", "Keep one of the two", field=shown(twice))
        return result

    def finite_float(text: str) -> float:
        value = float(text)
        if not math.isfinite(value):
            raise refuse(f"the number {text[:40]} is not a finite float64", "Write a finite number", "number")
        return value

    try:
        with Path(path).open("rb") as file:
            data = file.read(MAX_JSON_BYTES + 1)
    except OSError as error:
        raise ArtifactError.from_os(path, "file", error) from error
    except ValueError as error:  # a NUL or a lone surrogate in the name
        raise refuse(f"cannot be a file name ({error})", "Correct the path") from error
    if len(data) > MAX_JSON_BYTES:
        raise refuse(f"is larger than {MAX_JSON_BYTES // 2**20} MiB", "Check that this is the right file")
    try:
        payload = json.loads(
            data.decode("utf-8-sig"),  # editors on Windows may put a byte order mark in front
            object_pairs_hook=unique_object,
            parse_float=finite_float,
            parse_constant=finite_float,
        )
    except UnicodeDecodeError as error:
        raise refuse("the text is not UTF-8", "Save the file as UTF-8", f"byte {error.start}") from error
    except json.JSONDecodeError as error:
        problem = f"not valid JSON ({error.msg[:1].lower()}{error.msg[1:]})"
        remedy = "Correct the text there; if the file ends too early, copy or write it again"
        raise refuse(problem, remedy, f"line {error.lineno}, column {error.colno}") from error
    except RecursionError as error:
        raise refuse("lists or objects are nested too deeply", "Check that this is the right file") from error
    except ValueError as error:  # Python's limit on the digits of an integer
        raise refuse("a whole number has thousands of digits", "Correct the number", "number") from error
    if not isinstance(payload, dict):
        raise refuse(f"holds {json_type(payload)}", "An artefact is one object {...}")
    return payload


def validate(payload: Mapping[str, Any], path: str | os.PathLike[str], schema_name: str) -> None:
    """Check that ``payload`` declares ``schema_name`` in a known version and conforms to it.

    Args:
        payload: a JSON object, as `load_json` returns it.
        path: the file to name in errors.
        schema_name: such as ``"preface/rig"``.

    Raises:
        ArtifactError: naming the most telling violation.
    """
    validator = _validator(schema_name)
    declared = payload.get("schema")
    if declared != schema_name:
        found = f"is {shown(declared)}" if "schema" in payload else "is missing"
        raise ArtifactError(path, "schema", found, f"A file of this kind says {shown(schema_name)}")
    schema: Any = validator.schema
    version, known = payload.get("schema_version"), schema["properties"]["schema_version"]["const"]
    if isinstance(version, int) and version > known:
        problem = f"is {shown(version)}, but this preface knows versions up to {known}"
        raise ArtifactError(path, "schema_version", problem, "Upgrade preface to read this file")

    from jsonschema.exceptions import best_match

    error = best_match(validator.iter_errors(payload))
    if error is not None:
        raise ArtifactError(path, *in_plain_words(error))


@cache
def _validator(schema_name: str) -> "Draft202012Validator":
    from jsonschema import Draft202012Validator  # a quarter of a second that --help must not wait for

    file = SCHEMA_DIRECTORY / f"{schema_name.removeprefix('preface/')}.schema.json"
    try:
        return Draft202012Validator(json.loads(file.read_text(encoding="utf-8")))
    except FileNotFoundError as error:
        problem = f"the schema {schema_name} is not installed with preface"
        remedy = f"Known schemas: {', '.join(known_schemas()) or 'none'}. Otherwise install preface again"
        raise ArtifactError(file, "file", problem, remedy) from error


def known_schemas() -> list[str]:
    """The names of all schemas in ``data_specs/``, such as ``["preface/capture", "preface/rig"]``."""
    files = sorted(SCHEMA_DIRECTORY.glob("*.schema.json"))
    return [f"preface/{file.name.removesuffix('.schema.json')}" for file in files]


# ---------------------------------------------------------------------------------------- writing


def write_artifact(path: str | os.PathLike[str], payload: Mapping[str, Any]) -> Path:
    """Validate an artefact against the schema it declares and write it atomically.

    Args:
        path: the file to write; its folder must exist.
        payload: JSON types, tuples, numpy arrays and numpy scalars; every number finite.

    Returns:
        The path. Reading gives every float64 back bit for bit.

    Raises:
        ArtifactError: the payload is not a valid artefact, or the disk refuses; the file at ``path``
            is then what it was before.
    """
    content = json_types(payload, path, "")
    validate(content, path, str(content.get("schema")))
    return write_bytes(path, f"{json_text(content)}\n".encode())


def write_bytes(path: str | os.PathLike[str], data: bytes) -> Path:
    """Replace a file as a whole: whatever fails, ``path`` holds its old content or ``data``.

    The content goes to a temporary file beside the target, is forced to the disk, takes the name by a
    rename, and the rename is forced to the disk. No temporary file stays behind after an error.

    Args:
        path: the file to write; its folder must exist.
        data: its whole content.

    Raises:
        ArtifactError: naming what the operating system refused and what to do.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name[:200]}.{secrets.token_hex(6)}.tmp")
    try:
        try:
            with temporary.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_directory(path.parent)
    except OSError as error:
        raise ArtifactError.from_os(path, "writing", error) from error
    return path


def sync_directory(directory: Path) -> None:
    """Force the names in a folder to the disk, as after a rename.

    Raises:
        OSError: the disk refuses.
    """
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # what file systems answer that order renames by other means
            raise
    finally:
        os.close(descriptor)


def json_types(value: Any, path: str | os.PathLike[str], field: str) -> Any:
    """Reduce a value to JSON types, numpy arrays and tuples to lists.

    Args:
        value: what is to be written.
        path: the file to name in errors.
        field: the place of ``value`` in it, empty for the whole.

    Raises:
        ArtifactError: something that JSON cannot hold, such as a number that is not finite.
    """
    if hasattr(value, "tolist"):  # numpy arrays and scalars, without importing numpy
        value = value.tolist()
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise ArtifactError(path, field or "file", f"has the key {key!r}", "Keys are texts")
        return {key: json_types(item, path, join_field(field, key)) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_types(item, path, f"{field}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise ArtifactError(
            path, field, f"is {value}, and artefacts hold finite numbers only", "Leave it out"
        )
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise ArtifactError(path, field, f"{value!a} is not valid text", "Correct it") from error
    elif not (value is None or isinstance(value, bool | int | float)):
        problem = f"is of type {type(value).__name__}, which JSON cannot hold"
        raise ArtifactError(path, field, problem, "Give numbers, texts, lists and objects")
    return value


# ------------------------------------------------------------------------------ paths, provenance


def resolve_inside(artifact: str | os.PathLike[str], field: str, relative: str) -> Path:
    """The path that an artefact's ``field`` names, refused when it leaves the artefact's folder.

    Args:
        artifact: the artefact's file; ``relative`` is relative to its folder.
        field: the place of ``relative`` in it, for errors.
        relative: forward slashes, no ``..``, no drive; symbolic links may not lead out.

    Returns:
        ``folder / relative``; it need not exist.

    Raises:
        ArtifactError: naming the field and why the path is refused.
    """

    def refuse(why: str) -> ArtifactError:
        remedy = "Give a path with forward slashes inside the folder of this file"
        return ArtifactError(artifact, field, f"the path {shown(relative)} {why}", remedy)

    if not relative or not relative.isprintable():
        raise refuse("is empty or holds control characters")
    if relative.startswith("/") or "\\" in relative or re.match(r"[A-Za-z]:", relative):
        raise refuse("is absolute or written for Windows")
    if ".." in relative.split("/"):
        raise refuse("climbs out with '..'")
    folder = Path(artifact).parent
    try:
        resolved = (folder / relative).resolve()
    except (OSError, RuntimeError) as error:  # symbolic links in a circle
        raise refuse("cannot be followed") from error
    if not resolved.is_relative_to(folder.resolve()):
        raise refuse("leads out of the folder through a symbolic link")
    return folder / relative


def provenance(
    config: Mapping[str, Any], inputs: Mapping[str, str | os.PathLike[str]], seed: int | None = None
) -> dict[str, Any]:
    """How an artefact came to be, without anything that differs between two identical runs.

    Args:
        config: the configuration of the command, JSON types.
        inputs: name to file; the names are stored, the files are hashed.
        seed: the seed of everything random, or None where nothing is.

    Returns:
        ``{"versions": {package: version}, "config": ..., "seed": ..., "inputs": {name: sha256}}``.

    Raises:
        ArtifactError: an input cannot be read.
    """
    return {
        "versions": _versions(),
        "config": dict(config),
        "seed": seed,
        "inputs": {name: sha256(file) for name, file in inputs.items()},
    }


def sha256(path: str | os.PathLike[str]) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ArtifactError.from_os(path, "file", error) from error


@cache
def _versions() -> dict[str, str]:
    from importlib import metadata

    found = {"python": platform.python_version()}
    for name in VERSIONED_PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):  # optional ones need not be installed
            found[name] = metadata.version(name)
    return found
