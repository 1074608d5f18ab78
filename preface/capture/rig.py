"""Calibrated rigs, ``rig.json``: lenses and poses of one take, and how well they are known.

See ``data_specs/rig.md`` for the format. Every number is kept as it stands in the file, so that reading
and writing a rig changes no bit of it.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from preface.artifacts import ArtifactError, read_artifact, write_artifact
from preface.geometry.cameras import Camera
from preface.geometry.errors import GeometryError
from preface.geometry.transforms import Rigid

SCHEMA = "preface/rig"
Scale = Literal["metric", "arbitrary"]


@dataclass(frozen=True)
class ReprojectionError:
    """Distances between measured and projected points, in pixels, over ``count`` points."""

    rms: float
    median: float
    count: int


@dataclass(frozen=True)
class HeldOutError:
    """Root mean square distance, in pixels, over ``count`` points of frames that the solver did not see."""

    rms: float
    count: int


@dataclass(frozen=True)
class StandardDeviations:
    """One standard deviation of each parameter, of rotation [3] (radians) and translation [3] (metres)."""

    params: tuple[float, ...]
    rotation: tuple[float, ...]
    translation: tuple[float, ...]


@dataclass(frozen=True)
class Coverage:
    """How many frames show the board, and the share of the image that its points span, 0 to 1."""

    frames: int
    image_fraction: float


@dataclass(frozen=True)
class RigCamera:
    """A calibrated camera. Make one from a pose with `RigCamera.at`.

    Attributes:
        camera: the lens, which does not fold inside the image.
        quaternion_wxyz: the rotation of ``camera_from_rig``, of length 1.
        translation: the translation of ``camera_from_rig`` [3], metres.
        reprojection_error: on the frames that the solver saw.
        standard_deviations: of params and pose.
        covariance: rows of the covariance of params, rotation (radians), translation (metres).
        coverage: what the calibration saw.

    Raises:
        GeometryError: the lens folds inside the image, or the pose is none.
    """

    camera: Camera
    quaternion_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    reprojection_error: ReprojectionError | None = None
    standard_deviations: StandardDeviations | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    coverage: Coverage | None = None

    def __post_init__(self) -> None:
        self.camera.require_unfolded()
        _ = self.camera_from_rig  # raises for what is no pose
        count = len(self.camera.params)
        if self.standard_deviations and len(self.standard_deviations.params) != count:
            found = len(self.standard_deviations.params)
            raise GeometryError(
                f"standard_deviations.params: has {found} numbers, not {count}; give one per param"
            )
        if self.covariance and {len(row) for row in (self.covariance, *self.covariance)} != {count + 6}:
            raise GeometryError(
                f"covariance: is not square with {count + 6} rows; give params, rotation, translation"
            )

    @classmethod
    def at(cls, camera: Camera, camera_from_rig: Rigid, **statistics: Any) -> Self:
        """A camera at a pose; ``statistics`` are the remaining attributes by name."""
        quaternion, translation = camera_from_rig.quaternion_wxyz, camera_from_rig.translation
        return cls(camera, tuple(quaternion.tolist()), tuple(translation.tolist()), **statistics)

    @cached_property
    def camera_from_rig(self) -> Rigid:
        """The pose."""
        return Rigid.from_quaternion(np.array(self.quaternion_wxyz), np.array(self.translation))


@dataclass(frozen=True)
class Rig:
    """The calibrated cameras of one take, by id, in the file's order.

    Where the scale is arbitrary, nothing said how long a metre is: lengths are in a unit of the rig's own.
    """

    take: str
    cameras: Mapping[str, RigCamera]
    held_out_reprojection_error: HeldOutError | None = None
    provenance: Mapping[str, Any] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    scale: Scale = "metric"


def read_rig(path: str | os.PathLike[str]) -> Rig:
    """Read a rig, ``rig.json`` or a folder that holds one.

    Raises:
        ArtifactError: malformed, a camera twice, or an impossible camera: wrong number of parameters,
            focal length not positive, distortion that folds inside the image, or a rotation that is none.
    """
    path = Path(path) / "rig.json" if Path(path).is_dir() else Path(path)
    payload = read_artifact(path, SCHEMA)
    cameras: dict[str, RigCamera] = {}
    _check_ids(path, [entry["id"] for entry in payload["cameras"]])
    for index, entry in enumerate(payload["cameras"]):
        try:
            cameras[entry["id"]] = _camera(entry)
        except GeometryError as error:
            raise _impossible(path, f"cameras[{index}]", error) from error
    held_out = payload.get("held_out_reprojection_error")
    return Rig(
        take=payload["take"],
        cameras=cameras,
        held_out_reprojection_error=HeldOutError(**held_out) if held_out else None,
        provenance=payload.get("provenance"),
        metadata=payload.get("metadata", {}),
        scale=payload.get("scale", "metric"),
    )


def write_rig(path: str | os.PathLike[str], rig: Rig) -> Path:
    """Write a rig atomically.

    Raises:
        ArtifactError: an id or a number that the format refuses, or the disk refuses.
    """
    _check_ids(path, list(rig.cameras))
    entries = [_entry(name, camera) for name, camera in rig.cameras.items()]
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "schema_version": 1,
        "take": rig.take,
        "units": "metre",
        **({} if rig.scale == "metric" else {"scale": rig.scale}),
        "cameras": entries,
    }
    if rig.held_out_reprojection_error is not None:
        content["held_out_reprojection_error"] = asdict(rig.held_out_reprojection_error)
    if rig.provenance is not None:
        content["provenance"] = rig.provenance
    if rig.metadata:
        content["metadata"] = rig.metadata
    return write_artifact(path, content)


def _check_ids(path: str | os.PathLike[str], ids: list[str]) -> None:
    folded = [name.casefold() for name in ids]
    for index, name in enumerate(folded):
        if name in folded[:index]:
            problem = f"'{ids[index]}' appears twice, or differs from another in case only"
            raise ArtifactError(path, f"cameras[{index}].id", problem, "Remove one or rename it")


_STATISTICS: Mapping[str, Callable[..., Any]] = {
    "reprojection_error": ReprojectionError,
    "standard_deviations": StandardDeviations,
    "coverage": Coverage,
}


def _camera(entry: Mapping[str, Any]) -> RigCamera:
    return RigCamera(
        camera=Camera(entry["model"], int(entry["width"]), int(entry["height"]), np.array(entry["params"])),
        **_tuples(entry["camera_from_rig"]),
        covariance=tuple(tuple(row) for row in entry["covariance"]) if "covariance" in entry else None,
        **{name: kind(**_tuples(entry[name])) for name, kind in _STATISTICS.items() if name in entry},
    )


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _entry(name: str, camera: RigCamera) -> dict[str, Any]:
    lens = camera.camera
    entry: dict[str, Any] = {
        "id": name,
        "width": lens.width,
        "height": lens.height,
        "model": lens.model,
        "params": lens.params,
        "camera_from_rig": {"quaternion_wxyz": camera.quaternion_wxyz, "translation": camera.translation},
    }
    for statistic in _STATISTICS:
        if getattr(camera, statistic) is not None:
            entry[statistic] = asdict(getattr(camera, statistic))
    if camera.covariance is not None:
        entry["covariance"] = camera.covariance
    return entry


def _impossible(path: Path, place: str, error: GeometryError) -> ArtifactError:
    """Say where in the file an impossible camera is; a GeometryError reads "field: problem; remedy"."""
    name, _, rest = str(error).partition(": ")
    problem, _, remedy = rest.partition("; ")
    if name in ("quaternion_wxyz", "translation"):
        name = f"camera_from_rig.{name}"
    remedy = remedy.rstrip(".") or "Correct it, or calibrate again"
    return ArtifactError(path, f"{place}.{name}", problem, remedy[:1].upper() + remedy[1:])
