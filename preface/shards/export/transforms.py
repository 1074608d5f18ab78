"""A nerfstudio folder per identity: transforms.json with a frame per view, and the views as PNG.

    DIR/<identity>/transforms.json
    DIR/<identity>/images/<camera>.png          RGBA (not premultiplied), or RGB
    DIR/<identity>/masks/<camera>.png           with RGB: the foreground share in 8 bits

The format is that of docs.nerf.studio, "Data conventions". The world is the canonical frame (x to the
subject's left, y up, z out of the face), not turned: `applied_transform` is the identity, and `applied_scale`
is what metres were multiplied with. nerfstudio moves and scales what it reads unless it is told not to:

    ns-train nerfacto --data DIR/<identity> nerfstudio-data --orientation-method none --center-method none \
        --auto-scale-poses False

A lens keeps its distortion, k1 k2 k3 p1 p2, in its frame; one with k4, k5 or k6 cannot be expressed and is
refused. Pixels of the mask that are black are what nerfstudio leaves out; it takes all others as foreground.
What nerfstudio does not know stands under `preface`, which it does not read: box, scene_scale, depths.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.formats.format import write_json
from preface.capture.formats.nerfstudio import CORE, DISTORTION
from preface.capture.images import write_png
from preface.geometry.conventions import pose_to_opengl
from preface.geometry.transforms import Rigid
from preface.shards.export.rays import make_empty
from preface.shards.export.selection import Person, Selection
from preface.shards.reader import Dataset

_FILE_BYTES = 4096  # of a view beside its pixels: PNG's own overhead and its share of transforms.json


def images_bytes(selection: Selection) -> int:
    """The most bytes that a selection can take: PNG of noise is as large as its pixels."""
    row_filters = selection.height  # PNG prefixes each row with a byte
    per_view = 4 * selection.width * selection.height + 2 * row_filters + _FILE_BYTES
    return selection.view_count * per_view + _FILE_BYTES * len(selection.people)


def export_transforms(
    dataset: Dataset, selection: Selection, output: str | os.PathLike[str], scale: float, images: str
) -> list[Path]:
    """Write a nerfstudio folder per identity; its transforms.json comes last, so that one that has it is whole.

    Args:
        dataset: opened.
        selection: see `select`.
        output: folder to write, new or empty.
        scale: what metres are multiplied with.
        images: "rgba", or "rgb" for RGB and masks.

    Returns:
        The transforms.json of each identity.

    Raises:
        ArtifactError: a lens that nerfstudio cannot express, a folder that is not empty, a damaged view, or
            the disk refuses. Nothing is written if a lens cannot be expressed.
    """
    for person in selection.people:
        _require_expressible(dataset, person)
    folder = make_empty(Path(output))
    return [_export_person(dataset, person, folder, scale, images) for person in selection.people]


def _require_expressible(dataset: Dataset, person: Person) -> None:
    for view, camera in zip(person.views, person.cameras, strict=True):
        lost = dataset.tables["intrinsics"][person.number, view, len(CORE) + len(DISTORTION) :]
        if lost.any():
            k4, k5, k6 = lost.tolist()
            problem = (
                f"its lens has k4 {k4:g}, k5 {k5:g}, k6 {k6:g}, and nerfstudio knows k1, k2, k3, p1, p2 only"
            )
            remedy = (
                "Build the shards with --undistort resample, leave this view out, or export --format rays"
            )
            raise ArtifactError(dataset.manifest.path, f"{person.name}.{camera}", problem, remedy)


def _export_person(dataset: Dataset, person: Person, folder: Path, scale: float, images: str) -> Path:
    scene = folder / person.name
    try:
        for name in ("images", "masks") if images == "rgb" else ("images",):
            (scene / name).mkdir(parents=True)
        frames = []
        for view, camera in zip(person.views, person.cameras, strict=True):
            pixels = dataset.pixels(person.number, view)
            file = f"{camera}.png"
            frame = {"file_path": f"images/{file}", **_camera(dataset, person.number, view, scale)}
            if images == "rgb":
                frame["mask_path"] = f"masks/{file}"
                write_png(scene / "masks" / file, np.ascontiguousarray(pixels[..., 3]))
                pixels = np.ascontiguousarray(pixels[..., :3])
            write_png(scene / "images" / file, pixels)
            frames.append(frame)
        return write_json(scene / "transforms.json", _content(dataset, person, scale, frames))
    except OSError as error:
        shutil.rmtree(scene, ignore_errors=True)
        raise ArtifactError.from_os(error.filename or scene, "writing", error) from error
    except BaseException:
        shutil.rmtree(scene, ignore_errors=True)
        raise


def _camera(dataset: Dataset, identity: int, view: int, scale: float) -> dict[str, Any]:
    """A view's intrinsics and pose as nerfstudio has them."""
    intrinsics = dataset.tables["intrinsics"][identity, view].tolist()
    pose = Rigid.from_matrix(dataset.tables["canonical_from_camera"][identity, view])
    world_from_camera = pose_to_opengl(Rigid(pose.rotation, pose.translation * scale).inverse)
    near, far = dataset.tables["near_far"][identity, view] * scale
    return {
        "w": dataset.manifest.width,
        "h": dataset.manifest.height,
        **dict(zip((*CORE, *DISTORTION), intrinsics, strict=False)),
        "transform_matrix": world_from_camera.tolist(),
        "near": near,
        "far": far,
    }


def _content(dataset: Dataset, person: Person, scale: float, frames: list[dict[str, Any]]) -> dict[str, Any]:
    manifest = dataset.manifest
    return {
        "camera_model": "OPENCV",
        "applied_transform": np.eye(3, 4).tolist(),
        "applied_scale": scale,
        "frames": frames,
        "preface": {
            "identity": person.name,
            "frame": "canonical: x to the subject's left, y up, z out of the face",
            "units_per_metre": scale,
            "scene_scale": manifest.scene_scale,
            "box": (dataset.tables["box"][person.number] * scale).tolist(),
        },
    }
