"""The borders to other programs, held against those programs."""

import cv2
import numpy as np
import pytest

from preface.geometry import Camera, GeometryError, Rigid, nearest_rotation
from preface.geometry.conventions import (
    camera_from_colmap,
    camera_from_opencv,
    camera_to_opencv,
    pixels_from_opencv,
    pixels_to_opencv,
    pose_from_opencv,
    pose_from_opengl,
    pose_to_opencv,
    pose_to_opengl,
)

K = np.array([[1500.0, 0, 319.5], [0, 1510, 479.5], [0, 0, 1]])


def random_pose(*batch: int) -> Rigid:
    rng = np.random.default_rng(0)
    return Rigid(nearest_rotation(rng.normal(size=(*batch, 3, 3))), rng.normal(size=(*batch, 3)))


def test_opencv_calls_the_first_pixel_centre_zero() -> None:
    assert pixels_from_opencv(np.zeros(2)).tolist() == [0.5, 0.5]
    assert pixels_to_opencv(np.array([0.5, 0.5])).tolist() == [0, 0]


def test_opencv_principal_point_moves_by_half_a_pixel() -> None:
    camera = camera_from_opencv(K, np.zeros(5), 640, 960)
    assert camera == Camera("PINHOLE", 640, 960, [1500, 1510, 320, 480])


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ([], "PINHOLE"),
        ([0.1, 0.2, 0.01, 0.02], "OPENCV"),
        ([0.1, 0.2, 0.01, 0.02, 0], "OPENCV"),
        ([0.1, 0.2, 0.01, 0.02, 0.3], "FULL_OPENCV"),
        ([0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6], "FULL_OPENCV"),
        ([0.1, 0.2, 0.01, 0.02] + [0] * 10, "OPENCV"),
    ],
)
def test_opencv_calibrations_come_back_from_the_simplest_model(distortion: list[float], model: str) -> None:
    camera = camera_from_opencv(K, np.array([distortion]), 640, 960)
    assert camera.model == model
    K_back, distortion_back = camera_to_opencv(camera)
    np.testing.assert_array_equal(K_back, K)
    np.testing.assert_array_equal(distortion_back, (distortion + [0] * 8)[:8])


@pytest.mark.parametrize(
    ("matrix", "distortion", "message"),
    [
        (K + np.array([[0, 1.5, 0], [0, 0, 0], [0, 0, 0]]), [], "K: its skew 1.5 is not zero"),
        (K.T, [], "not a calibration matrix"),
        (-K, [], "not a calibration matrix"),
        (K * [[-1], [1], [1]], [], "fx .* a focal length is positive"),
        (K, [0] * 8 + [0.1, 0, 0, 0], "CALIB_THIN_PRISM_MODEL"),
        (K, [0] * 15, "more than"),
    ],
)
def test_opencv_calibrations_without_a_colmap_model_are_refused(
    matrix: np.ndarray, distortion: list[float], message: str
) -> None:
    with pytest.raises(GeometryError, match=message):
        camera_from_opencv(matrix, distortion, 640, 960)


def test_opencv_poses_move_points_as_opencv_does() -> None:
    pose = random_pose()
    rvec, tvec = pose_to_opencv(pose)
    np.testing.assert_allclose(cv2.Rodrigues(rvec)[0], pose.rotation, atol=1e-14)
    points = np.random.default_rng(1).normal(size=(5, 3)) + pose.inverse.apply([0, 0, 10])
    expected = cv2.projectPoints(points, rvec, tvec, K, None)[0][:, 0]
    camera = camera_from_opencv(K, np.zeros(4), 640, 960)
    np.testing.assert_allclose(camera.project(pose.apply(points))[0], expected + 0.5, atol=1e-9)
    np.testing.assert_allclose(pose_from_opencv(rvec[:, None], tvec).matrix, pose.matrix, atol=1e-14)


def test_opengl_looks_along_minus_z_with_y_up() -> None:
    c2w = np.eye(4)
    c2w[:3, 3] = 1, 2, 3
    pose = pose_from_opengl(c2w)
    ahead, above, beside = [1, 2, -2], [1, 3, -2], [2, 2, -2]
    np.testing.assert_allclose(
        pose.apply([ahead, above, beside]), [[0, 0, 5], [0, -1, 5], [1, 0, 5]], atol=1e-15
    )


def test_opengl_poses_come_back() -> None:
    pose = random_pose(6)
    matrices = pose_to_opengl(pose)
    assert matrices.shape == (6, 4, 4)
    np.testing.assert_allclose(np.linalg.det(matrices[:, :3, :3]), 1, atol=1e-12)
    np.testing.assert_allclose(pose_from_opengl(matrices).matrix, pose.matrix, atol=1e-14)
    np.testing.assert_allclose(pose_from_opengl(matrices[:, :3]).matrix, pose.matrix, atol=1e-14)


def test_colmap_cameras_are_taken_as_they_are() -> None:
    assert camera_from_colmap("SIMPLE_PINHOLE", 64, 96, [50.0, 30, 40]).params.tolist() == [50, 50, 30, 40]
    assert camera_from_colmap("RADIAL", 64, 96, [50.0, 30, 40, 0.1, 0.2]).model == "RADIAL"
    with pytest.raises(GeometryError, match="SIMPLE_PINHOLE takes 3 numbers"):
        camera_from_colmap("SIMPLE_PINHOLE", 64, 96, [50.0, 30])
    with pytest.raises(GeometryError, match=r"'OPENCV_FISHEYE' is not one of .*undistort the images"):
        camera_from_colmap("OPENCV_FISHEYE", 64, 96, [50.0] * 8)
