"""caliscope's ``camera_array.toml`` (mprib/caliscope, cameras/camera_array.py).

One table per camera, ``[cameras.0]`` ...: ``cam_id`` (``port`` in older files), ``size`` (width, height),
``matrix``, ``distortions`` (k1 k2 p1 p2 k3), ``translation`` and ``rotation``: a matrix or, in some versions,
a rotation vector; world to camera, as OpenCV with the centre of the top-left pixel at (0, 0).

Cameras are numbered there. Reading takes the number as id, unless a table has a ``name``, which files written
here have and caliscope passes over. Cameras that caliscope ignores are left out.
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


def read(path: Path) -> dict[str, RigCamera]:
    """Read all cameras that are not ignored."""
    cameras = []
    for number, table in toml_document(path)["cameras"].items():
        ignore, name = table.find("ignore"), table.find("name")
        if ignore is None or not ignore.value:
            cameras.append((as_id(name.text() if name else number), _camera(table)))
    return by_id(path, cameras)


def _camera(table: Node) -> RigCamera:
    refuse_fisheye(table)
    for key in ("matrix", "distortions", "rotation", "translation"):
        value = table.find(key)
        if value is None or value.value in ("null", []):  # how caliscope writes what it does not know yet
            what = "its lens" if key in ("matrix", "distortions") else "its pose"
            problem = f"has no {key}: caliscope has not calibrated {what} yet"
            raise table.error(problem, "Finish the calibration there, or set ignore = true")
    lens = opencv_camera(table, table["matrix"], table["distortions"], *image_size(table["size"]))
    return camera_at(table, lens, opencv_pose(table["rotation"], table["translation"]))


def write(path: Path, cameras: Cameras) -> Path:
    """Write the cameras with the numbers 0, 1, ... and their ids as names."""
    tables = {}
    for number, (name, camera) in enumerate(cameras.items()):
        K, distortions = opencv_numbers(path, name, camera.camera, 5, "colmap-text, opencv or mrcal")
        pose = camera.camera_from_rig
        tables[f"cameras.{number}"] = {
            "cam_id": number,
            "name": name,
            "rotation_count": 0,
            "ignore": False,
            "fisheye": False,
            "size": [camera.camera.width, camera.camera.height],
            "matrix": K.tolist(),
            "distortions": distortions.tolist(),
            "translation": pose.translation.tolist(),
            "rotation": pose.rotation.tolist(),
        }
    return write_bytes(path, toml_text(tables))


def mismatch(path: Path) -> str | None:
    """Say why a file is not of this format."""
    if not path.is_file() or path.suffix.lower() != ".toml":
        return "is no TOML file"
    return None if toml_document(path).find("cameras") else "has no table 'cameras'"


FORMAT = Format("caliscope", "camera_array.toml", mismatch, read, write)
