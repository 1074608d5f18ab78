"""Landmarks of photographs for `preface-align`: given by the user, found by an earlier run, or found now."""

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.detection import DetectionOptions, detect_views
from preface.align.keypoints import FACEMESH478
from preface.align.landmark_bias import LandmarkBias, shipped_bias
from preface.align.landmark_files import landmark_file, read_landmark_folder, read_landmarks, write_landmarks
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.artifacts import load_json, provenance, sha256
from preface.capture.images import ImageHeader, read_header, read_image
from preface.capture.upright import read_upright, read_upright_header
from preface.cli.folders import make_folder
from preface.cli.output import say
from preface.cli.usage import UsageError

View = tuple[str, str]  # identity, camera
Found = ViewLandmarks | NoFace


@dataclass(frozen=True)
class Landmarks:
    """What was found, and what it was found in.

    Attributes:
        found: (identity, camera) to the landmarks, or to why there are none.
        inputs: (identity, camera) to the sha256 of the photograph or landmark file, by its name.
        config: how they were found and corrected, as JSON has it.
        bias: what their detector gets wrong on average; None leaves the landmarks as they are.
    """

    found: Mapping[View, Found]
    inputs: Mapping[View, Mapping[str, str]]
    config: Mapping[str, Any]
    bias: LandmarkBias | None


@dataclass(frozen=True)
class Reading:
    """How photographs are read: pixels, and the header with their width and height."""

    pixels: Callable[[Path], np.ndarray]
    header: Callable[[Path], ImageHeader]


AS_STORED = Reading(read_image, read_header)  # refuses what EXIF asks to be turned
UPRIGHT = Reading(read_upright, read_upright_header)


def landmarks_of(
    config: argparse.Namespace, photographs: Mapping[View, Path], reading: Reading = AS_STORED
) -> Landmarks:
    """The landmarks of all photographs, by the flags --landmarks, --landmark-model, --search-side, --crops, --jobs and
    --landmark-bias.

    What is found goes to OUTPUT/landmarks/<identity>/<camera>.json as soon as it is found; a later run takes it
    from there as long as the photograph, the options and mediapipe are the same.

    Raises:
        ArtifactError: no landmarks in the given folder, malformed ones, or the disk refuses.
    """
    headers = {view: reading.header(file) for view, file in photographs.items()}
    sizes = {view: (header.width, header.height) for view, header in headers.items()}
    if config.landmarks is not None:
        return _given(config, sizes)
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
        found |= detect_views(missing, options, keep, reading.pixels)
        took = time.perf_counter() - began
        say(
            f"looked for faces in {len(missing)} photographs: {took:.1f} s, {1e3 * took / len(missing):.0f} ms each"
        )
    in_order = {view: found[view] for view in photographs}
    inputs = {view: _named(view, history["inputs"]) for view, history in histories.items()}
    shipped_model = options.landmark_model is None
    return _corrected(config, in_order, inputs, {"detection": described(options)}, shipped_model)


def _corrected(
    config: argparse.Namespace,
    found: Mapping[View, Found],
    inputs: Mapping[View, Mapping[str, str]],
    history: Mapping[str, Any],
    shipped_model: bool,
) -> Landmarks:
    """The landmarks with the bias that --landmark-bias says, auto where the shipped model found them.

    Raises:
        UsageError: --landmark-bias on with landmarks that FaceMesh did not find.
    """
    schemes = {view.scheme for view in found.values() if isinstance(view, ViewLandmarks)}
    if config.landmark_bias == "on" and schemes - {FACEMESH478.name}:
        other = min(schemes - {FACEMESH478.name})
        raise UsageError(f"--landmark-bias on is for landmarks of {FACEMESH478.name}: these are {other}")
    known = config.landmark_bias == "auto" and shipped_model and schemes <= {FACEMESH478.name}
    bias = shipped_bias() if known or config.landmark_bias == "on" else None
    return Landmarks(found, inputs, {**history, "landmark_bias": bias.name if bias else None}, bias)


def _given(config: argparse.Namespace, sizes: Mapping[View, tuple[int, int]]) -> Landmarks:
    """Landmarks of another program, or of an earlier run."""
    folder = config.landmarks
    found = read_landmark_folder(folder, sizes)
    files = {view: landmark_file(folder, view) for view in sizes}
    inputs = {
        view: {f"{view[0]}/{file.name}": sha256(file)} for view, file in files.items() if file.is_file()
    }
    by_shipped_model = all(_by_shipped_model(file) for file in files.values() if file.is_file())
    return _corrected(config, found, inputs, {"landmarks": "given"}, by_shipped_model)


def _by_shipped_model(file: Path) -> bool:
    """Whether an earlier run of `preface-align` found these landmarks with mediapipe's own FaceMesh."""
    history = load_json(file).get("provenance") or {}
    return "mediapipe" in history.get("versions", {}) and (
        history.get("config", {}).get("landmark_model", "unknown") is None
    )


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
