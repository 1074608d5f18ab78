"""Landmark files: what was found in one view, by preface or by any other program.

See ``data_specs/landmarks.md``. A folder holds them as ``<subject>/<camera>.json``.
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.keypoints import SCHEMES
from preface.align.landmarks import NoFace, ViewLandmarks, box_around
from preface.artifacts import ArtifactError, read_artifact, write_artifact

SCHEMA = "preface/landmarks"
DECIMALS = 4  # of a pixel: a hundredth of what landmarks are worth, and short in the file
# The standard deviation of landmarks that come without one, as a part of the longer side of their box:
# about 1% of the distance between the outer eye corners.
SIGMA_OF_BOX = 0.005

View = tuple[str, str]  # subject, camera


def landmark_file(folder: str | os.PathLike[str], view: View) -> Path:
    """Where a folder holds the landmarks of a view."""
    subject, camera = view
    return Path(folder) / subject / f"{camera}.json"


def read_landmark_folder(
    folder: str | os.PathLike[str], sizes: Mapping[View, tuple[int, int]]
) -> dict[View, ViewLandmarks | NoFace]:
    """Read the landmarks of all views; a view without a file has no face.

    Args:
        folder: with ``<subject>/<camera>.json``.
        sizes: (subject, camera) to the width and height of that image.

    Raises:
        ArtifactError: not one file of these views, files of two schemes, or a file that `read_landmarks` refuses.
    """
    found: dict[View, ViewLandmarks | NoFace] = {}
    first: tuple[Path, str] | None = None
    for view, size in sizes.items():
        path = landmark_file(folder, view)
        if not path.is_file():
            found[view] = NoFace(f"there is no {path}")
            continue
        found[view] = entry = read_landmarks(path, view, size)
        if isinstance(entry, ViewLandmarks):
            first = first or (path, entry.scheme)
            if entry.scheme != first[1]:
                problem = f"is {entry.scheme}, but that of {first[0]} is {first[1]}"
                raise ArtifactError(path, "scheme", problem, "Give all landmarks of a capture in one scheme")
    if first is None:
        expected = landmark_file(folder, next(iter(sizes))) if sizes else Path(folder)
        remedy = f"Name them <subject>/<camera>.json, such as {expected}"
        raise ArtifactError(folder, "files", "no file with landmarks of this capture is there", remedy)
    return found


def read_landmarks(
    path: str | os.PathLike[str], view: View | None, size: tuple[int, int] | None
) -> ViewLandmarks | NoFace:
    """Read the landmarks of one view.

    Args:
        path: the file.
        view: the subject and camera whose file it should be; None takes any.
        size: width and height of the view's image in pixels; None takes any.

    Raises:
        ArtifactError: malformed, of another view, of an image of another size, another number of landmarks
            than the scheme has, landmarks outside the image, or a landmark that is half given.
    """
    try:
        payload = read_artifact(path, SCHEMA)
    except ArtifactError as error:
        if error.field == "number" and "NaN" in error.problem:
            remedy = "Write null for a landmark that is not seen, as JSON has no NaN"
            raise ArtifactError(path, error.field, error.problem, remedy) from error
        raise
    _check_view(path, payload, view, size)
    if "no_face" in payload:
        return NoFace(payload["no_face"])
    scheme = SCHEMES[payload["scheme"]]
    pixels = _pixels(path, payload, scheme.size)
    seen = np.isfinite(pixels).all(-1)
    box = box_around(pixels)
    usual = SIGMA_OF_BOX * float((box[2:] - box[:2]).max())
    sigma = _values(path, payload, "sigma", seen, usual)
    if usual == 0 and "sigma" not in payload:
        problem = "is missing, and all landmarks lie in one place"
        raise ArtifactError(path, "sigma", problem, "Correct the pixels, or state the standard deviations")
    return ViewLandmarks(
        scheme=scheme.name,
        pixels=pixels,
        sigma=sigma,
        confidence=np.where(seen, _values(path, payload, "confidence", seen, 1.0), 0.0),
        face_box=box,
        rotation=float(payload.get("rotation", 0.0)),
        others=int(payload.get("others", 0)),
        warnings=tuple(payload.get("warnings", ())),
    )


def write_landmarks(
    path: str | os.PathLike[str],
    view: View,
    size: tuple[int, int],
    found: ViewLandmarks | NoFace,
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """Write what was found in one view, atomically; `read_landmarks` gives it back to 0.0001 pixels.

    Args:
        path: the file; its folder must exist.
        view: subject and camera.
        size: width and height of the image in pixels.
        found: its landmarks, or why there are none.
        provenance: as `preface.artifacts.provenance` makes it.

    Raises:
        ArtifactError: a name that the format refuses, or the disk refuses.
    """
    content: dict[str, Any] = {"schema": SCHEMA, "schema_version": 1, "subject": view[0], "camera": view[1]}
    content |= {"width": size[0], "height": size[1]}
    if isinstance(found, NoFace):
        content["no_face"] = found.reason
    else:
        content["scheme"] = found.scheme
        content["pixels"] = _or_null(found.pixels, found.seen)
        content["sigma"] = _or_null(found.sigma, found.seen)
        content["confidence"] = np.round(found.confidence, DECIMALS)
        content |= {"rotation": round(found.rotation, 1), "others": found.others}
        if found.warnings:
            content["warnings"] = found.warnings
    if provenance is not None:
        content["provenance"] = provenance
    return write_artifact(path, content)


def _or_null(values: np.ndarray, seen: np.ndarray) -> list[Any]:
    rounded = np.round(values, DECIMALS).tolist()
    return [value if there else None for value, there in zip(rounded, seen, strict=True)]


def _check_view(
    path: str | os.PathLike[str], payload: Mapping[str, Any], view: View | None, size: tuple[int, int] | None
) -> None:
    for key, expected in zip(("subject", "camera"), view or (), strict=False):
        if payload[key] != expected:
            problem = f"is '{payload[key]}', but the place of the file is that of '{expected}'"
            raise ArtifactError(path, key, problem, "Move the file, or correct the name in it")
    given = (payload["width"], payload["height"])
    if size is not None and given != tuple(size):
        problem = f"are {given[0]}x{given[1]}, but the image is {size[0]}x{size[1]}"
        remedy = "Find the landmarks in the image of this capture, or scale them with it"
        raise ArtifactError(path, "width and height", problem, remedy)


def _pixels(path: str | os.PathLike[str], payload: Mapping[str, Any], count: int) -> np.ndarray:
    """Pixels [N, 2], NaN where not seen."""
    entries = payload["pixels"]
    _check_count(path, "pixels", entries, payload["scheme"], count)
    pixels = np.full((count, 2), np.nan)
    size = np.array([payload["width"], payload["height"]])
    for index, entry in enumerate(entries):
        if entry is None or entry == [None, None]:
            continue
        place = f"pixels[{index}]"
        if not (isinstance(entry, list) and len(entry) == 2 and _all_numbers(entry)):
            remedy = "Give [x, y] in pixels, or null for a landmark that is not seen"
            raise ArtifactError(path, place, "is neither a pair of numbers nor null", remedy)
        pixels[index] = entry
        if not ((pixels[index] >= 0) & (pixels[index] <= size)).all():
            problem = f"({entry[0]:g}, {entry[1]:g}) lies outside the image of {size[0]}x{size[1]} pixels"
            remedy = (
                "Give pixels of the full image with y down, not parts of it, and null for what lies outside"
            )
            raise ArtifactError(path, place, problem, remedy)
    if not np.isfinite(pixels).any():
        remedy = 'Give "no_face" with the reason instead of pixels'
        raise ArtifactError(path, "pixels", "not one landmark is seen", remedy)
    return pixels


def _values(
    path: str | os.PathLike[str], payload: Mapping[str, Any], key: str, seen: np.ndarray, usual: float
) -> np.ndarray:
    """One number per landmark [N], NaN where it is not seen; ``usual`` where the file has none at all."""
    if key not in payload:
        return np.where(seen, usual, np.nan)
    entries = payload[key]
    _check_count(path, key, entries, payload["scheme"], len(seen))
    for index in np.flatnonzero(seen):
        if not _all_numbers([entries[index]]):
            problem = "is no number, but the landmark is seen"
            raise ArtifactError(path, f"{key}[{index}]", problem, "Give a number, or make its pixels null")
    given = [entry if there else np.nan for entry, there in zip(entries, seen, strict=True)]
    return np.array(given, np.float64)


def _check_count(path: str | os.PathLike[str], key: str, entries: list[Any], scheme: str, count: int) -> None:
    if len(entries) != count:
        problem = f"has {len(entries)} entries, but the scheme {scheme} has {count} landmarks"
        raise ArtifactError(path, key, problem, "Give one for each landmark, null where it is not seen")


def _all_numbers(entries: Iterable[Any]) -> bool:
    return all(isinstance(entry, int | float) and not isinstance(entry, bool) for entry in entries)
