"""Cafca's ``cameras_json`` folder (syntec-research/Cafca, Dataset.md and its notebook): ``C00.json`` ...

One file per camera with redundant values: ``K`` 3x3, ``world2cam`` and ``cam2world`` 4x4 (x right, y down,
z forward, as the notebook says), ``P`` = K world2cam 3x4, and ``position``, ``orientation`` and
``focal_length``. The images are rendered without distortion. The image size is taken from ``image_size``
where a file says it, otherwise from the header of ``../color_image/<camera>.png`` of the dataset.
"""

import json
from pathlib import Path

import numpy as np

from preface.capture.formats.document import Node, json_document
from preface.capture.formats.format import Cameras, Format, as_id, by_id, refusal, write_folder
from preface.capture.formats.lenses import camera_at, image_size, matrix_pose, simplest_camera
from preface.capture.images import read_header
from preface.capture.rig import RigCamera
from preface.geometry.transforms import Rigid

# Between the redundant poses: entries of world2cam cam2world - 1, lengths relative to the larger of 1 and
# the distance. The dataset's numbers may be float32.
REDUNDANT_AGREEMENT = 1e-4


def read(path: Path) -> dict[str, RigCamera]:
    """Read all JSON files of a folder, or one."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    return by_id(path, [(as_id(file.stem), _camera(json_document(file))) for file in files])


def _camera(document: Node) -> RigCamera:
    pose = matrix_pose(document["world2cam"])
    _check_inverse(document, pose)
    K = document["K"]
    matrix = K.array(3, 3)
    if matrix[0, 1] or matrix[1, 0] or not np.array_equal(matrix[2], (0, 0, 1)):
        raise K.error("is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", "Calibrate without skew")
    for key in ("radial_distortion", "tangential_distortion"):
        distortion = document.find(key)
        if distortion is not None and distortion.array().any():
            raise distortion.error("is not zero, and its order is not documented", "Undistort the images")
    width, height = _size(document)
    intrinsics = np.zeros(12)
    intrinsics[:4] = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    return camera_at(document, simplest_camera(K, intrinsics, width, height), pose)


def _check_inverse(document: Node, camera_from_world: Rigid) -> None:
    inverse = document.find("cam2world")
    if inverse is None:
        return
    defect = (camera_from_world @ matrix_pose(inverse)).matrix - np.eye(4)
    defect[:3, 3] /= max(1.0, float(np.linalg.norm(camera_from_world.translation)))
    if np.abs(defect).max() > REDUNDANT_AGREEMENT:
        problem = f"is not the inverse of world2cam (off by {np.abs(defect).max():.2g})"
        raise inverse.error(problem, "Correct one of the two, or remove this one")


def _size(document: Node) -> tuple[int, int]:
    size = document.find("image_size")
    if size is None:
        path = document.path
        image = path.parent.parent / "color_image" / f"{path.stem}.png"
        if not image.is_file():
            problem = "the image size is not in the file, and ../color_image has no image of this camera"
            raise document.error(problem, 'Add "image_size": [width, height]')
        header = read_header(image)
        return header.width, header.height
    return image_size(size)


def write(path: Path, cameras: Cameras) -> Path:
    """Write a folder with one file per camera."""
    return write_folder(path, {f"{name}.json": _content(path, name, c) for name, c in cameras.items()})


def _content(path: Path, name: str, camera: RigCamera) -> bytes:
    lens, pose = camera.camera, camera.camera_from_rig
    if lens.intrinsics[4:].any():
        problem = "its distortion cannot be written: this format has none"
        raise refusal(path, name, problem, "colmap-text, nerfstudio, opencv or mrcal")
    content = {
        "image_size": [lens.width, lens.height],
        "K": lens.K.tolist(),
        "world2cam": pose.matrix.tolist(),
        "cam2world": pose.inverse.matrix.tolist(),
        "P": (lens.K @ pose.matrix[:3]).tolist(),
        "position": pose.inverse.translation.tolist(),
        "orientation": pose.rotation.tolist(),
        "focal_length": float(lens.K[0, 0]),
    }
    return f"{json.dumps(content, indent=2)}\n".encode()


def mismatch(path: Path) -> str | None:
    """Say why a file or folder is not of this format."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    if not files or not files[0].is_file() or files[0].suffix.lower() != ".json":
        return "is neither a JSON file nor a folder of them"
    return None if json_document(files[0]).find("world2cam") else f"{files[0].name} has no 'world2cam'"


FORMAT = Format(
    "cafca",
    "",
    mismatch,
    read,
    write,
    ("the centre of the top-left pixel is (0.5, 0.5): Cafca does not document it",),
)
