"""mrcal's ``.cameramodel`` (dkogan/mrcal, mrcal/cameramodel.py): one file per camera, a rig is a folder.

A Python dictionary in plain text, read as literals and never evaluated: ``lensmodel`` (``lens_model`` in
older files), ``intrinsics`` fx fy cx cy and OpenCV's coefficients, ``imagersize`` (width, height) and
``extrinsics`` (``rt_cam_ref`` in newer files): rotation vector and translation, world to camera; x right,
y down, z forward; the centre of the top-left pixel is (0, 0). ``optimization_inputs`` are passed over.
"""

import ast
from pathlib import Path

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.formats.document import Node, read_text
from preface.capture.formats.format import Cameras, Format, as_id, by_id, write_folder
from preface.capture.formats.lenses import camera_at, image_size, opencv_camera
from preface.capture.rig import RigCamera
from preface.geometry.conventions import camera_to_opencv, pose_from_opencv, pose_to_opencv
from preface.plain_words import shown

SUFFIX = ".cameramodel"
# Number of distortion coefficients, in OpenCV's order; OPENCV12 ends with four thin-prism ones.
COEFFICIENTS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}


def read(path: Path) -> dict[str, RigCamera]:
    """Read one file, or all of a folder; the names of files become ids."""
    files = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
    return by_id(path, [(as_id(file.name.removesuffix(SUFFIX)), _camera(_document(file))) for file in files])


def _document(path: Path) -> Node:
    try:
        content = ast.literal_eval(read_text(path).strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        problem = f"is no dictionary of plain values ({type(error).__name__})"
        raise ArtifactError(path, "file", problem, "Write the model again with mrcal") from error
    return Node(path, "", content)


def _camera(document: Node) -> RigCamera:
    model = document.find("lensmodel", "lens_model") or document["lensmodel"]
    name = model.text()
    if name not in COEFFICIENTS:
        problem = f"is {shown(name)}, which is not one of {', '.join(COEFFICIENTS)}"
        raise model.error(problem, "Convert it with mrcal-convert-lensmodel LENSMODEL_OPENCV8")
    fx, fy, cx, cy, *coefficients = document["intrinsics"].array(4 + COEFFICIENTS[name])
    place = document["intrinsics"]
    K = Node(place.path, place.field, [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    distortion = Node(place.path, place.field, coefficients)
    lens = opencv_camera(place, K, distortion, *image_size(document["imagersize"]))
    extrinsics = document.find("rt_cam_ref", "extrinsics") or document["extrinsics"]
    rt = extrinsics.array(6)
    with extrinsics.geometry():
        pose = pose_from_opencv(rt[:3], rt[3:])
    return camera_at(place, lens, pose)


def write(path: Path, cameras: Cameras) -> Path:
    """Write a folder with ``<id>.cameramodel`` for each camera, of the simplest lens model that holds it."""
    return write_folder(path, {f"{name}{SUFFIX}": _content(camera) for name, camera in cameras.items()})


def _content(camera: RigCamera) -> bytes:
    K, coefficients = camera_to_opencv(camera.camera)
    used = int(np.max(np.flatnonzero(coefficients), initial=-1)) + 1
    model, count = next((name, count) for name, count in COEFFICIENTS.items() if count >= used)
    intrinsics = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *coefficients[:count]]
    rotation, translation = pose_to_opencv(camera.camera_from_rig)
    numbers = [float(value) for value in intrinsics]
    return (
        "{\n"
        f"    'lensmodel': '{model}',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        f"    'intrinsics': {numbers},\n\n"
        "    # extrinsics are rt_cam_ref\n"
        f"    'extrinsics': {[*rotation.tolist(), *translation.tolist()]},\n\n"
        f"    'imagersize': [{camera.camera.width}, {camera.camera.height}],\n"
        "}\n"
    ).encode()


def mismatch(path: Path) -> str | None:
    """Say why a file or folder is not of this format."""
    if path.is_dir():
        return None if any(path.glob(f"*{SUFFIX}")) else f"is no folder with {SUFFIX} files"
    return None if path.suffix == SUFFIX else f"is no {SUFFIX} file"


FORMAT = Format("mrcal", "", mismatch, read, write)
