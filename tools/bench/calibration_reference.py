"""What is true of a rig, from a synthetic studio or a simulation, and how far a calibration is from it.

Rigs have no frame of their own: a calibration is turned and shifted, but not scaled, so that its camera centres
lie nearest to the true ones, and the Cramer-Rao bound is taken under the same condition. The bound is that of
the true camera model over the sightings that the calibration used, with their true noise; a calibration that
chose fewer parameters than the truth has may stay below it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.calibration_scene import Scene, exact_pixels
from preface.artifacts import load_json
from preface.capture.calibration import Calibration
from preface.capture.calibration.covariance import uncertainty
from preface.capture.calibration.state import RigState, free_head
from preface.capture.calibration.views import stack_views
from preface.capture.observations import Observations
from preface.capture.rig import read_rig
from preface.geometry import Camera, Rigid, fit_similarity


@dataclass(frozen=True, eq=False)
class Reference:
    """The truth behind sightings, cameras and frames in the sightings' order.

    Attributes:
        cameras: C lenses of one model.
        camera_from_rig: C poses.
        rig_from_board: F poses, of the frame in which the sightings have their board points.
        bowed: whether the board is not flat.
        pixels: [M, 2], where each sighting would be without noise; NaN where the lens has no image.
        visible: how many corners were to be seen, all cameras and frames together.
    """

    cameras: tuple[Camera, ...]
    camera_from_rig: Rigid
    rig_from_board: Rigid
    bowed: bool
    pixels: np.ndarray
    visible: int


@dataclass(frozen=True)
class Errors:
    """RMS errors of a calibration, and what the Cramer-Rao bound allows.

    Attributes:
        center: of the camera centres, metres.
        center_bound: the same by the bound.
        focal: of the focal lengths, relative.
        focal_bound: the same by the bound.
        noise: standard deviation per coordinate of the sightings that were used, pixels, against truth.
    """

    center: float
    center_bound: float
    focal: float
    focal_bound: float
    noise: float


def of_scene(scene: Scene) -> Reference:
    """The truth of a simulation."""
    return Reference(
        scene.cameras,
        scene.camera_from_rig,
        scene.rig_from_board,
        any(scene.config.bow),
        exact_pixels(scene),
        len(scene.observations),
    )


def of_studio(studio: Path, take: str, seen: Observations) -> Reference:
    """The truth of sightings in a take of a studio that `tools/synthetic_studio` made.

    Raises:
        ArtifactError: the studio has no such truth.
        ValueError: the sightings are of another board.
    """
    folder = studio / "truth" / "takes" / take
    rig, boards = read_rig(folder / "rig.json"), load_json(folder / "boards.json")
    corners = np.array(boards["board"]["corners"])
    shift = corners[0] - seen.board_points[0]
    shift[2] = 0.0
    if corners.shape != seen.board_points.shape or not np.allclose(
        (corners - seen.board_points)[:, :2], shift[:2], atol=1e-9
    ):
        raise ValueError(f"{folder / 'boards.json'}: the sightings are of another board")
    poses = {
        frame["name"]: Rigid.from_quaternion(
            np.array(frame["rig_from_board"]["quaternion_wxyz"]),
            np.array(frame["rig_from_board"]["translation"]),
        )
        for frame in boards["frames"]
    }
    cameras = [rig.cameras[name] for name in seen.camera_ids]
    all_frames, all_cameras = list(poses), list(rig.cameras)
    frames = [all_frames.index(name) for name in seen.frame_ids]
    columns = [all_cameras.index(name) for name in seen.camera_ids]
    with np.load(folder / "corners.npz") as truth:
        pixels = truth["pixels"][frames][:, columns]  # [F, C, N, 2]
        visible = int(truth["visible"][frames][:, columns].sum())
    return Reference(
        tuple(camera.camera for camera in cameras),
        _stacked([camera.camera_from_rig for camera in cameras]),
        _stacked([poses[name] for name in seen.frame_ids]) @ Rigid(np.eye(3), shift),
        any(boards["board"]["bow"]),
        pixels[seen.frame, seen.camera, seen.point],
        visible,
    )


def errors(calibration: Calibration, truth: Reference) -> Errors:
    """Hold a calibration of the reference's sightings, or of some of their frames, against the truth."""
    used = calibration.inliers
    noise = float(np.sqrt(np.mean((calibration.observations.pixels - truth.pixels)[used] ** 2)))
    found, true = (pose.inverse.translation for pose in (calibration.camera_from_rig, truth.camera_from_rig))
    fit = fit_similarity(found, true, fixed_scale=1.0).target_from_source
    focal = np.array([camera.intrinsics[:2] for camera in calibration.cameras])
    true_focal = np.array([camera.intrinsics[:2] for camera in truth.cameras])
    center_bound, focal_bound = _bound(calibration, truth, noise)
    return Errors(
        center=float(np.sqrt(((fit.apply(found) - true) ** 2).sum(axis=-1).mean())),
        center_bound=center_bound,
        focal=float(np.sqrt(((focal / true_focal - 1) ** 2).mean())),
        focal_bound=focal_bound,
        noise=noise,
    )


def _bound(calibration: Calibration, truth: Reference, noise: float) -> tuple[float, float]:
    """RMS errors that the bound allows: camera centres (metres), focal lengths (relative)."""
    seen = calibration.observations
    views, _ = stack_views(seen.subset(calibration.inliers))
    params = np.stack([camera.params for camera in truth.cameras])
    model = truth.cameras[0].model
    boards = truth.rig_from_board @ Rigid(np.eye(3), views.center)
    state = RigState(model, params, truth.camera_from_rig, boards, np.zeros(2))
    free = free_head(state, warp=truth.bowed)
    known = uncertainty(views, state, views.seen, free, seen.camera_ids, sigma=noise).under("cameras")
    centers = np.trace(known.centers(), axis1=1, axis2=2).mean()
    focal = known.standard_deviations[0][:, :2] / params[:, :2]
    return float(np.sqrt(centers)), float(np.sqrt((focal**2).mean()))


def _stacked(poses: list[Rigid]) -> Rigid:
    return Rigid(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
