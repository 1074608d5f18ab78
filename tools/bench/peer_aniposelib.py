"""Runs under an interpreter that has aniposelib: joint solves by `CameraGroup.bundle_adjust_iter`.

    python peer_aniposelib.py PROBLEM.npz ...

Beside each problem, written by `calibration_peers`, it leaves PROBLEM.solved.npz. numpy, OpenCV and aniposelib
are all that it imports. aniposelib solves for one focal length, k1 and k2 per camera: principal points stay
where they start, and there is no tangential distortion.
"""

import sys
import time
from collections.abc import Mapping

import cv2
import numpy as np
from aniposelib.cameras import Camera, CameraGroup  # type: ignore[import-not-found]

PIXEL_CENTRE = 0.5  # OpenCV has the centre of the first pixel at (0, 0), the problems at (0.5, 0.5)


def cameras(problem: Mapping[str, np.ndarray]) -> list:
    """Return the cameras as the solve starts."""
    found = []
    for index, (fx, fy, cx, cy, *distortion) in enumerate(problem["params"]):
        matrix = np.array([[fx, 0, cx - PIXEL_CENTRE], [0, fy, cy - PIXEL_CENTRE], [0, 0, 1]])
        found.append(
            Camera(
                matrix=matrix,
                dist=np.array([*distortion, 0.0]),
                size=tuple(problem["sizes"][index]),
                rvec=cv2.Rodrigues(problem["camera_rotation"][index])[0],
                tvec=problem["camera_translation"][index],
                name=str(index),
                extra_dist=True,
            )
        )
    return found


def points(problem: Mapping[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return what bundle_adjust_iter wants: corners [C, F * P, 2], and to which board they belong, seen how."""
    boards, corners = len(problem["board_rotation"]), len(problem["points"])
    shape = (len(problem["params"]), boards, corners)
    pixels, rvecs, tvecs = (np.full((*shape, size), np.nan) for size in (2, 3, 3))
    for view, (camera, frame) in enumerate(zip(problem["camera"], problem["frame"], strict=True)):
        seen = problem["seen"][view]
        pixels[camera, frame, seen] = problem["pixels"][view, seen] - PIXEL_CENTRE
        rotation = problem["camera_rotation"][camera]
        rvecs[camera, frame, seen] = cv2.Rodrigues(rotation @ problem["board_rotation"][frame])[0].ravel()
        tvecs[camera, frame, seen] = (
            rotation @ problem["board_translation"][frame] + problem["camera_translation"][camera]
        )
    listed = [array.reshape(shape[0], -1, array.shape[-1]) for array in (pixels, rvecs, tvecs)]
    used = np.isfinite(listed[0][..., 0]).sum(axis=0) >= 2  # as its own extract_points(min_cameras=2)
    extra = {
        "objp": np.tile(problem["points"], (boards, 1))[used],
        "ids": np.repeat(np.arange(boards), corners)[used],
        "rvecs": listed[1][:, used],
        "tvecs": listed[2][:, used],
    }
    return listed[0][:, used], extra


def solve(problem: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return parameters [C, 8], rotations [C, 3, 3] and translations [C, 3] of the cameras, and seconds."""
    np.random.seed(0)  # it draws the points that it uses
    group, (pixels, extra) = CameraGroup(cameras(problem)), points(problem)
    began = time.perf_counter()
    group.bundle_adjust_iter(pixels, extra)
    seconds = time.perf_counter() - began
    params = []
    for camera in group.cameras:
        matrix, distortion = camera.get_camera_matrix(), camera.get_distortions()
        center = matrix[:2, 2] + PIXEL_CENTRE
        params.append([matrix[0, 0], matrix[1, 1], *center, *distortion[:4]])
    rotations = [cv2.Rodrigues(camera.get_rotation())[0] for camera in group.cameras]
    translations = [camera.get_translation() for camera in group.cameras]
    return {
        "params": np.array(params),
        "rotation": np.array(rotations),
        "translation": np.array(translations),
        "seconds": np.array(seconds),
    }


if __name__ == "__main__":
    for path in sys.argv[1:]:
        with np.load(path) as problem:
            np.savez(path.removesuffix(".npz") + ".solved.npz", allow_pickle=False, **solve(dict(problem)))
