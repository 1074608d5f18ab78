"""``<identity>.json`` of an alignment: one person's landmarks in 2D and 3D, keypoints and place.

See ``data_specs/alignment.md``. What a person is placed by (keypoints, covariances, similarity, residuals) keeps every
digit; the landmarks, of which there are thousands, are rounded far below what they are worth.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.alignment_files import by_keypoint, from_keypoints
from preface.align.keypoints import CANONICAL_KEYPOINTS, SCHEMES
from preface.align.keypoints3d import Keypoints
from preface.align.landmarks import NoFace, ViewLandmarks, box_around
from preface.align.placement import Flag, Placement
from preface.align.subject import SubjectAlignment
from preface.align.triangulation import Reason, Triangulation
from preface.align.view_check import ViewVerdict
from preface.artifacts import ArtifactError, read_artifact, write_artifact
from preface.geometry import GeometryError, Similarity

SCHEMA = "preface/alignment"
PIXEL_DECIMALS = 4
METRE_DECIMALS = 8
DIGITS = 7  # of covariances
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, eq=False)
class Alignment:
    """One aligned person.

    Attributes:
        identity, take: their names.
        subject: the face in the rig's frame, without an exclusion.
        placement: its place in the canonical frame.
        found: camera id to what was found in that view.
    """

    identity: str
    take: str
    subject: SubjectAlignment
    placement: Placement
    found: Mapping[str, ViewLandmarks | NoFace]
    provenance: Mapping[str, Any] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)


def write_alignment(path: str | os.PathLike[str], alignment: Alignment) -> Path:
    """Write a person's file atomically.

    Raises:
        ArtifactError: the person is excluded, a name that the format refuses, or the disk refuses.
    """
    subject, place = alignment.subject, alignment.placement
    if subject.excluded is not None:
        raise ArtifactError(
            path,
            "identity",
            f"'{alignment.identity}' is excluded: {subject.excluded}",
            "Name it in the index",
        )
    similarity = place.canonical_from_rig
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "schema_version": 1,
        "identity": alignment.identity,
        "take": alignment.take,
        "units": "metre",
        "scheme": subject.scheme,
        "canonical_from_rig": {
            "scale": similarity.scale,
            "quaternion_wxyz": similarity.quaternion_wxyz,
            "translation": similarity.translation,
        },
        "keypoints": by_keypoint(subject.keypoints.positions),
        "keypoint_covariance": by_keypoint(subject.keypoints.covariance),
        "keypoint_views": dict(zip(CANONICAL_KEYPOINTS, subject.keypoints.views.tolist(), strict=True)),
        "missing_keypoints": {
            name: reason
            for name, reason in zip(CANONICAL_KEYPOINTS, subject.keypoints.reasons, strict=True)
            if reason
        },
        "residuals": by_keypoint(place.residuals),
        "weights": by_keypoint(place.weights),
        "flags": [vars(flag) for flag in place.flags],
        "noise_scale": subject.noise_scale,
        "cameras": subject.cameras,
        "landmarks": _landmarks(subject.landmarks),
        "views": {
            camera: _view(verdict, alignment.found.get(camera)) for camera, verdict in subject.views.items()
        },
    }
    for key in ("provenance", "metadata"):
        if getattr(alignment, key):
            content[key] = getattr(alignment, key)
    return write_artifact(path, content)


def _landmarks(found: Triangulation) -> dict[str, Any]:
    """Arrays [N] of the landmarks; null where there is none."""
    upper = found.covariance[:, *_UPPER]
    return {
        "points": _points(found.points, METRE_DECIMALS),
        "covariance": [
            [float(f"{value:.{DIGITS}g}") for value in row] if np.isfinite(row).all() else None
            for row in upper
        ],
        "inliers": found.inliers.astype(int),
        "residuals": _numbers(found.residuals, PIXEL_DECIMALS),
        "angle": _numbers(found.angle, METRE_DECIMALS),
        "reason": found.reason,
    }


def _numbers(values: np.ndarray, decimals: int) -> list[Any]:
    """Nested lists [N] or [N, V] with null for each number that is not finite."""
    if values.ndim > 1:
        return [_numbers(row, decimals) for row in values]
    rounded = np.round(values, decimals).tolist()
    return [value if there else None for value, there in zip(rounded, np.isfinite(values), strict=True)]


def _points(values: np.ndarray, decimals: int) -> list[Any]:
    """Points [N, D], with null for a point that is not finite."""
    known = np.isfinite(values).all(-1)
    return [
        row if there else None for row, there in zip(np.round(values, decimals).tolist(), known, strict=True)
    ]


def _view(verdict: ViewVerdict, found: ViewLandmarks | NoFace | None) -> dict[str, Any]:
    view: dict[str, Any] = {"used": verdict.used, "code": verdict.code, "reason": verdict.reason}
    # Infinite where the keypoint lies behind the camera: then only the reason tells.
    view["disagreement"] = by_keypoint(verdict.disagreement)
    if verdict.left_out:
        view["left_out"] = verdict.left_out
    if verdict.correction is not None:
        view["correction"] = by_keypoint(np.round(verdict.correction, PIXEL_DECIMALS))
    if isinstance(found, ViewLandmarks):
        view["pixels"] = _points(found.pixels, PIXEL_DECIMALS)
        view["sigma"] = _numbers(found.sigma, PIXEL_DECIMALS)
        view["confidence"] = np.round(found.confidence, PIXEL_DECIMALS)
        view |= {"rotation": found.rotation, "others": found.others, "warnings": found.warnings}
    elif isinstance(found, NoFace):
        view["no_face"] = found.reason
    return view


# ------------------------------------------------------------------------------------ reading


def read_alignment(path: str | os.PathLike[str]) -> Alignment:
    """Read a person's file.

    Raises:
        ArtifactError: malformed, arrays that do not fit the scheme, or a similarity that is none.
    """
    payload = read_artifact(path, SCHEMA)
    scheme = SCHEMES[payload["scheme"]]
    cameras = tuple(payload["cameras"])
    for index, camera in enumerate(cameras):
        if not payload["views"].get(camera, {}).get("used", False):
            problem = f"'{camera}' is not a view that is used"
            raise ArtifactError(path, f"cameras[{index}]", problem, "Correct views or cameras")
    subject = SubjectAlignment(
        scheme=scheme.name,
        cameras=cameras,
        landmarks=_read_landmarks(path, payload["landmarks"], scheme.size, len(cameras)),
        keypoints=_read_keypoints(payload),
        views={camera: _read_verdict(view) for camera, view in payload["views"].items()},
        noise_scale=float(payload["noise_scale"]),
        excluded=None,
    )
    found = {
        camera: entry
        for camera, view in payload["views"].items()
        if (entry := _read_found(path, f"views.{camera}", view, scheme.name, scheme.size)) is not None
    }
    return Alignment(
        identity=payload["identity"],
        take=payload["take"],
        subject=subject,
        placement=_read_placement(path, payload),
        found=found,
        provenance=payload.get("provenance"),
        metadata=payload.get("metadata", {}),
    )


def _read_keypoints(payload: Mapping[str, Any]) -> Keypoints:
    return Keypoints(
        positions=from_keypoints(payload["keypoints"], (3,)),
        covariance=from_keypoints(payload["keypoint_covariance"], (3, 3)),
        views=np.array([payload["keypoint_views"].get(name, 0) for name in CANONICAL_KEYPOINTS]),
        reasons=tuple(payload["missing_keypoints"].get(name, "") for name in CANONICAL_KEYPOINTS),
    )


def _read_placement(path: str | os.PathLike[str], payload: Mapping[str, Any]) -> Placement:
    pose = payload["canonical_from_rig"]
    try:
        similarity = Similarity.from_quaternion(pose["scale"], pose["quaternion_wxyz"], pose["translation"])
    except GeometryError as error:
        name, _, rest = str(error).partition(": ")
        problem, _, remedy = rest.partition("; ")
        place = f"canonical_from_rig.{name}"
        raise ArtifactError(path, place, problem, remedy.capitalize() or "Align again") from error
    return Placement(
        canonical_from_rig=similarity,
        residuals=from_keypoints(payload["residuals"], ()),
        weights=from_keypoints(payload["weights"], ()),
        flags=tuple(Flag(**flag) for flag in payload["flags"]),
    )


def _read_landmarks(
    path: str | os.PathLike[str], payload: Mapping[str, Any], count: int, views: int
) -> Triangulation:
    def read(key: str, shape: tuple[int, ...]) -> np.ndarray:
        return _array(path, f"landmarks.{key}", payload[key], (count, *shape))

    upper, covariance = read("covariance", (6,)), np.empty((count, 3, 3))
    covariance[:, *_UPPER] = upper
    covariance[:, _UPPER[1], _UPPER[0]] = upper
    reason = read("reason", ())
    if not np.isin(reason, list(Reason)).all():
        raise ArtifactError(path, "landmarks.reason", f"holds others than {list(Reason)}", "Align again")
    return Triangulation(
        points=read("points", (3,)),
        covariance=covariance,
        inliers=read("inliers", (views,)).astype(bool),
        residuals=read("residuals", (views,)),
        angle=read("angle", ()),
        reason=reason.astype(np.int8),
    )


def _read_verdict(view: Mapping[str, Any]) -> ViewVerdict:
    disagreement = from_keypoints(view["disagreement"], ())
    left_out = tuple(view.get("left_out", ()))
    correction = from_keypoints(view["correction"], (2,)) if "correction" in view else None
    return ViewVerdict(view["used"], view["code"], view["reason"], disagreement, left_out, correction)


def _read_found(
    path: str | os.PathLike[str], place: str, view: Mapping[str, Any], scheme: str, count: int
) -> ViewLandmarks | NoFace | None:
    if "no_face" in view:
        return NoFace(view["no_face"])
    if "pixels" not in view:
        return None
    pixels = _array(path, f"{place}.pixels", view["pixels"], (count, 2))
    if not np.isfinite(pixels).all(-1).any():
        raise ArtifactError(path, f"{place}.pixels", "not one landmark is seen", 'Give "no_face" instead')
    return ViewLandmarks(
        scheme=scheme,
        pixels=pixels,
        sigma=_array(path, f"{place}.sigma", view["sigma"], (count,)),
        confidence=_array(path, f"{place}.confidence", view["confidence"], (count,)),
        face_box=box_around(pixels),
        rotation=view["rotation"],
        others=view["others"],
        warnings=tuple(view["warnings"]),
    )


def _array(
    path: str | os.PathLike[str], place: str, values: Sequence[Any], shape: tuple[int, ...]
) -> np.ndarray:
    """Numbers of a shape, NaN for null: what the schema leaves out, because checking it there is slow."""
    filled = [np.full(shape[1:], np.nan) if value is None else _no_nulls(value) for value in values]
    try:
        array = np.array(filled, dtype=np.float64).reshape(len(filled), *shape[1:])
    except (TypeError, ValueError) as error:
        raise ArtifactError(path, place, "is not an array of numbers", "Align again") from error
    if array.shape != shape:
        problem = f"has {len(filled)} entries, and the scheme has {shape[0]} landmarks"
        raise ArtifactError(path, place, problem, "Align again")
    return array


def _no_nulls(value: Any) -> Any:
    return [np.nan if entry is None else entry for entry in value] if isinstance(value, list) else value
