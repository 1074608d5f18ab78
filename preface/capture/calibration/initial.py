"""A start for each camera alone: robust homographies, a focal length, board poses.

The homography of each view says which sightings agree with one another; together the homographies say the
focal length (Zhang, "A flexible new technique for camera calibration", 2000, with the principal point at
the image's middle), and each then gives the board's pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from preface.capture.calibration.adjustment import CAUCHY_SIGMAS, minimise, residuals, spread
from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.state import RigState, free_head
from preface.capture.calibration.views import BoardViews
from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid, nearest_rotation

# Distortion bends a homography by less than this share of the board's extent in the image.
HOMOGRAPHY_TOLERANCE = 0.01
HOMOGRAPHY_TOLERANCE_PIXELS = 2.0
# What noise is judged with, and the inliers are found with: flexible enough for ordinary lenses.
FLEXIBLE_MODEL = "OPENCV"
# Points that a view must have: four fix a homography, two more check it.
MIN_POINTS = 6
# Views of a camera that must differ: each gives two equations, for focal length, principal point, distortion.
MIN_VIEWS = 3
# Boards closer than this in the image, pixels, are one and the same.
SAME_VIEW = 1.0
# Homographies alone give the focal length to a few per cent; a lens further off is another one, or was zoomed.
SAME_LENS = 0.15
# Focal lengths that are tried, in image widths or heights, whichever is greater.
FOCAL_RANGE = np.geomspace(0.2, 100, 200)


@dataclass(frozen=True, eq=False)
class Alone:
    """Each camera calibrated for itself.

    Attributes:
        views: those with a homography.
        trusted: [V, P], sightings that agree with their view's homography.
        state: RigState of the views set apart: `rig_from_board` holds camera_from_board of each view.
    """

    views: BoardViews
    trusted: np.ndarray
    state: RigState


def calibrate_alone(
    views: BoardViews,
    camera_ids: tuple[str, ...],
    image_sizes: tuple[tuple[int, int], ...],
    start: Mapping[str, Camera],
) -> Alone:
    """Find focal length, distortion and board poses of each camera for itself.

    Args:
        views, camera_ids, image_sizes: the problem.
        start: lenses by camera from elsewhere, of one model; they are begun with if all cameras have one and
            the homographies do not contradict. One radial coefficient is found without.

    Raises:
        CalibrationError: a camera that sees too few, or too few different, boards.
    """
    homographies, trusted = view_homographies(views)
    keep = trusted.sum(axis=1) >= MIN_POINTS
    views, homographies, trusted = views.select(keep), homographies[keep], trusted[keep]
    sizes = np.array(image_sizes, float)
    require_views(views, homographies, camera_ids)
    focal = np.array(
        [
            best_focal(_centred(homographies[views.camera == c], size / 2), float(size.max()))
            for c, size in enumerate(sizes)
        ]
    )
    model, params = _starting_lenses(focal, sizes, [start.get(name) for name in camera_ids])
    still = Rigid(np.tile(np.eye(3), (views.cameras, 1, 1)), np.zeros((views.cameras, 3)))
    state = RigState(model, params, still, still, np.zeros(2))
    lens = state.intrinsics[views.camera]
    poses = poses_of_homographies(_centred(homographies, lens[:, 2:4]), lens[:, 0])
    state = replace(state, rig_from_board=poses)
    return Alone(views, trusted, refine_alone(views.apart(), state, trusted))


def _centred(homographies: np.ndarray, principal_point: np.ndarray) -> np.ndarray:
    """Homographies [n, 3, 3] to pixels about the principal point [2] or [n, 2]."""
    centred = homographies.copy()
    centred[:, :2] -= principal_point[..., None] * homographies[:, 2:]
    return centred


def _starting_lenses(
    focal: np.ndarray, sizes: np.ndarray, given: Sequence[Camera | None]
) -> tuple[str, np.ndarray]:
    """Model and parameters [C, n] to begin with: the lenses given, unless one contradicts its focal length [C]."""
    lenses = [
        lens
        for lens, found in zip(given, focal, strict=True)
        if lens and abs(np.log(lens.intrinsics[0] / found)) < SAME_LENS
    ]
    if len(lenses) == len(focal):
        return lenses[0].model, np.stack([lens.params for lens in lenses])
    middle = sizes / 2
    params = np.stack([focal, middle[:, 0], middle[:, 1], np.zeros_like(focal)], axis=-1)
    return "SIMPLE_RADIAL", params


def sigma_alone(alone: Alone) -> float:
    """Noise per coordinate, pixels, that the cameras show alone, each view with its own board pose."""
    views, state = alone.views.apart(), alone.state.as_model(FLEXIBLE_MODEL)
    free = free_head(state, poses=False)
    state = _robust_rounds(views, state, alone.trusted, free)
    # The unknowns, six numbers of each pose among them, absorb some of the noise.
    coordinates = 2 * alone.trusted.sum()
    left = max(coordinates - 6 * len(views) - free.sum(), 0.1 * coordinates)
    return spread(residuals(views, state), alone.trusted) * float(np.sqrt(coordinates / left))


def refine_alone(views: BoardViews, state: RigState, trusted: np.ndarray) -> RigState:
    """Refine cameras on their own, principal points fixed, and settle each board's tilt.

    Far from the camera a board looks the same tilted towards it or away from it; both are tried.
    """
    free = free_head(state, fixed=("cx", "cy"), poses=False)
    state = _robust_rounds(views, state, trusted, free)
    nothing = np.zeros_like(free)
    kept, residual = minimise(views, state, trusted, nothing, tolerance=1e-3, iterations=5)
    turned, turned_residual = minimise(
        views,
        replace(state, rig_from_board=_tilted_back(state.rig_from_board)),
        trusted,
        nothing,
        tolerance=1e-3,
    )
    cost, turned_cost = (_view_costs(r, trusted) for r in (residual, turned_residual))
    better = turned_cost < 0.99 * cost
    if not better.any():
        return kept
    chosen = Rigid(
        np.where(better[:, None, None], turned.rig_from_board.rotation, kept.rig_from_board.rotation),
        np.where(better[:, None], turned.rig_from_board.translation, kept.rig_from_board.translation),
    )
    return _robust_rounds(views, replace(kept, rig_from_board=chosen), trusted, free)


def _robust_rounds(views: BoardViews, state: RigState, trusted: np.ndarray, free: np.ndarray) -> RigState:
    sigma = spread(residuals(views, state), trusted)
    for _ in range(6):
        state, residual = minimise(
            views, state, trusted, free, cauchy=CAUCHY_SIGMAS * sigma, tolerance=1e-3, iterations=10
        )
        before, sigma = sigma, spread(residual, trusted)
        if sigma > 0.9 * before:
            break
    return state


def _view_costs(residual: np.ndarray, trusted: np.ndarray) -> np.ndarray:
    """Median length [V] over the trusted points; infinite where one cannot be projected."""
    lengths = np.linalg.norm(residual, axis=-1)
    return np.nanmedian(np.where(trusted, np.where(np.isnan(lengths), np.inf, lengths), np.nan), axis=1)


def _tilted_back(poses: Rigid) -> Rigid:
    """Mirror each board's tilt: half a turn about the line of sight after half a turn in its plane."""
    sight = poses.translation / np.linalg.norm(poses.translation, axis=-1, keepdims=True)
    half_turn = 2 * sight[:, :, None] * sight[:, None, :] - np.eye(3)
    return Rigid(half_turn @ poses.rotation @ np.diag([-1.0, -1.0, 1.0]), poses.translation)


