"""Runs under an interpreter that has mrcal 2: joint solves by `mrcal.optimize`, with its own outlier rejection.

    python peer_mrcal.py PROBLEM.npz ...

Beside each problem, written by `calibration_peers`, it leaves PROBLEM.solved.npz. numpy and mrcal are all
that it imports.
"""

import sys
import time
from collections.abc import Mapping

import mrcal  # type: ignore[import-not-found]
import numpy as np

PIXEL_CENTRE = 0.5  # mrcal has the centre of the first pixel at (0, 0), the problems at (0.5, 0.5)


def poses(rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Return poses as mrcal has them: rotation vector, translation, [N, 6]."""
    matrices = np.concatenate([rotations, translations[:, None]], axis=1)  # its Rt is [4, 3]
    return np.ascontiguousarray(mrcal.rt_from_Rt(np.ascontiguousarray(matrices)))


def solve(problem: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return parameters [C, 8], rotations [C, 3, 3] and translations [C, 3] of the cameras, and seconds."""
    frames, frame = np.unique(problem["frame"], return_inverse=True)
    order = np.lexsort((problem["camera"], frame))  # it wants views by frame, then by camera
    camera, frame = problem["camera"][order], frame[order]
    rows, columns = problem["shape"]
    corners = np.empty((len(order), rows, columns, 3))
    corners[..., :2] = problem["pixels"][order].reshape(len(order), rows, columns, 2) - PIXEL_CENTRE
    corners[..., 2] = np.where(problem["seen"][order].reshape(corners.shape[:3]), 1.0, -1.0)  # < 0: not there
    intrinsics = problem["params"].copy()
    intrinsics[:, 2:4] -= PIXEL_CENTRE
    cameras = poses(problem["camera_rotation"], problem["camera_translation"])[1:].copy()
    boards = poses(problem["board_rotation"][frames], problem["board_translation"][frames])
    began = time.perf_counter()
    mrcal.optimize(
        intrinsics,
        cameras,
        boards,
        None,
        corners,
        np.stack([frame, camera, camera - 1], axis=1).astype(np.int32),
        None,
        None,
        lensmodel="LENSMODEL_OPENCV4",
        imagersizes=problem["sizes"].astype(np.int32),
        calibration_object_spacing=float(problem["spacing"]),
        do_optimize_calobject_warp=False,
        do_apply_outlier_rejection=True,
    )
    seconds = time.perf_counter() - began
    intrinsics[:, 2:4] += PIXEL_CENTRE
    matrices = np.concatenate([mrcal.identity_Rt()[None], mrcal.Rt_from_rt(cameras)])
    return {
        "params": intrinsics,
        "rotation": matrices[:, :3],
        "translation": matrices[:, 3],
        "seconds": np.array(seconds),
    }


if __name__ == "__main__":
    for path in sys.argv[1:]:
        with np.load(path) as problem:
            np.savez(path.removesuffix(".npz") + ".solved.npz", allow_pickle=False, **solve(problem))
