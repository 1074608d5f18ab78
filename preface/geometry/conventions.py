"""The borders to other programs' conventions. Inside them, COLMAP's hold and nothing is converted.

| program     | pose                                    | axes            | centre of the top-left pixel |
|-------------|-----------------------------------------|-----------------|------------------------------|
| here, COLMAP| camera_from_world                       | y down, z ahead | (0.5, 0.5)                   |
| OpenCV      | camera_from_world, a rotation vector    | y down, z ahead | (0, 0)                       |
| OpenGL, NeRF| world_from_camera, a matrix             | y up, z back    | (0.5, 0.5)                   |
"""

import numpy as np
from scipy.spatial.transform import Rotation

from preface.geometry.arrays import Array
from preface.geometry.cameras import CAMERA_MODELS, Camera
from preface.geometry.errors import GeometryError
from preface.geometry.transforms import Rigid

OPENCV_PIXEL_OFFSET = 0.5
_OPENGL_AXES = np.diag([1.0, -1.0, -1.0])


def pixels_from_opencv(pixels: Array) -> Array:
    """Convert OpenCV's pixels [..., 2], as its detectors return them, to ours."""
    return pixels + OPENCV_PIXEL_OFFSET


def pixels_to_opencv(pixels: Array) -> Array:
    """Convert our pixels [..., 2] to OpenCV's, as its remap and drawing functions take them."""
    return pixels - OPENCV_PIXEL_OFFSET


def camera_from_opencv(K: np.ndarray, distortion: np.ndarray, width: int, height: int) -> Camera:
    """Build the simplest camera from OpenCV's calibration.

    Args:
        K: [3, 3], OpenCV's pixels.
        distortion: up to 14 coefficients in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1 ... s4 tx ty.
        width, height: of the image, pixels.

    Raises:
        GeometryError: K has skew or is no calibration matrix, or thin-prism or tilt terms are not zero.
    """
    K = np.asarray(K, dtype=np.float64)
    if K.shape != (3, 3) or not np.array_equal(K[2], (0, 0, 1)) or K[1, 0] != 0:
        raise GeometryError(
            f"K: {K.tolist()} is not a calibration matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        )
    if K[0, 1] != 0:
        raise GeometryError(f"K: its skew {K[0, 1]} is not zero; calibrate without skew")
    coefficients = np.asarray(distortion, dtype=np.float64).ravel()
    if coefficients.size > 14 or coefficients[8:].any():
        raise GeometryError(
            f"distortion: {coefficients.tolist()} has more than k1 k2 p1 p2 k3 k4 k5 k6; calibrate without "
            "CALIB_THIN_PRISM_MODEL and CALIB_TILTED_MODEL"
        )
    padded = np.zeros(8)
    padded[: min(coefficients.size, 8)] = coefficients[:8]
    center = pixels_from_opencv(K[:2, 2])
    camera = Camera("FULL_OPENCV", width, height, np.concatenate([(K[0, 0], K[1, 1]), center, padded]))
    simplest = "PINHOLE" if not padded.any() else "OPENCV" if not padded[4:].any() else "FULL_OPENCV"
    return camera.as_model(simplest)


def camera_to_opencv(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return OpenCV's K [3, 3] and its eight distortion coefficients k1 k2 p1 p2 k3 k4 k5 k6."""
    K = camera.K
    K[:2, 2] = pixels_to_opencv(K[:2, 2])
    return K, camera.intrinsics[4:].copy()


def pose_from_opencv(rotation_vector: np.ndarray, translation: np.ndarray) -> Rigid:
    """Build camera_from_world from OpenCV's rvec and tvec (three numbers in any shape)."""
    rotation = Rotation.from_rotvec(np.asarray(rotation_vector, dtype=np.float64).reshape(3)).as_matrix()
    return Rigid(rotation, np.asarray(translation, dtype=np.float64).reshape(3))


def pose_to_opencv(camera_from_world: Rigid) -> tuple[np.ndarray, np.ndarray]:
    """Return OpenCV's rvec [3] and tvec [3]."""
    return Rotation.from_matrix(camera_from_world.rotation).as_rotvec(), camera_from_world.translation.copy()


def pose_from_opengl(world_from_camera: np.ndarray) -> Rigid:
    """Build camera_from_world from camera-to-world matrices [..., 3 or 4, 4] with y up and z back."""
    pose = Rigid.from_matrix(world_from_camera)
    return Rigid(pose.rotation @ _OPENGL_AXES, pose.translation).inverse


def pose_to_opengl(camera_from_world: Rigid) -> np.ndarray:
    """Return the camera-to-world matrices [..., 4, 4] with y up and z back."""
    pose = camera_from_world.inverse
    return Rigid(pose.rotation @ _OPENGL_AXES, pose.translation).matrix


def camera_from_colmap(model: str, width: int, height: int, params: np.ndarray) -> Camera:
    """Build a camera from a line of COLMAP's cameras.txt. Models that are not perspective are refused."""
    if model == "SIMPLE_PINHOLE":
        if np.shape(params) != (3,):
            raise GeometryError(f"params: SIMPLE_PINHOLE takes 3 numbers (f, cx, cy), not {np.size(params)}")
        return Camera("PINHOLE", width, height, np.asarray(params)[[0, 0, 1, 2]])
    if model not in CAMERA_MODELS:
        raise GeometryError(
            f"model: {model!r} is not one of {', '.join(CAMERA_MODELS)}; undistort the images, or run COLMAP "
            "with --ImageReader.camera_model OPENCV"
        )
    return Camera(model, width, height, params)