def view_homographies(views: BoardViews) -> tuple[np.ndarray, np.ndarray]:
    """Fit a homography to each view by RANSAC.

    Returns:
        pixels from board [V, 3, 3] (NaN where there is none), and the sightings that agree [V, P].
    """
    homographies = np.full((len(views), 3, 3), np.nan)
    trusted = np.zeros_like(views.seen)
    size = np.abs(views.points[:, :2]).max()
    plane = views.points[:, :2] / size
    for view, seen in enumerate(views.seen):
        if seen.sum() < MIN_POINTS:
            continue
        pixels = views.pixels[view, seen]
        extent = float(np.subtract(*np.percentile(pixels, [90, 10], axis=0)).max())
        tolerance = max(HOMOGRAPHY_TOLERANCE_PIXELS, HOMOGRAPHY_TOLERANCE * extent)
        matrix, agree = cv2.findHomography(
            plane[seen], pixels, cv2.RANSAC, tolerance, maxIters=2000, confidence=0.9999
        )
        if matrix is None or agree.sum() < max(MIN_POINTS, 0.3 * seen.sum()):
            continue
        homographies[view] = matrix @ np.diag([1 / size, 1 / size, 1])
        trusted[view, seen] = agree.ravel() > 0
    return homographies, trusted


def require_views(views: BoardViews, homographies: np.ndarray, camera_ids: tuple[str, ...]) -> None:
    """Refuse a camera that does not see three different boards.

    Raises:
        CalibrationError: naming the camera and how many boards it sees.
    """
    size = np.abs(views.points[:, :2]).max(axis=0)
    corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) * np.append(size, 1)
    for camera, name in enumerate(camera_ids):
        of_camera = views.camera == camera
        if not of_camera.any():
            raise CalibrationError(
                f"camera '{name}': it sees the board in no frame; check its images, which may be too small for the "
                "board's markers, and the board's description, or leave the camera out"
            )
        outlines = corners @ np.swapaxes(homographies[of_camera], -1, -2)
        different = _different((outlines[..., :2] / outlines[..., 2:]).reshape(len(outlines), -1))
        if different >= MIN_VIEWS:
            continue
        frames = int(of_camera.sum())
        same = f", of which {different} are different" if different < frames else ""
        raise CalibrationError(
            f"camera '{name}': it sees the board in {frames} frame{'s' * (frames != 1)}{same}; a camera takes "
            f"{MIN_VIEWS} or more, tilted differently by 20 to 40 degrees"
        )


