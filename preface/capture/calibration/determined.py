"""Whether the sightings determine what a calibration claims, and whether they fit it at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from preface.capture.calibration.adjustment import Adjusted, minimise
from preface.capture.calibration.covariance import Uncertainty
from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.state import RigState
from preface.capture.calibration.views import BoardViews
from preface.geometry.cameras import CAMERA_MODELS, Camera
from preface.geometry.errors import GeometryError

# A focal length less certain than this share of itself is none: at 1 m it misplaces a face by 5 cm.
FOCAL_TOLERANCE = 0.05
# Boards nearer to parallel with the image than this, degrees (root mean square): standard deviations, which
# come from a linear approximation, are then false, and other focal lengths are tried outright.
SMALL_TILT = 8.0
# Focal lengths that are tried, in shares of the solution's, and what rules them out: three standard deviations.
RIVAL_FOCALS = (0.95, 1.05)
RULED_OUT = 9.0
# Of sightings that agree within their view, this share must agree with the rest of the rig. Scattered
# outliers are not counted among them; half of a camera's views in the wrong place are.
MIN_INLIERS = 0.7

REMEDY = "tilt the board by 20 to 40 degrees in several directions and fill the image with it"


def require_fit(
    views: BoardViews, adjusted: Adjusted, trusted: np.ndarray, camera_ids: tuple[str, ...]
) -> None:
    """Refuse a rig from which a camera strays.

    Args:
        views, adjusted: the solution.
        trusted: [V, P], sightings that agree with their view's homography.
        camera_ids: for the message.

    Raises:
        CalibrationError: names the cameras, the worst first.
    """
    fits = np.bincount(views.camera, (adjusted.used & trusted).sum(axis=1), views.cameras)
    share = fits / np.bincount(views.camera, trusted.sum(axis=1), views.cameras)
    stray = [int(camera) for camera in np.argsort(share) if share[camera] < MIN_INLIERS]
    if not stray:
        return
    named = ", ".join(f"'{camera_ids[camera]}' ({share[camera]:.0%})" for camera in stray)
    swapped = " with one another" if len(stray) == 2 else ""
    raise CalibrationError(
        f"camera{'s' * (len(stray) > 1)} {named}: only this share of the corners fits one rigid rig. Were images"
        f" swapped{swapped}, frames shifted in time, or was the camera or its zoom moved? Are the board's "
        "description and size right? Correct that, or leave the camera out"
    )


def require_determined(
    views: BoardViews,
    adjusted: Adjusted,
    known: Uncertainty,
    free: np.ndarray,
    camera_ids: tuple[str, ...],
) -> None:
    """Refuse focal lengths that the sightings leave open.

    The predicted standard deviation must be small, and where boards are nearly parallel to the image, so that
    the prediction cannot be trusted, focal lengths 5% off must fit clearly worse.

    Raises:
        CalibrationError: names the camera and what its focal length may be.
    """
    state = adjusted.state
    deviation = known.standard_deviations[0][:, 0] / state.params[:, 0]
    for camera, name in enumerate(camera_ids):
        if not deviation[camera] <= FOCAL_TOLERANCE:
            raise CalibrationError(
                f"camera '{name}': its focal length is only known to {deviation[camera]:.1%} (one standard "
                f"deviation); {REMEDY}"
            )
    tilt = board_tilts(views, state)
    for camera in np.flatnonzero(tilt < SMALL_TILT):
        for rival in RIVAL_FOCALS:
            excess = _excess(views, adjusted, known.sigma, free, int(camera), rival)
            if excess < RULED_OUT:
                raise CalibrationError(
                    f"camera '{camera_ids[camera]}': its boards lean from the image by {tilt[camera]:.1f} degrees "
                    f"only, so that a focal length {abs(rival - 1):.0%} off fits as well; {REMEDY}"
                )


def require_unfolded(cameras: tuple[Camera, ...], camera_ids: tuple[str, ...]) -> None:
    """Refuse lenses that fold inside their image.

    Raises:
        CalibrationError: names the camera.
    """
    for camera, name in zip(cameras, camera_ids, strict=True):
        try:
            camera.require_unfolded()
        except GeometryError as error:
            raise CalibrationError(f"camera '{name}': {error}") from error


def board_tilts(views: BoardViews, state: RigState) -> np.ndarray:
    """Root mean square angle [C] between board and image plane, degrees."""
    cosine = np.abs(state.camera_from_board(views).rotation[:, 2, 2])
    square = np.degrees(np.arccos(np.clip(cosine, 0, 1))) ** 2
    count = np.bincount(views.camera, minlength=views.cameras)
    return np.sqrt(np.bincount(views.camera, square, views.cameras) / np.maximum(count, 1))


def _excess(
    views: BoardViews, adjusted: Adjusted, sigma: float, free: np.ndarray, camera: int, rival: float
) -> float:
    """How much worse another focal length fits when everything else gives way, in units of the variance."""
    state, n = adjusted.state, adjusted.state.params.shape[1]
    names = CAMERA_MODELS[state.model]
    focal = np.array([name in ("f", "fx", "fy") for name in names])
    params = state.params.copy()
    params[camera, focal] *= rival
    held = free.copy()
    held[camera * n : camera * n + n] &= ~focal
    # The boards recede with the focal length, which a short search would take long to find.
    pushed = replace(state, params=params)
    _, residual = minimise(views, pushed, adjusted.used, held, tolerance=1e-4, iterations=30)
    before = (adjusted.residuals[adjusted.used] ** 2).sum()
    after = (residual[adjusted.used] ** 2).sum()
    return float((after - before) / sigma**2)
