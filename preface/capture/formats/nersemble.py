"""NeRSemble's ``camera_params.json`` (tobias-kirschstein/nersemble-data, nersemble-benchmark).

``world_2_cam``: serial number to 4x4, x right, y down, z forward; ``intrinsics``: one 3x3 for all cameras
(the dataset) or one per serial number (the benchmark); no distortion. The image size is not in the file:
the recordings have 2200x3208 pixels and are also handed out at 1/2 and 1/4 of it, so the size whose centre
lies next to the principal point is taken. Files written here say ``image_size``, which others ignore.
"""

from pathlib import Path

import numpy as np

from preface.capture.formats.document import Node, json_document, lacks_json_key
from preface.capture.formats.format import Cameras, Format, as_id, by_id, write_json
from preface.capture.formats.lenses import camera_at, image_size, matrix_pose, opencv_camera, opencv_numbers
from preface.capture.rig import RigCamera

SIZES = ((2200, 3208), (1100, 1604), (550, 802))
# How far a principal point may lie from the centre of the image, as a share of the image's sides.
CENTRED = 0.15


def read(path: Path) -> dict[str, RigCamera]:
    """Read all serial numbers."""
    document = json_document(path)
    cameras = []
    for serial, pose in document["world_2_cam"].items():
        K = _of(document["intrinsics"], serial)
        size = document.find("image_size")
        width, height = _guessed_size(K) if size is None else image_size(_of(size, serial))
        lens = opencv_camera(K, K, None, width, height)
        cameras.append((as_id(serial), camera_at(pose, lens, matrix_pose(pose))))
    return by_id(path, cameras)


def _of(shared: Node, serial: str) -> Node:
    """What is shared by all cameras, or else the entry of one."""
    return shared[serial] if isinstance(shared.value, dict) else shared


def _guessed_size(K: Node) -> tuple[int, int]:
    center = K.array(3, 3)[:2, 2]
    offsets = [np.abs(center / size - 0.5).max() for size in SIZES]
    if min(offsets) > CENTRED:
        sizes = ", ".join(f"{width}x{height}" for width, height in SIZES)
        problem = f"the principal point {center.tolist()} is not near the centre of images of {sizes}"
        raise K.error(problem, 'Add "image_size": [width, height] to the file')
    return SIZES[int(np.argmin(offsets))]


def write(path: Path, cameras: Cameras) -> Path:
    """Write poses, and intrinsics and size once if all cameras share them, otherwise per camera."""
    poses, intrinsics, sizes = {}, {}, {}
    for name, camera in cameras.items():
        K, _ = opencv_numbers(path, name, camera.camera, 0, "colmap-text, nerfstudio, opencv or mrcal")
        poses[name] = camera.camera_from_rig.matrix.tolist()
        intrinsics[name] = K.tolist()
        sizes[name] = [camera.camera.width, camera.camera.height]
    content = {
        "world_2_cam": poses,
        "intrinsics": _shared(intrinsics),
        "image_size": _shared(sizes),
    }
    return write_json(path, content)


def _shared(values: dict[str, list]) -> dict[str, list] | list:
    first = next(iter(values.values()))
    return first if all(value == first for value in values.values()) else values


FORMAT = Format(
    "nersemble",
    "camera_params.json",
    lambda path: lacks_json_key(path, "world_2_cam"),
    read,
    write,
    (
        "the centre of the top-left pixel is (0, 0), as in OpenCV: NeRSemble does not document it",
        "images have 2200x3208 pixels, or 1/2 or 1/4 of it, where the file does not say image_size",
    ),
)
