"""From sightings of a board to a rig with its uncertainty: the one entry to the calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from preface.capture.calibration.adjustment import Adjusted, adjust_robustly, least_squares, minimise
from preface.capture.calibration.colmap_backend import adjust_with_colmap
from preface.capture.calibration.covariance import Uncertainty, uncertainty
from preface.capture.calibration.determined import require_determined, require_fit, require_unfolded
from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.folding import unfolded
from preface.capture.calibration.initial import FLEXIBLE_MODEL, Alone, calibrate_alone, sigma_alone
from preface.capture.calibration.selection import Candidate, held_out, select_model
from preface.capture.calibration.spanning_tree import assemble
from preface.capture.calibration.state import free_head
from preface.capture.calibration.unsynchronised import adjust_moving, unsynchronised
from preface.capture.calibration.views import BoardViews, stack_views
from preface.capture.observations import Observations
from preface.capture.rig import Coverage, HeldOutError, ReprojectionError, Rig, RigCamera, StandardDeviations
from preface.geometry.cameras import CAMERA_MODELS, Camera
from preface.geometry.transforms import Rigid

CameraModel = Literal["auto", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"]

# A rigid rig whose errors exceed its cameras' own by this factor is reported: its standard deviations are wrong.
SUSPICIOUS = 2.0


@dataclass(frozen=True)
class CalibrationOptions:
    """How to calibrate.

    Attributes:
        camera_model: a COLMAP model, or "auto": the simplest that held-out frames support.
        board_warp: whether the board may bow, by two parameters; "auto" leaves it to held-out frames.
        folds: parts that frames are divided into to hold one out at a time.
        backend: "own" Levenberg-Marquardt, or "pycolmap", which keeps the board's shape as ours found it.
    """

    camera_model: CameraModel = "auto"
    board_warp: Literal["auto", "on", "off"] = "auto"
    folds: int = 5
    backend: Literal["own", "pycolmap"] = "own"

    def __post_init__(self) -> None:
        if self.camera_model != "auto" and self.camera_model not in CAMERA_MODELS:
            raise CalibrationError(
                f"camera_model: '{self.camera_model}' is unknown; use auto or one of {', '.join(CAMERA_MODELS)}"
            )
        if self.folds < 2:
            raise CalibrationError(f"folds: {self.folds} is less than 2; 5 is usual")


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated rig, and how it was found.

    Attributes:
        observations: the sightings.
        cameras: C lenses, in the order of `observations.camera_ids`.
        camera_from_rig: C poses; the rig's frame is the first camera's.
        rig_from_board: pose of the board by frame id; frames that nothing sure was seen in are absent.
        board_warp: [2] metres, the bow of the board's middle along x and along y; zero for a flat board.
        inliers: [M], the sightings that the rig was fitted to.
        residuals: [M, 2] pixels, projected minus measured, also of outliers; NaN in frames that are absent. Where
            cameras are not simultaneous, the board is projected from where it was in each view.
        uncertainty: covariances, first camera as datum; `uncertainty.under("boards")` is free of the gauge.
        held_out: error over frames that were held out in turn; None if there were too few.
        selection: the candidates among which models were chosen, simplest first; empty without a choice.
        sigma_alone: noise per coordinate, pixels, when every view has a board pose of its own: what the
            corners are worth.
        motion: typical turn (radians) and shift (metres) of the board between a frame's views, along each axis,
            where cameras turned out not to be simultaneous; None otherwise.
        residuals_at_rest: [M, 2] pixels, as if the board stood still in each frame, where `rig_from_board` has it.
    """

    observations: Observations
    cameras: tuple[Camera, ...]
    camera_from_rig: Rigid
    rig_from_board: Mapping[str, Rigid]
    board_warp: np.ndarray
    inliers: np.ndarray
    residuals: np.ndarray
    uncertainty: Uncertainty
    held_out: HeldOutError | None
    selection: tuple[Candidate, ...]
    sigma_alone: float
    motion: tuple[float, float] | None
    residuals_at_rest: np.ndarray

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know although the calibration went through."""
        if self.motion is not None:
            turn, shift = self.motion
            return (
                f"the cameras do not take a frame at the same instant: from view to view the board moves by "
                f"{1e3 * shift:.2g} mm and {np.degrees(turn):.2g} degrees along each axis. Lenses were "
                "calibrated from each view's own shape, poses from the mean over frames. The reprojection RMS of "
                f"{self.reprojection_rms:.3f} px has this motion taken out; with a board at rest in each frame it is "
                f"{self.reprojection_rms_at_rest:.2f} px. Hold the board still, or trigger the cameras together",
            )
        ratio = self.uncertainty.sigma / self.sigma_alone
        if ratio < SUSPICIOUS:
            return ()
        return (
            f"errors are {ratio:.1f} times larger in the rig ({self.uncertainty.sigma:.2f} px) than in each camera "
            f"alone ({self.sigma_alone:.2f} px): the camera model is too simple, the cameras do not take a frame "
            "at the same instant, or something moved. Standard deviations are then too small; try --camera-model "
            "auto, and hold the board still in each frame",
        )

    @property
    def reprojection_rms(self) -> float:
        """Over the inliers, pixels."""
        return float(np.sqrt((self.residuals[self.inliers] ** 2).sum(axis=-1).mean()))

    @property
    def reprojection_rms_at_rest(self) -> float:
        """Over the inliers, pixels, as if the board stood still in each frame."""
        return float(np.sqrt((self.residuals_at_rest[self.inliers] ** 2).sum(axis=-1).mean()))

    def rig(self, take: str) -> Rig:
        """Return the artefact `rig.json` holds."""
        params, rotation, translation = self.uncertainty.standard_deviations
        cameras = {}
        for index, name in enumerate(self.observations.camera_ids):
            pose = Rigid(self.camera_from_rig.rotation[index], self.camera_from_rig.translation[index])
            cameras[name] = RigCamera.at(
                self.cameras[index],
                pose,
                reprojection_error=self._reprojection_error(index),
                standard_deviations=StandardDeviations(
                    tuple(params[index].tolist()),
                    tuple(rotation[index].tolist()),
                    tuple(translation[index].tolist()),
                ),
                covariance=tuple(tuple(row) for row in self.uncertainty.camera(index).tolist()),
                coverage=self._coverage(index),
            )
        metadata = {}
        if self.motion is not None:
            metadata["motion_within_frames"] = {
                "rotation": self.motion[0],
                "translation": self.motion[1],
                "reprojection_rms_at_rest": self.reprojection_rms_at_rest,
            }
        return Rig(take, cameras, self.held_out, metadata=metadata)

    def _reprojection_error(self, camera: int) -> ReprojectionError:
        mine = self.inliers & (self.observations.camera == camera)
        length = np.linalg.norm(self.residuals[mine], axis=-1)
        return ReprojectionError(
            float(np.sqrt((length**2).mean())), float(np.median(length)), int(mine.sum())
        )

    def _coverage(self, camera: int) -> Coverage:
        mine = self.inliers & (self.observations.camera == camera)
        hull = cv2.convexHull(self.observations.pixels[mine].astype(np.float32))
        width, height = self.observations.image_sizes[camera]
        share = min(cv2.contourArea(hull) / (width * height), 1.0)
        return Coverage(len(np.unique(self.observations.frame[mine])), share)


def calibrate_rig(
    observations: Observations, options: CalibrationOptions, start: Calibration | None = None
) -> Calibration:
    """Calibrate a rig from sightings of one board.

    Args:
        observations: the sightings.
        options: how to.
        start: of the same cameras at another time, whose lenses are begun with unless they contradict.

    Raises:
        CalibrationError: the sightings do not determine the rig: too few or too similar frames, cameras that
            share none, boards parallel to the image, a camera that contradicts the others, or a lens that
            folds inside its image. The message names the camera and the remedy.
    """
    all_views, view_of = stack_views(observations)
    names, sizes = observations.camera_ids, observations.image_sizes
    lenses = dict(zip(start.observations.camera_ids, start.cameras, strict=True)) if start else {}
    alone = calibrate_alone(all_views, names, sizes, lenses)
    views = alone.views
    noise = sigma_alone(alone)
    adjusted = _first_solution(alone, names, sizes, options, noise)
    require_fit(views, adjusted, alone.trusted, names)
    adjusted, free, table = _modelled(views, adjusted, options, names, sizes)
    if options.backend == "pycolmap":
        adjusted = adjust_with_colmap(views, adjusted.state, adjusted.used, sizes)
    require_fit(views, adjusted, alone.trusted, names)
    known = uncertainty(views, adjusted.state, adjusted.used, free, names)
    require_determined(views, adjusted, known, free, names)
    cameras = tuple(
        Camera(adjusted.state.model, *size, params)
        for size, params in zip(sizes, adjusted.state.params, strict=True)
    )
    require_unfolded(cameras, names)
    at_rest = _at_rest(views, adjusted)
    row = np.full(len(all_views), -1)
    row[_rows(all_views, views)] = np.arange(len(views))
    row_of = row[view_of]
    inliers = (row_of >= 0) & adjusted.used[row_of, observations.point]
    known_row = (row_of >= 0)[:, None]
    return Calibration(
        observations=observations,
        cameras=cameras,
        camera_from_rig=adjusted.state.camera_from_rig,
        rig_from_board=_board_poses(views, at_rest, observations),
        board_warp=adjusted.state.warp,
        inliers=inliers,
        residuals=np.where(known_row, adjusted.residuals[row_of, observations.point], np.nan),
        uncertainty=known,
        held_out=_held_out_error(views, adjusted, free, options.folds),
        selection=table,
        sigma_alone=noise,
        motion=_motion(adjusted),
        residuals_at_rest=np.where(known_row, at_rest.residuals[row_of, observations.point], np.nan),
    )


def _first_solution(
    alone: Alone,
    names: tuple[str, ...],
    sizes: tuple[tuple[int, int], ...],
    options: CalibrationOptions,
    noise: float,
) -> Adjusted:
    """Adjust the rig robustly, under the asked or a flexible model and the board as flexible as allowed.

    Where the cameras alone fit much better, to `noise` pixels, the board may move within frames.
    """
    model = FLEXIBLE_MODEL if options.camera_model == "auto" else options.camera_model
    rough, trusted = assemble(alone, names, sizes)
    start = rough.as_model(model)
    free = free_head(start, warp=options.board_warp != "off")
    adjusted = adjust_robustly(alone.views, start, trusted, free)
    if options.backend == "own" and unsynchronised(adjusted, trusted, noise):
        return adjust_moving(alone, start, trusted, free)
    return adjusted


def _motion(adjusted: Adjusted) -> tuple[float, float] | None:
    if adjusted.state.motion is None:
        return None
    return float(adjusted.state.motion.deviations[0]), float(adjusted.state.motion.deviations[3])


def _at_rest(views: BoardViews, adjusted: Adjusted) -> Adjusted:
    """The solution with boards that stand still in each frame, where they suit all its views best."""
    if adjusted.state.motion is None:
        return adjusted
    still = replace(adjusted.state, motion=None)
    state, residual = minimise(views, still, adjusted.used, np.zeros(still.head_size, bool))
    return Adjusted(state, adjusted.used, np.where(views.seen[..., None], residual, np.nan))


def _modelled(
    views: BoardViews,
    adjusted: Adjusted,
    options: CalibrationOptions,
    names: tuple[str, ...],
    sizes: tuple[tuple[int, int], ...],
) -> tuple[Adjusted, np.ndarray, tuple[Candidate, ...]]:
    """Settle the camera model and the board's shape: as asked, or by held-out frames; say what is free [Nh]."""
    models = tuple(CAMERA_MODELS) if options.camera_model == "auto" else (options.camera_model,)
    warps = {"auto": (False, True), "on": (True,), "off": (False,)}[options.board_warp]
    if len(models) * len(warps) == 1:
        adjusted, free = unfolded(views, adjusted, free_head(adjusted.state, warp=warps[0]), sizes)
        return adjusted, free, ()
    table, state, free = select_model(views, adjusted, models, warps, options.folds, names, sizes)
    return least_squares(views, state, adjusted.used, free), free, table


