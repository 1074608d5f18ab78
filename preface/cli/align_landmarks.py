"""Landmarks of photographs for `preface-align`: given by the user, found by an earlier run, or found now."""

import argparse
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from preface.align.detection import DetectionOptions, detect_views
from preface.align.landmark_files import landmark_file, read_landmark_folder, read_landmarks, write_landmarks
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.artifacts import ArtifactError, load_json, provenance, sha256
from preface.capture.images import read_header
from preface.cli.output import say

View = tuple[str, str]  # identity, camera
Found = ViewLandmarks | NoFace


@dataclass(frozen=True)
class Landmarks:
    """What was found, and what it was found in.

    Attributes:
        found: (identity, camera) to the landmarks, or to why there are none.
        inputs: (identity, camera) to the sha256 of the photograph or landmark file, by its name.
        config: how they were found, as JSON has it.
    """

    found: Mapping[View, Found]
    inputs: Mapping[View, Mapping[str, str]]
    config: Mapping[str, Any]


def landmarks_of(config: argparse.Namespace, photographs: Mapping[View, Path]) -> Landmarks:
    """The landmarks of all photographs, by the flags --landmarks, --landmark-model, --search-side, --crops, --jobs.

    What is found goes to OUTPUT/landmarks/<identity>/<camera>.json as soon as it is found; a later run takes it
    from there as long as the photograph, the options and mediapipe are the same.

    Raises:
        ArtifactError: no landmarks in the given folder, malformed ones, or the disk refuses.
    """
    sizes = {view: _size(file) for view, file in photographs.items()}
    if config.landmarks is not None:
        return _given(config.landmarks, sizes)
    options = detection_options(config)
    folder = config.output / "landmarks"
    histories = {view: _history(options, file) for view, file in photographs.items()}
    found = {
        view: kept
        for view in photographs
        if (kept := _kept(landmark_file(folder, view), view, sizes[view], histories[view])) is not None
    }
    if found:
        say(f"landmarks of {len(found)} photographs are taken from {folder}")

    def keep(view: View, result: Found) -> None:
        path = landmark_file(folder, view)
        make_folder(path.parent)
        write_landmarks(path, view, sizes[view], result, histories[view])

    missing = {view: file for view, file in photographs.items() if view not in found}
    if missing:
        began = time.perf_counter()
        found |= detect_views(missing, options, keep)
        took = time.perf_counter() - began
        say(
            f"looked for faces in {len(missing)} photographs: {took:.1f} s, {1e3 * took / len(missing):.0f} ms each"
        )
    in_order = {view: found[view] for view in photographs}
    inputs = {view: _named(view, history["inputs"]) for view, history in histories.items()}
    return Landmarks(in_order, inputs, {"detection": described(options)})


def _given(folder: Path, sizes: Mapping[View, tuple[int, int]]) -> Landmarks:
    """Landmarks of another program, or of an earlier run."""
    found = read_landmark_folder(folder, sizes)
    files = {view: landmark_file(folder, view) for view in sizes}
    inputs = {
        view: {f"{view[0]}/{file.name}": sha256(file)} for view, file in files.items() if file.is_file()
    }
    return Landmarks(found, inputs, {"landmarks": "given"})


def _named(view: View, inputs: Mapping[str, str]) -> dict[str, str]:
    return {f"{view[0]}/{view[1]}/{name}": digest for name, digest in inputs.items()}


def detection_options(config: argparse.Namespace) -> DetectionOptions:
    """What the flags choose; the rest is the detector's own choice."""
    chosen = {
        "scale": config.search_side,
        "jitters": config.crops,
        "landmark_model": config.landmark_model,
        "jobs": config.jobs,
    }
    return DetectionOptions(**{name: value for name, value in chosen.items() if value is not None})


def described(options: DetectionOptions) -> dict[str, Any]:
    """The options as JSON has them; what does not change the result is left out."""
    settings = {
        name: value for name, value in asdict(options).items() if name not in ("jobs", "landmark_model")
    }
    settings["rotations"] = list(options.rotations)
    return settings | {"landmark_model": options.landmark_model.name if options.landmark_model else None}


def make_folder(path: Path) -> None:
    """Create a folder and those above it; an ArtifactError says what hinders."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArtifactError.from_os(error.filename or path, "writing", error) from error


def _size(photograph: Path) -> tuple[int, int]:
    header = read_header(photograph)
    return header.width, header.height


def _history(options: DetectionOptions, photograph: Path) -> dict[str, Any]:
    inputs = {photograph.name: photograph}
    if options.landmark_model is not None:
        inputs[options.landmark_model.name] = options.landmark_model
    return provenance(described(options), inputs)


def _kept(path: Path, view: View, size: tuple[int, int], history: Mapping[str, Any]) -> Found | None:
    """The landmarks that an earlier run found in the same way, if there are any."""
    if not path.is_file():
        return None
    before = load_json(path).get("provenance")
    if not isinstance(before, dict) or _decisive(before) != _decisive(history):
        return None
    return read_landmarks(path, view, size)


def _decisive(history: Mapping[str, Any]) -> Any:
    """The part of the provenance that decides what is found."""
    versions = history["versions"]
    names = ("preface", "mediapipe", "opencv-contrib-python-headless")
    return history["config"], history["inputs"], [versions.get(name) for name in names]
