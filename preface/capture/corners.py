"""Detected corners, ``corners.json``: what a detector saw in one take, to be solved now or later.

See ``data_specs/corners.md`` for the format. Any detector may write it; ``preface-calibrate --corners``
reads it, so that detection is never repeated.
"""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError, read_artifact, write_artifact
from preface.capture.manifest import Board
from preface.capture.observations import ObservationError, Observations

SCHEMA = "preface/corners"


@dataclass(frozen=True)
class Unseen:
    """An image without a single corner, and why."""

    camera: str
    frame: str
    reason: str


@dataclass(frozen=True)
class Corners:
    """The observations of one take, and how they came to be.

    Attributes:
        take: its id.
        observations: what was seen; board points in metres.
        board: the board's description, where the detector knew it.
        files: (camera id, frame id) to the image, or the video, relative to the folder of the take's cameras.
        unseen: images without a corner.
        warnings: what the user should know, whole sentences.
    """

    take: str
    observations: Observations
    board: Board | None = None
    files: Mapping[tuple[str, str], str] = field(default_factory=dict)
    unseen: tuple[Unseen, ...] = ()
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, Any] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)


def read_corners(path: str | os.PathLike[str]) -> Corners:
    """Read ``corners.json``.

    Raises:
        ArtifactError: malformed, names that are not defined, or arrays that do not fit.
    """
    payload = read_artifact(path, SCHEMA)
    cameras = [camera["id"] for camera in payload["cameras"]]
    views = payload["views"]
    camera = _places(path, views, "camera", cameras)
    frame = _places(path, views, "frame", payload["frames"])
    points = [_array(path, f"views[{i}].points", view["points"], ()) for i, view in enumerate(views)]
    pixels = [_array(path, f"views[{i}].pixels", view["pixels"], (2,)) for i, view in enumerate(views)]
    counts = [len(point) for point in points]
    for index, (count, pixel) in enumerate(zip(counts, pixels, strict=True)):
        if len(pixel) != count:
            problem = f"has {len(pixel)} entries for {count} points"
            raise ArtifactError(path, f"views[{index}].pixels", problem, "Give one pixel for each point")
    try:
        observations = Observations(
            camera_ids=tuple(cameras),
            image_sizes=tuple((int(c["width"]), int(c["height"])) for c in payload["cameras"]),
            frame_ids=tuple(payload["frames"]),
            board_points=np.array(payload["board_points"], np.float64),
            camera=np.repeat(np.array(camera, np.int32), counts),
            frame=np.repeat(np.array(frame, np.int32), counts),
            point=np.concatenate([*points, np.empty(0)]).astype(np.int32),
            pixels=np.concatenate([*pixels, np.empty((0, 2))]),
        )
    except ObservationError as error:
        name, _, rest = str(error).partition(": ")
        problem, _, remedy = rest.partition("; ")
        raise ArtifactError(path, name, problem, remedy[:1].upper() + remedy[1:]) from error
    board = payload.get("board")
    return Corners(
        take=payload["take"],
        observations=observations,
        board=Board(**{**board, "squares": tuple(board["squares"])}) if board else None,
        files={(view["camera"], view["frame"]): view["file"] for view in views if "file" in view},
        unseen=tuple(Unseen(**entry) for entry in payload.get("unseen", ())),
        warnings=tuple(payload.get("warnings", ())),
        provenance=payload.get("provenance"),
        metadata=payload.get("metadata", {}),
    )


def _places(
    path: str | os.PathLike[str], views: list[dict[str, Any]], key: str, names: list[str]
) -> list[int]:
    index = {name: place for place, name in enumerate(names)}
    for number, view in enumerate(views):
        if view[key] not in index:
            problem = f"'{view[key]}' is not one of the {key}s"
            raise ArtifactError(path, f"views[{number}].{key}", problem, f"Add it to {key}s, or correct it")
    return [index[view[key]] for view in views]


def _array(path: str | os.PathLike[str], place: str, values: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    """An array of numbers [N, *shape]: what the schema leaves out, because checking it there is slow."""
    try:
        array = np.array(values if values else np.empty((0, *shape)), np.float64)
    except (ValueError, TypeError) as error:
        raise ArtifactError(path, place, "holds something else than numbers", "Correct it") from error
    if array.shape[1:] != shape or (not shape and not np.array_equal(array, np.rint(array))):
        needed = "pairs [x, y]" if shape else "whole numbers"
        raise ArtifactError(path, place, f"is not a list of {needed}", "Correct it")
    return array


def write_corners(path: str | os.PathLike[str], corners: Corners) -> Path:
    """Write ``corners.json`` atomically.

    Raises:
        ArtifactError: a name that the format refuses, or the disk refuses.
    """
    seen = corners.observations
    content: dict[str, Any] = {"schema": SCHEMA, "schema_version": 1, "take": corners.take, "units": "metre"}
    if corners.board is not None:
        content["board"] = {key: value for key, value in asdict(corners.board).items() if value is not None}
    content["board_points"] = seen.board_points
    content["cameras"] = [
        {"id": name, "width": width, "height": height}
        for name, (width, height) in zip(seen.camera_ids, seen.image_sizes, strict=True)
    ]
    content["frames"] = seen.frame_ids
    content["views"] = [_view(corners, camera, frame) for camera, frame in np.argwhere(seen.counts)]
    for key, value in (
        ("unseen", [asdict(entry) for entry in corners.unseen]),
        ("warnings", corners.warnings),
        ("provenance", corners.provenance),
        ("metadata", corners.metadata),
    ):
        if value:
            content[key] = value
    return write_artifact(path, content)


def _view(corners: Corners, camera: int, frame: int) -> dict[str, Any]:
    seen = corners.observations
    points, pixels = seen.view(camera, frame)
    names = (seen.camera_ids[camera], seen.frame_ids[frame])
    view: dict[str, Any] = {"camera": names[0], "frame": names[1]}
    if names in corners.files:
        view["file"] = corners.files[names]
    return {**view, "points": points, "pixels": pixels}
