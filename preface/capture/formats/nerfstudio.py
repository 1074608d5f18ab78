"""nerfstudio's ``transforms.json`` (docs.nerf.studio, "Data conventions"); instant-ngp's is the same.

Camera to world, x right, y up, z back; intrinsics ``fl_x fl_y cx cy w h`` and distortion ``k1 k2 k3 p1 p2``
in each frame or once for all; the centre of the top-left pixel is (0.5, 0.5). nerfstudio's ``k4`` is the
factor of r^8, which no model here has: it is refused unless zero. Each frame is a camera; the name of its
image becomes its id. The world is that of ``transform_matrix``: ``applied_transform`` is not undone.
"""

from pathlib import Path

import numpy as np

from preface.capture.formats.document import Node, json_document, lacks_json_key
from preface.capture.formats.format import Cameras, Format, by_id, ids_of_images, refusal, write_json
from preface.capture.formats.lenses import camera_at, simplest_camera
from preface.capture.rig import RigCamera
from preface.geometry.conventions import pose_from_opengl, pose_to_opengl
from preface.plain_words import shown

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
# Our first nine intrinsics by nerfstudio's names; it has none for the last three, k4 k5 k6.
CORE = ("fl_x", "fl_y", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")


def read(path: Path) -> dict[str, RigCamera]:
    """Read all frames."""
    document = json_document(path)
    frames = document["frames"].entries()
    ids = ids_of_images([frame["file_path"].text() for frame in frames])
    cameras = [_camera(document, frame) for frame in frames]
    return by_id(path, list(zip(ids, cameras, strict=True)))


def _camera(document: Node, frame: Node) -> RigCamera:
    def either(key: str) -> Node | None:
        return frame.find(key) or document.find(key)

    def required(key: str) -> Node:
        return either(key) or document[key]  # which says that it is missing

    model, fisheye, k4 = either("camera_model"), either("is_fisheye"), either("k4")
    if model and model.value not in PERSPECTIVE:
        remedy = f"Undistort the images to one of {', '.join(PERSPECTIVE)}"
        raise model.error(f"is {shown(model.value)}, which is not a perspective camera", remedy)
    if fisheye and fisheye.value:
        raise fisheye.error("is true", "Undistort the images to a perspective camera")
    if k4 and k4.number():
        raise k4.error("is not zero", "Undistort the images, or calibrate without k4")
    core = [required(key).number() for key in CORE]
    found = [either(key) for key in DISTORTION]
    distortion = [0.0 if node is None else node.number() for node in found]
    width, height = required("w").integer(), required("h").integer()
    lens = simplest_camera(frame, np.array([*core, *distortion, 0, 0, 0]), width, height)
    matrix = frame["transform_matrix"]
    world_from_camera = matrix.array(len(matrix.entries()), 4)
    with matrix.geometry():
        camera_from_world = pose_from_opengl(world_from_camera)
    return camera_at(frame, lens, camera_from_world)


def write(path: Path, cameras: Cameras) -> Path:
    """Write one frame per camera, ``images/<id>.png``, each with its own intrinsics."""
    frames = []
    for name, camera in cameras.items():
        lens = camera.camera
        if lens.intrinsics[9:].any():
            problem = "its k4, k5, k6 cannot be written: this format holds k1, k2, p1, p2, k3"
            raise refusal(path, name, problem, "colmap-text, opencv or mrcal")
        intrinsics = dict(zip((*CORE, *DISTORTION), lens.intrinsics.tolist(), strict=False))
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "w": lens.width,
                "h": lens.height,
                **intrinsics,
                "transform_matrix": pose_to_opengl(camera.camera_from_rig).tolist(),
            }
        )
    return write_json(path, {"camera_model": "OPENCV", "frames": frames})


FORMAT = Format("nerfstudio", "transforms.json", lambda path: lacks_json_key(path, "frames"), read, write)