def _board_poses(views: BoardViews, adjusted: Adjusted, observations: Observations) -> dict[str, Rigid]:
    """Poses of the board's own frame, whose origin need not be its middle."""
    from_middle = Rigid(np.eye(3), -views.center)
    poses = adjusted.state.rig_from_board
    return {
        observations.frame_ids[frame]: Rigid(poses.rotation[frame], poses.translation[frame]) @ from_middle
        for frame in np.unique(views.frame[adjusted.used.any(axis=1)])
    }


def _held_out_error(
    views: BoardViews, adjusted: Adjusted, free: np.ndarray, folds: int
) -> HeldOutError | None:
    frames = np.unique(views.frame[adjusted.used.any(axis=1)])
    if len(frames) < 2 * folds:
        return None
    residual = held_out(views, adjusted, free, [frames[start::folds] for start in range(folds)])
    squared = (residual**2).sum(axis=-1)
    counted = np.isfinite(squared)
    return HeldOutError(float(np.sqrt(squared[counted].mean())), int(counted.sum()))


def _rows(all_views: BoardViews, views: BoardViews) -> np.ndarray:
    """Which of all views the remaining ones are."""
    key = all_views.camera * all_views.frames + all_views.frame
    return np.searchsorted(key, views.camera * views.frames + views.frame)
