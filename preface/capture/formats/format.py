"""What a file format is to the registry, and what all formats share: ids, atomic folders, refusals."""

import json
import re
import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, write_bytes
from preface.capture.images import IMAGE_SUFFIXES
from preface.capture.rig import RigCamera

Cameras = Mapping[str, RigCamera]  # camera id -> camera, in the file's order


@dataclass(frozen=True)
class Format:
    """How one program writes down cameras.

    Attributes:
        name: what the command line calls it.
        file_name: the name that its file usually has; empty where the format is a folder.
        mismatch: says in a few words why a file or folder is not of this format, or None if it is.
        read: reads the cameras of a file or folder.
        write: writes cameras to a file or folder and returns it.
        assumptions: conventions that the format's documentation leaves open, and how they are read here.
    """

    name: str
    file_name: str
    mismatch: Callable[[Path], str | None]
    read: Callable[[Path], dict[str, RigCamera]]
    write: Callable[[Path, Cameras], Path]
    assumptions: tuple[str, ...] = ()

    def locate(self, path: Path) -> Path:
        """The file of this format that a folder stands for, if it holds one of the usual name."""
        usual = path / self.file_name
        return usual if self.file_name and path.is_dir() and usual.is_file() else path


# ------------------------------------------------------------------------------------------- ids


def as_id(name: str) -> str:
    """Turn a name of another program into a camera id: letters, digits, '.', '_' and '-'."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).lstrip("._-")[:100]


def ids_of_images(names: Sequence[str]) -> list[str]:
    """Turn image names into camera ids: their last parts where these differ, or else the whole paths.

    ``images/front.png`` becomes ``front``; ``left/0001.png`` and ``right/0001.png`` become ``left-0001``
    and ``right-0001``.
    """
    paths = [_without_image_suffix(name.replace("\\", "/")) for name in names]
    last = [as_id(path.rpartition("/")[2]) for path in paths]
    return last if len({name.casefold() for name in last}) == len(names) else [as_id(path) for path in paths]


def _without_image_suffix(name: str) -> str:
    stem, dot, suffix = name.rpartition(".")
    return stem if stem and f"{dot}{suffix}".lower() in (*IMAGE_SUFFIXES, ".bmp", ".webp") else name


def by_id(path: Path, named: Sequence[tuple[str, RigCamera]]) -> dict[str, RigCamera]:
    """Collect cameras by id.

    Raises:
        ArtifactError: there is none, or two names become the same id.
    """
    cameras: dict[str, RigCamera] = {}
    seen: set[str] = set()
    for name, camera in named:
        if not name:
            raise ArtifactError(path, "camera names", "a name has no letter or digit", "Rename that camera")
        if name.casefold() in seen:
            problem = f"two cameras are called '{name}', or differ in case or special characters only"
            raise ArtifactError(path, "camera names", problem, "Rename one of them")
        seen.add(name.casefold())
        cameras[name] = camera
    if not cameras:
        raise ArtifactError(path, "file", "holds no camera with a pose", "Check that this is the right file")
    return cameras


# --------------------------------------------------------------------------------------- writing


def write_json(path: Path, content: Mapping[str, Any]) -> Path:
    """Write JSON with every float64 in the shortest form that reads back bit for bit."""
    return write_bytes(path, f"{json.dumps(content, indent=2, allow_nan=False)}\n".encode())


def write_folder(folder: Path, files: Mapping[str, bytes]) -> Path:
    """Write a folder as a whole: all files in a temporary folder beside it, then a rename.

    Raises:
        ArtifactError: the folder exists and is not empty (what lies there would be read as part of the
            export), or the disk refuses.
    """
    target = folder.resolve()
    temporary = target.with_name(f".{target.name[:200]}.{secrets.token_hex(6)}.tmp")
    try:
        if folder.exists() and any(folder.iterdir()):
            problem = "this folder is not empty, and its files would mix with the exported ones"
            raise ArtifactError(folder, "writing", problem, "Name a new folder, or empty this one")
        temporary.mkdir()
        try:
            for name, data in files.items():
                write_bytes(temporary / name, data)
            temporary.replace(target)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    except OSError as error:
        raise ArtifactError.from_os(folder, "writing", error) from error
    return folder


def refusal(path: Path, camera_id: str, problem: str, instead: str) -> ArtifactError:
    """The error of a format that cannot hold a camera; ``instead`` names formats that can."""
    return ArtifactError(path, f"cameras.{camera_id}", problem, f"Export to {instead} instead")
