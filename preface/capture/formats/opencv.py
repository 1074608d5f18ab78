"""OpenCV's `cv2.FileStorage` files, YAML or JSON by their suffix.

OpenCV fixes how a matrix is written, not how a rig is. Files written here have a list of cameras:

    cameras:
       - id: "front"
         image_width: 1024
         image_height: 1536
         K: !!opencv-matrix   (3x3)
         D: !!opencv-matrix   (1x5: k1 k2 p1 p2 k3, or 1x8 with k4 k5 k6)
         R: !!opencv-matrix   (3x3, world to camera)
         T: !!opencv-matrix   (3x1)

Read are these, files of one camera with the same keys at the top, and folders of such files, whose names
become ids. ``camera_matrix`` and ``distortion_coefficients``, as OpenCV's samples write them, are read as K
and D, a rotation vector as R, up to 14 coefficients, and lists of numbers in place of matrices. x right,
y down, z forward; the centre of the top-left pixel is (0, 0).
"""

from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, write_bytes
from preface.capture.formats.document import Node, read_text
from preface.capture.formats.format import Cameras, Format, as_id, by_id
from preface.capture.formats.lenses import camera_at, opencv_camera, opencv_pose
from preface.capture.rig import RigCamera
from preface.geometry.conventions import camera_to_opencv

SUFFIXES = (".yml", ".yaml", ".json")


def read(path: Path) -> dict[str, RigCamera]:
    """Read a rig, a camera, or a folder of cameras."""
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
        return by_id(path, [(as_id(file.stem), _camera(_document(file))) for file in files])
    document = _document(path)
    if document.find("cameras") is None:
        return by_id(path, [(as_id(path.stem), _camera(document))])
    cameras = document["cameras"].entries()
    return by_id(path, [(as_id(camera["id"].text()), _camera(camera)) for camera in cameras])


def _camera(place: Node) -> RigCamera:
    K = place.find("K", "camera_matrix") or place["K"]
    D = place.find("D", "distortion_coefficients") or place["D"]
    width, height = place["image_width"].integer(), place["image_height"].integer()
    return camera_at(place, opencv_camera(place, K, D, width, height), opencv_pose(place["R"], place["T"]))


def _document(path: Path) -> Node:
    import cv2

    text = read_text(path)
    problem = "OpenCV cannot parse it"
    remedy = "Write it with cv2.FileStorage; YAML begins with %YAML:1.0"
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        content = _plain(storage.root())
    except (cv2.error, SystemError, RecursionError) as error:
        raise ArtifactError(path, "file", problem, remedy) from error
    if not isinstance(content, dict) or not content:
        raise ArtifactError(path, "file", problem, remedy)
    return Node(path, "", content)


def _plain(node: Any) -> Any:
    """A `cv2.FileNode` as dictionaries, lists, texts and numbers; matrices as lists of rows."""
    if node.isMap():
        keys = node.keys()
        if {"rows", "cols", "dt", "data"} <= set(keys):
            matrix = node.mat()
            return None if matrix is None else matrix.tolist()
        return {key: _plain(node.getNode(key)) for key in keys}
    if node.isSeq():
        return [_plain(node.at(index)) for index in range(node.size())]
    if node.isString():
        return node.string()
    if node.isInt():
        return int(node.real())
    return node.real() if node.isReal() else None


def write(path: Path, cameras: Cameras) -> Path:
    """Write all cameras as YAML or JSON, as the suffix says."""
    import cv2

    if path.suffix.lower() not in SUFFIXES:
        problem = f"the suffix '{path.suffix}' is not one of {', '.join(SUFFIXES)}"
        raise ArtifactError(path, "writing", problem, "Name the file rig.yml or rig.json")
    storage = cv2.FileStorage(f"rig{path.suffix.lower()}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.startWriteStruct("cameras", cv2.FileNode_SEQ)
    for name, camera in cameras.items():
        K, D = camera_to_opencv(camera.camera)
        storage.startWriteStruct("", cv2.FileNode_MAP)
        storage.write("id", name)
        storage.write("image_width", camera.camera.width)
        storage.write("image_height", camera.camera.height)
        storage.write("K", K)
        storage.write("D", D[None, : 8 if D[5:].any() else 5])
        storage.write("R", camera.camera_from_rig.rotation)
        storage.write("T", camera.camera_from_rig.translation[:, None])
        storage.endWriteStruct()
    storage.endWriteStruct()
    return write_bytes(path, storage.releaseAndGetString().encode())


def mismatch(path: Path) -> str | None:
    """Say why a file or folder is not of this format."""
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    if not files or files[0].suffix.lower() not in SUFFIXES:
        return f"is neither a file nor a folder of files that end in {', '.join(SUFFIXES)}"
    document = _document(files[0])
    cameras = document.find("cameras")
    if cameras is not None and isinstance(cameras.value, list) and cameras.value:
        document = cameras.entries()[0]
    known = isinstance(document.value, dict) and document.find("K", "camera_matrix") and document.find("R")
    return None if known else f"{files[0].name} has no camera with K and R"


FORMAT = Format("opencv", "", mismatch, read, write)
