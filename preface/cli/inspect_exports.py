"""What `preface-inspect` says of exports: files that preface writes for other programs, and does not read again.

`data_specs/rays.md` and `data_specs/transforms.md` describe them; they have no schema.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, load_json

RAYS, TRANSFORMS = "preface-rays-1", "transforms"  # the former as the file's metadata have it
TRANSFORMS_FILE = "transforms.json"
_AGAIN = "Export it again with preface-build-shards export"


def is_rays(path: Path) -> bool:
    """Whether a file is a person's rays, as its metadata say."""
    from safetensors import SafetensorError, safe_open

    if path.suffix != ".safetensors" or not path.is_file():
        return False
    try:
        with safe_open(path, "numpy") as file:
            return (file.metadata() or {}).get("format") == RAYS
    except (SafetensorError, OSError):  # whatever it is, it does not say so
        return False


def is_transforms(path: Path) -> bool:
    """Whether a file is a person's views for nerfstudio that preface wrote; others' have no key `preface`."""
    try:
        return isinstance(load_json(path).get("preface"), Mapping)
    except ArtifactError:
        return False


def summarise_rays(path: Path) -> dict[str, Any]:
    """What a file of rays holds.

    Raises:
        ArtifactError: its metadata or tensors are not those of its format.
    """
    from safetensors import safe_open

    try:
        with safe_open(path, "numpy") as file:
            said = file.metadata()
            views, height, width, _ = file.get_slice("origins").get_shape()
            tensors = sorted(file.keys())
        cameras = json.loads(said["cameras"])
        return {
            "kind": "an export for other programs: every pixel's ray (data_specs/rays.md)",
            "identity": said["identity"],
            "cameras": cameras,
            "resolution": f"{width}x{height}",
            "rays": views * height * width,
            "units": said["units"],
            "tensors": tensors,
        }
    except (KeyError, ValueError) as error:
        raise ArtifactError(path, "metadata", f"are not those of {RAYS} ({error})", _AGAIN) from error


def summarise_transforms(path: Path, problems: list[ArtifactError]) -> dict[str, Any]:
    """What a folder for nerfstudio holds; its images that are missing join ``problems``.

    Raises:
        ArtifactError: it is not as preface writes it.
    """
    content = load_json(path)
    try:
        frames, ours = content["frames"], content["preface"]
        files = [frame[key] for frame in frames for key in ("file_path", "mask_path") if key in frame]
        problems += [
            ArtifactError(path, "frames", f"there is no {file} beside it", _AGAIN)
            for file in files
            if not (path.parent / file).is_file()
        ]
        return {
            "kind": "an export for other programs: a folder for nerfstudio (data_specs/transforms.md)",
            "identity": ours["identity"],
            "cameras": [Path(frame["file_path"]).stem for frame in frames],
            "resolution": sorted({f"{frame['w']}x{frame['h']}" for frame in frames}),
            "units_per_metre": ours["units_per_metre"],
        }
    except (KeyError, TypeError) as error:
        raise ArtifactError(path, "frames", f"are not as preface writes them ({error})", _AGAIN) from error