def _different(outlines: np.ndarray) -> int:
    """Count outlines [n, 8] that differ from all kept before by more than a pixel, up to `MIN_VIEWS`."""
    kept: list[np.ndarray] = []
    for outline in outlines:
        if all(np.abs(outline - other).max() > SAME_VIEW for other in kept):
            kept.append(outline)
        if len(kept) == MIN_VIEWS:
            break
    return len(kept)


def best_focal(homographies: np.ndarray, size: float) -> float:
    """Return the focal length under which the board's axes are most nearly equal and at right angles.

    Args:
        homographies: [n, 3, 3], pixels about the principal point, from board.
        size: the image's greater side, pixels.
    """
    focal = FOCAL_RANGE[:, None] * size
    first, second = homographies[:, :, 0], homographies[:, :, 1]

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a[:, :2] * b[:, :2]).sum(axis=-1) / focal**2 + a[:, 2] * b[:, 2]

    aa, ab, bb = product(first, first), product(first, second), product(second, second)
    error = np.hypot(2 * ab, aa - bb) / (aa + bb)
    return float(focal[np.argmin(error.sum(axis=1)), 0])


def poses_of_homographies(homographies: np.ndarray, focal: np.ndarray) -> Rigid:
    """Return camera_from_board of homographies [V, 3, 3] about the principal point, with focal lengths [V]."""
    columns = homographies.copy()
    columns[:, :2] /= focal[:, None, None]
    columns /= np.linalg.norm(columns[:, :, :2], axis=1).mean(axis=-1)[:, None, None]
    columns *= np.where(columns[:, 2, 2] < 0, -1.0, 1.0)[:, None, None]
    first, second = columns[:, :, 0], columns[:, :, 1]
    rotation = nearest_rotation(np.stack([first, second, np.cross(first, second)], axis=-1))
    return Rigid(rotation, columns[:, :, 2])
