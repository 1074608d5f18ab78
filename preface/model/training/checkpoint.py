"""Checkpoints: ``model.json``, ``model.safetensors`` and ``training_state.safetensors``, one generation at a time.

Three files cannot be replaced in one stroke, one can. So the tensors are written beside the old ones as ``*.next``,
then ``model.json``, which holds their SHA-256, is replaced, and then they take their names. A process that is killed
anywhere in between leaves either the old generation or the new one, some of whose files may still be called
``*.next``: a reader takes, of the two names, the file that ``model.json`` describes. What it describes is
never overwritten before the next generation is complete.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from preface.artifacts import ArtifactError, load_json, sha256, write_artifact, write_bytes

MODEL_FILE = "model.json"
WEIGHTS, STATE = "weights", "training_state"
_FILES = {WEIGHTS: "model.safetensors", STATE: "training_state.safetensors"}
_NEXT = ".next"
_RESTORE = "Restore the folder from a copy, or train again into an empty one"


def write_checkpoint(
    folder: Path, payload: Mapping[str, Any], tensors: Mapping[str, Mapping[str, Tensor]]
) -> Path:
    """Replace the folder's checkpoint as a whole.

    Args:
        folder: exists, and no other process writes to it.
        payload: of model.json, without `files`.
        tensors: by role, `WEIGHTS` and perhaps `STATE`.

    Returns:
        The path of model.json.

    Raises:
        ArtifactError: the disk refuses, or the payload is not valid; the checkpoint is what it was before.
    """
    _settle(folder)
    files = {}
    for role, named in tensors.items():
        plain = {name: tensor.detach().cpu().contiguous() for name, tensor in named.items()}
        data = safetensors.torch.save(plain)
        write_bytes(folder / (_FILES[role] + _NEXT), data)
        digest = hashlib.sha256(data).hexdigest()
        files[role] = {"file": _FILES[role], "bytes": len(data), "sha256": digest}
    path = write_artifact(folder / MODEL_FILE, {**payload, "files": files})
    _settle(folder)
    return path


def _settle(folder: Path) -> None:
    """Give files of the current generation that are still called ``*.next`` their names; others are leftovers."""
    described = load_json(folder / MODEL_FILE).get("files", {}) if (folder / MODEL_FILE).exists() else {}
    for role, name in _FILES.items():
        waiting = folder / (name + _NEXT)
        if waiting.exists() and sha256(waiting) == described.get(role, {}).get("sha256"):
            try:
                waiting.replace(folder / name)
            except OSError as error:
                raise ArtifactError.from_os(folder / name, "writing", error) from error


def read_tensors(path: Path, payload: Mapping[str, Any], role: str) -> dict[str, Tensor]:
    """The tensors of a checkpoint, checked against ``model.json``; on the CPU.

    Args:
        path: of model.json.
        payload: its content.
        role: `WEIGHTS` or `STATE`.

    Raises:
        ArtifactError: there are none, or none with the SHA-256 that model.json states.
    """
    entry = payload["files"].get(role)
    if entry is None:
        problem = "is not part of this checkpoint, which can be used but not trained on"
        raise ArtifactError(path, f"files.{role}", problem, "Train again into an empty folder")
    file = path.parent / entry["file"]
    for candidate in (file, file.with_name(file.name + _NEXT)):
        try:
            data = candidate.read_bytes()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise ArtifactError.from_os(candidate, "reading", error) from error
        if hashlib.sha256(data).hexdigest() == entry["sha256"]:
            return _parse(candidate, data)
    problem = f"is missing, or is not the file with the SHA-256 that {path.name} states"
    raise ArtifactError(file, "sha256", problem, _RESTORE)


def _parse(path: Path, data: bytes) -> dict[str, Tensor]:
    try:
        return safetensors.torch.load(data)
    except (safetensors.SafetensorError, KeyError) as error:
        raise ArtifactError(path, "file", f"is not a safetensors file ({error})", _RESTORE) from error


def require_same_tensors(path: Path, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse tensors with other names, shapes or values that are not numbers.

    Raises:
        ArtifactError: naming the first that differs.
    """
    remedy = "These are the weights of another architecture; " + _RESTORE[0].lower() + _RESTORE[1:]
    for name in sorted(set(found) ^ set(expected)):
        problem = "is not a tensor of this model" if name in found else "is missing"
        raise ArtifactError(path, name, problem, remedy)
    for name, tensor in found.items():
        if tensor.shape != expected[name].shape or tensor.dtype != expected[name].dtype:
            what = f"is {tensor.dtype} {list(tensor.shape)}"
            problem = f"{what}, and the model has {expected[name].dtype} {list(expected[name].shape)}"
            raise ArtifactError(path, name, problem.replace("torch.", ""), remedy)
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ArtifactError(path, name, "has values that are not finite", _RESTORE)
