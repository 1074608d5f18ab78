"""The part of a calibration's report that says how well things are known: over the image, and at a head."""

from collections.abc import Sequence

import numpy as np

from preface.capture.calibration import Calibration
from preface.capture.calibration.covariance import parameter_names
from preface.capture.calibration_figures import uncertainty_maps
from preface.capture.takes import KEYPOINTS, keypoints_between, middle_of_boards
from preface.geometry.transforms import Rigid
from preface.reports import Report

MAP_SAMPLES = 48  # of an uncertainty map along the image's longer side


def add_uncertainty(report: Report, calibration: Calibration) -> None:
    """Adds the section."""
    section = report.section(
        "Uncertainty",
        "Predicted from the geometry of the boards and the spread of the residuals, for points at rest in the "
        "volume where the boards were held. It covers the calibration alone, not the detection of a point.",
    )
    head = middle_of_boards(calibration)
    known = calibration.uncertainty.under("boards")
    centers = calibration.camera_from_rig.inverse.translation
    names, sizes, maps, rows = calibration.observations.camera_ids, [], [], []
    for index, camera in enumerate(calibration.cameras):
        step = max(camera.width, camera.height) / MAP_SAMPLES
        shape = (max(2, round(camera.height / step)), max(2, round(camera.width / step)))
        x = (np.arange(shape[1]) + 0.5) * camera.width / shape[1]
        y = (np.arange(shape[0]) + 0.5) * camera.height / shape[0]
        distance = float(np.linalg.norm(centers[index] - head))
        covariance = known.pixels(index, np.stack(np.meshgrid(x, y), axis=-1), distance)
        deviation = np.sqrt(traces(covariance) / 2)
        sizes.append((camera.width, camera.height))
        maps.append(deviation)
        parameters = parameter_names(camera.model)
        first, second, correlation = _strongest_correlation(known.intrinsics_correlation(index), parameters)
        rows.append(
            {
                "camera": names[index],
                "distance to the head": distance,
                "middle of the image": float(deviation[shape[0] // 2, shape[1] // 2]),
                "worst in the image": float(np.nanmax(deviation)),
                "strongest correlation": f"{first} with {second}",
                "of": correlation,
            }
        )
    section.plot(
        uncertainty_maps(names, sizes, maps),
        "Standard deviation per axis of where a point at the head's distance appears.",
        "Projection uncertainty over each camera's image",
        "png",
    )
    units = {"distance to the head": "m", "middle of the image": "px", "worst in the image": "px"}
    section.table(rows, "Projection uncertainty, worst first", units=units, sort_by="worst in the image")
    keypoints = [
        {"keypoint": name, "standard deviation": 1e6 * float(value)}
        for name, value in zip(KEYPOINTS, keypoint_deviations(calibration), strict=True)
    ]
    section.table(
        keypoints,
        "What the calibration adds to five keypoints of a head in the middle of the boards",
        units={"standard deviation": "µm"},
        sort_by="standard deviation",
    )


def keypoint_deviations(calibration: Calibration) -> np.ndarray:
    """Standard deviations [5] of keypoints, metres, by the calibration alone; NaN where two cameras see none."""
    points = keypoints_between(calibration)
    visible = np.zeros((len(points), len(calibration.cameras)), bool)
    poses = calibration.camera_from_rig
    for index, camera in enumerate(calibration.cameras):
        pixels, seen = camera.project(Rigid(poses.rotation[index], poses.translation[index]).apply(points))
        visible[:, index] = seen & ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=-1)
    covariance, _ = calibration.uncertainty.under("boards").points(points, visible, 1.0)
    return np.where(visible.sum(axis=1) >= 2, np.sqrt(traces(covariance)), np.nan)


def _strongest_correlation(matrix: np.ndarray, names: Sequence[str]) -> tuple[str, str, float]:
    """The two parameters of a lens that are hardest to tell apart; fx and fy, always alike, are not meant."""
    others = np.triu(np.abs(matrix), 1)
    if "fx" in names:
        others[names.index("fx"), names.index("fy")] = 0
    first, second = map(int, np.unravel_index(int(np.argmax(others)), others.shape))
    return names[first], names[second], float(matrix[first, second])


def traces(matrices: np.ndarray) -> np.ndarray:
    """Sums of the diagonals of matrices [..., n, n]."""
    return np.trace(matrices, axis1=-2, axis2=-1)
