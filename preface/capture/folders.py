"""What lies in a capture's folders: its image files by name, and the manifest that the folders imply."""

import os
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError
from preface.capture.images import IMAGE_SUFFIXES

DEFAULT_TAKE = "default"


def files(folder: Path) -> list[os.DirEntry[str]]:
    """The files in a folder that are not hidden; none when there is no such folder."""
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        return [entry for entry in entries if not entry.name.startswith(".") and entry.is_file()]


def folders(folder: Path) -> list[str]:
    """Names of the folders in a folder that are not hidden, sorted; none when there is no such folder."""
    children = folder.iterdir() if folder.is_dir() else ()
    return sorted(child.name for child in children if child.is_dir() and not child.name.startswith("."))


def images_by_stem(folder: Path) -> dict[str, list[str]]:
    """Names of the image files in a folder, grouped by the name without its suffix, sorted."""
    groups: dict[str, list[str]] = {}
    for name in sorted(entry.name for entry in files(folder)):
        if Path(name).suffix.lower() in IMAGE_SUFFIXES:
            groups.setdefault(Path(name).stem, []).append(name)
    return groups


def implied_manifest(capture: Path) -> dict[str, Any]:
    """Cameras, takes and subjects, as JSON, of a folder in one of the two standard layouts.

    ``subjects/<identity>/<camera>.*``, or ``subjects/<identity>/<camera>/*`` with one or several photographs
    of each camera, of which the first by name is the subject's.

    Raises:
        ArtifactError: no image, or several takes, so that nobody can know who belongs to which.
    """
    subjects = folders(capture / "subjects")
    firsts = {name: _first_photographs(capture, name) for name in subjects}
    direct = {stem for name in subjects for stem in images_by_stem(capture / "subjects" / name)}
    cameras = sorted(direct or {camera for of_subject in firsts.values() for camera in of_subject})
    if not cameras:
        problem = "there is neither a capture.json nor any image at subjects/<identity>/<camera>.*"
        raise ArtifactError(capture, "capture.json", problem, "Correct the path, or write a capture.json")
    return {
        "cameras": [{"id": camera} for camera in cameras],
        "takes": [_take(capture, cameras)],
        "subjects": [{"id": name, **({} if direct else {"images": firsts[name]})} for name in subjects],
    }


def _take(capture: Path, cameras: list[str]) -> dict[str, str]:
    """The one take: its calibration lies in calibration/<take>/<camera>/ or in calibration/<camera>/."""
    takes = folders(capture / "calibration")
    if takes and set(takes) <= set(cameras):
        return {"id": DEFAULT_TAKE, "calibration": "calibration"}
    if len(takes) > 1:
        problem = f"is missing, and there are several takes ({', '.join(takes)})"
        remedy = "Write a capture.json that says which take each subject belongs to"
        raise ArtifactError(capture, "capture.json", problem, remedy)
    return {"id": takes[0] if takes else DEFAULT_TAKE}


def _first_photographs(capture: Path, subject: str) -> dict[str, str]:
    """Camera to its first photograph by name, of a subject with a folder per camera; relative paths."""
    found = {}
    for camera in folders(capture / "subjects" / subject):
        names = [
            name
            for group in images_by_stem(capture / "subjects" / subject / camera).values()
            for name in group
        ]
        if names:
            found[camera] = f"subjects/{subject}/{camera}/{min(names)}"
    return found
