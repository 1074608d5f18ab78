"""Lenses and poses at the border: OpenCV's K and distortion, and matrices that must be rotations."""

from pathlib import Path

import numpy as np

from preface.capture.formats.document import Node
from preface.capture.formats.format import refusal
from preface.capture.rig import RigCamera
from preface.geometry.cameras import Camera
from preface.geometry.conventions import camera_from_opencv, camera_to_opencv, pose_from_opencv
from preface.geometry.lens import INTRINSICS
from preface.geometry.transforms import Rigid

COEFFICIENTS = INTRINSICS[4:]  # k1 k2 p1 p2 k3 k4 k5 k6: OpenCV has the same order
MAX_SIDE = 1_000_000  # of an image, pixels, as data_specs/rig.schema.json has it


def check_size(place: Node, width: int, height: int) -> None:
    """Refuse an image size that no image has."""
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise place.error(f"the image size {width} x {height} is impossible", "Give its size in pixels")


def image_size(place: Node) -> tuple[int, int]:
    """Read width and height from a list of two."""
    sides = [side.integer() for side in place.entries()]
    if len(sides) != 2:
        raise place.error(f"has {len(sides)} numbers", "Give width and height")
    check_size(place, sides[0], sides[1])
    return sides[0], sides[1]


def refuse_fisheye(place: Node) -> None:
    """Refuse OpenCV's fisheye model, which anipose and caliscope mark with a flag."""
    fisheye = place.find("fisheye")
    if fisheye is not None and fisheye.value:
        raise fisheye.error("is true", "Calibrate with the ordinary lens model, or undistort the images")


def camera_at(place: Node, camera: Camera, camera_from_rig: Rigid) -> RigCamera:
    """Join lens and pose, or say where in the file an impossible camera is."""
    with place.geometry():
        return RigCamera.at(camera, camera_from_rig)


def opencv_camera(place: Node, K: Node, distortion: Node | None, width: int, height: int) -> Camera:
    """Build the simplest camera from OpenCV's K [3, 3] and up to 14 coefficients at two places."""
    check_size(place, width, height)
    matrix = K.array(3, 3)
    coefficients = np.zeros(0) if distortion is None else distortion.array()
    with place.geometry():
        return camera_from_opencv(matrix, coefficients, width, height)


def simplest_camera(place: Node, intrinsics: np.ndarray, width: int, height: int) -> Camera:
    """Build the simplest of PINHOLE, OPENCV, FULL_OPENCV from twelve intrinsics, our pixels."""
    check_size(place, width, height)
    simplest = "PINHOLE" if not intrinsics[4:].any() else "OPENCV" if not intrinsics[8:].any() else ""
    with place.geometry():
        camera = Camera("FULL_OPENCV", width, height, intrinsics)
        return camera.as_model(simplest) if simplest else camera


def opencv_pose(rotation: Node, translation: Node) -> Rigid:
    """Build camera_from_rig from a rotation matrix [3, 3] or vector [3], and a translation [3]."""
    flat, offset = rotation.array(), translation.array()
    if offset.size != 3:
        raise translation.error(f"has {offset.size} numbers", "Give a translation of three")
    if flat.size not in (3, 9):
        problem = f"has {flat.size} numbers"
        raise rotation.error(problem, "Give a rotation matrix of 3 x 3 numbers, or a rotation vector of 3")
    with rotation.geometry():
        return pose_from_opencv(flat, offset) if flat.size == 3 else Rigid(rotation.array(3, 3), offset)


def matrix_pose(place: Node) -> Rigid:
    """Build a rigid motion from a matrix [3, 4] or [4, 4] at a place."""
    rows = len(place.entries())
    matrix = place.array(rows, 4)
    with place.geometry():
        return Rigid.from_matrix(matrix)


def opencv_numbers(
    path: Path, camera_id: str, camera: Camera, count: int, instead: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return OpenCV's K [3, 3] and its first ``count`` coefficients.

    Raises:
        ArtifactError: one of the others is not zero.
    """
    K, coefficients = camera_to_opencv(camera)
    lost = [name for name, value in zip(COEFFICIENTS[count:], coefficients[count:], strict=True) if value]
    if lost:
        room = f"only {', '.join(COEFFICIENTS[:count])}" if count else "no distortion"
        problem = f"its {', '.join(lost)} cannot be written: this format holds {room}"
        raise refusal(path, camera_id, problem, instead)
    return K, coefficients[:count]
