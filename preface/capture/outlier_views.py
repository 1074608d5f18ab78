"""Outliers on the images that they were found in: what a reader needs to see why they are wrong."""

from collections.abc import Callable

import cv2
import numpy as np

from preface.capture.calibration import Calibration
from preface.reports import contact_sheet, overlay_points
from preface.reports.pictures import GREEN, Picture, as_picture

RED, YELLOW = (255, 70, 60), (255, 215, 60)
MAX_VIEWS = 9
COLUMNS = 3
TILE = (400, 300)
RADIUS = 3.5  # pixels of the tile
MIN_CORNERS = 6  # of a view; fewer are left out for other reasons
MARGIN = 0.35  # of the board's extent, shown around it


def outlier_sheet(
    calibration: Calibration, load_image: Callable[[str, str], np.ndarray | None]
) -> Picture | None:
    """Cut-outs of the views with the largest errors, worst first; None where no image is at hand.

    Args:
        calibration: whose sightings are shown.
        load_image: (camera id, frame id) to an image as `preface.reports` takes it, or None.
    """
    tiles = []
    seen = calibration.observations
    for camera, frame in _worst_views(calibration):
        image = load_image(seen.camera_ids[camera], seen.frame_ids[frame])
        if image is not None:
            tiles.append(_tile(calibration, camera, frame, image))
    return contact_sheet(tiles, COLUMNS, TILE) if tiles else None


def views_left_out(calibration: Calibration) -> list[str]:
    """Views of which hardly a corner was used, as "camera frame"."""
    seen = calibration.observations
    frames = len(seen.frame_ids)
    used = np.bincount(seen.camera * frames + seen.frame, calibration.inliers, seen.counts.size)
    total = seen.counts.ravel()
    return [
        f"{seen.camera_ids[view // frames]} {seen.frame_ids[view % frames]}"
        for view in np.flatnonzero((total >= MIN_CORNERS) & (used < 0.2 * total))
    ]


def _worst_views(calibration: Calibration) -> list[tuple[int, int]]:
    """(camera, frame) of the views with the largest error of a corner left out."""
    seen = calibration.observations
    lengths = np.linalg.norm(calibration.residuals, axis=-1)
    lengths = np.where(np.isnan(lengths), -1.0, lengths)  # of views that could not be placed
    wrong = np.flatnonzero(~calibration.inliers)
    views: list[tuple[int, int]] = []
    for index in wrong[np.argsort(-lengths[wrong], kind="stable")]:
        view = (int(seen.camera[index]), int(seen.frame[index]))
        if view not in views:
            views.append(view)
        if len(views) == MAX_VIEWS:
            break
    return views


def _tile(calibration: Calibration, camera: int, frame: int, image: np.ndarray) -> tuple[Picture, str]:
    seen = calibration.observations
    mine = (seen.camera == camera) & (seen.frame == frame)
    wrong = mine & ~calibration.inliers
    pixels = seen.pixels[mine]
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = MARGIN * max(*(high - low), 40.0)
    size = np.array(image.shape[1::-1])
    left, top = np.clip(low - margin, 0, size - 1).astype(int)
    right, bottom = np.clip(high + margin, (left + 1, top + 1), size).astype(int)
    scale = min(TILE[0] / (right - left), TILE[1] / (bottom - top))
    shape = (max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale)))
    kind = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    cut = cv2.resize(as_picture(image[top:bottom, left:right]), shape, interpolation=kind)
    expected = seen.pixels[wrong] + calibration.residuals[wrong]
    for points, color in (
        (seen.pixels[mine & calibration.inliers], GREEN),
        (expected[np.isfinite(expected).all(axis=1)], YELLOW),
        (seen.pixels[wrong], RED),
    ):
        cut = overlay_points(cut, (points - (left, top)) * scale, None, RADIUS, color)
    worst = np.linalg.norm(calibration.residuals[wrong], axis=-1).max()
    size_of_error = f"worst {worst:.2f} px" if np.isfinite(worst) else "no board pose"
    return cut, f"{seen.camera_ids[camera]}, {seen.frame_ids[frame]}: {wrong.sum()} out, {size_of_error}"
