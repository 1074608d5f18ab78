"""anipose's ``calibration.toml`` (lambdaloop/aniposelib, cameras.py).

One table per camera, ``[cam_0]`` ...: ``name``, ``size`` (width, height), ``matrix``, ``distortions``
(k1 k2 p1 p2 k3), ``rotation`` (rotation vector) and ``translation``, world to camera, as OpenCV with the
centre of the top-left pixel at (0, 0). ``[metadata]`` is passed over. Lengths are in anipose's unit, which
is that of its board; read here as metres.
"""

from pathlib import Path

from preface.artifacts import write_bytes
from preface.capture.formats.document import Node, toml_document
from preface.capture.formats.format import Cameras, Format, as_id, by_id
from preface.capture.formats.lenses import (
    camera_at,
    image_size,
    opencv_camera,
    opencv_numbers,
    opencv_pose,
    refuse_fisheye,
)
from preface.capture.formats.toml_text import toml_text
from preface.capture.rig import RigCamera
from preface.geometry.conventions import pose_to_opencv


def read(path: Path) -> dict[str, RigCamera]:
    """Read all tables but the metadata."""
    tables = [table for name, table in toml_document(path).items() if name != "metadata"]
    return by_id(path, [(as_id(table["name"].text()), _camera(table)) for table in tables])


def _camera(table: Node) -> RigCamera:
    refuse_fisheye(table)
    lens = opencv_camera(table, table["matrix"], table["distortions"], *image_size(table["size"]))
    return camera_at(table, lens, opencv_pose(table["rotation"], table["translation"]))


def write(path: Path, cameras: Cameras) -> Path:
    """Write one table per camera."""
    tables: dict[str, dict] = {}
    for index, (name, camera) in enumerate(cameras.items()):
        K, distortions = opencv_numbers(path, name, camera.camera, 5, "colmap-text, opencv or mrcal")
        rotation, translation = pose_to_opencv(camera.camera_from_rig)
        tables[f"cam_{index}"] = {
            "name": name,
            "size": [camera.camera.width, camera.camera.height],
            "matrix": K.tolist(),
            "distortions": distortions.tolist(),
            "rotation": rotation.tolist(),
            "translation": translation.tolist(),
        }
    return write_bytes(path, toml_text(tables))


def mismatch(path: Path) -> str | None:
    """Say why a file is not of this format."""
    if not path.is_file() or path.suffix.lower() != ".toml":
        return "is no TOML file"
    tables = [value for key, value in toml_document(path).mapping().items() if key != "metadata"]
    named = [table for table in tables if isinstance(table, dict) and "name" in table and "matrix" in table]
    return None if named else "has no table of a camera with 'name' and 'matrix'"


FORMAT = Format("anipose", "calibration.toml", mismatch, read, write)
