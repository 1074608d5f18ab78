"""The report of one calibrated take: how accurate, where not, why this model, and what was left out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from preface.capture.calibration import Calibration
from preface.capture.calibration.covariance import parameter_names
from preface.capture.calibration.selection import CRITERION
from preface.capture.calibration_figures import (
    CameraResiduals,
    coverage_maps,
    error_matrix,
    residual_fields,
    rig_view,
)
from preface.capture.epipolar import epipolar_errors
from preface.capture.outlier_views import outlier_sheet, views_left_out
from preface.capture.takes import CameraDrift, board_outlines
from preface.capture.uncertainty_section import add_uncertainty, keypoint_deviations, traces
from preface.reports import KeyFigure, Report, Section, Target

MAX_FRAMES_LISTED = 20
MAX_NAMED = 6  # views in a sentence
HELD_OUT_EXCESS = 1.1  # a held-out error beyond this many times the training error speaks of over-fitting
MAX_OUTLIERS = 0.1  # of the sightings; more than a tenth of them wrong is no ordinary detector's

LoadImage = Callable[[str, str], np.ndarray | None]  # (camera id, frame id) to an image, where it is at hand


@dataclass(frozen=True)
class TakeDrift:
    """What moved since a neighbouring take."""

    since: str
    cameras: Sequence[CameraDrift] = field(default_factory=tuple)


def calibration_report(
    take: str,
    calibration: Calibration,
    provenance: Mapping[str, Any],
    load_image: LoadImage,
    drifts: Sequence[TakeDrift],
) -> Report:
    """Put the report together.

    Args:
        take: its name.
        calibration: its result.
        provenance: of the rig; the page ends with it.
        load_image: gives the images that show outliers; None where an image is not at hand.
        drifts: against neighbouring takes; empty for a single one.
    """
    report = Report(f"Calibration of take '{take}'", provenance)
    _summary(report, calibration)
    _cameras(report, calibration)
    _residuals(report, calibration)
    _frames(report, calibration)
    _pairs(report, calibration)
    add_uncertainty(report, calibration)
    _selection(report, calibration)
    _rig(report, calibration)
    _outliers(report, calibration, load_image)
    if drifts:
        _drift(report, drifts)
    return report


# ----------------------------------------------------------------------------------------- sections


def _summary(report: Report, calibration: Calibration) -> None:
    section = report.section(
        "Summary",
        "The reprojection error says how well the rig explains its own corners. It is no measure of accuracy: "
        "that is what the held-out error and the predicted standard deviations are for.",
    )
    rms, held = calibration.reprojection_rms, calibration.held_out
    left_out = 1 - calibration.inliers.mean()
    chosen = calibration.cameras[0].model
    bow = np.abs(calibration.board_warp).max() * 1e3
    centers = np.sqrt(traces(calibration.uncertainty.under("boards").centers()).mean() / 3)
    keypoints = keypoint_deviations(calibration)
    section.key_figures(
        [
            KeyFigure("Reprojection error, RMS", rms, "px"),
            KeyFigure(
                "Held-out error, RMS", held.rms if held else None, "px", Target(at_most=HELD_OUT_EXCESS * rms)
            ),
            KeyFigure("Left out as outliers", 100 * left_out, "%", Target(at_most=100 * MAX_OUTLIERS)),
            KeyFigure("Camera centres, one standard deviation per axis", 1e3 * centers, "mm"),
            KeyFigure(
                "Keypoints of a head, error of the calibration", 1e6 * _root_mean_square(keypoints), "µm"
            ),
        ]
    )
    section.key_figures(
        [
            KeyFigure("Cameras", len(calibration.cameras)),
            KeyFigure("Frames", len(calibration.rig_from_board)),
            KeyFigure("Corners used", int(calibration.inliers.sum())),
            KeyFigure("Camera model", chosen),
            KeyFigure("Bow of the board", bow, "mm") if bow else KeyFigure("Board", "flat"),
        ]
    )
    for warning in calibration.warnings:
        section.text(f"Note: {warning}.")


def _cameras(report: Report, calibration: Calibration) -> None:
    section = report.section("Cameras")
    seen, lengths = calibration.observations, np.linalg.norm(calibration.residuals, axis=-1)
    known = calibration.uncertainty.under("boards")
    params, rotation, _ = known.standard_deviations
    centers = np.sqrt(traces(known.centers()) / 3)
    errors: list[dict[str, Any]] = []
    lenses: list[dict[str, Any]] = []
    for index, (name, entry) in enumerate(calibration.rig("take").cameras.items()):
        mine = seen.camera == index
        error, coverage, lens = entry.reprojection_error, entry.coverage, entry.camera
        assert error is not None
        assert coverage is not None
        errors.append(
            {
                "camera": name,
                "RMS": error.rms,
                "median": error.median,
                "worst used": float(lengths[mine & calibration.inliers].max()),
                "corners": error.count,
                "frames": coverage.frames,
                "left out": 100 * float(1 - calibration.inliers[mine].mean()),
                "image covered": 100 * coverage.image_fraction,
            }
        )
        of_lens = parameter_names(lens.model)
        lenses.append(
            {
                "camera": name,
                "focal length": float(lens.intrinsics[0]),
                "±": float(params[index][0]),
                "cx": float(lens.intrinsics[2]),
                "± cx": float(params[index][of_lens.index("cx")]),
                "cy": float(lens.intrinsics[3]),
                "± cy": float(params[index][of_lens.index("cy")]),
                "± centre": 1e3 * float(centers[index]),
                "± rotation": 1e3 * float(np.sqrt((rotation[index] ** 2).mean())),
            }
        )
    units = {"RMS": "px", "median": "px", "worst used": "px", "left out": "%", "image covered": "%"}
    section.table(errors, "Errors and coverage, worst first", units=units, sort_by="RMS")
    units = dict.fromkeys(("focal length", "±", "cx", "± cx", "cy", "± cy"), "px")
    units |= {"± centre": "mm", "± rotation": "mrad"}
    section.table(lenses, "Lenses, and one standard deviation (±) of each", units=units, sort_by="± centre")


def _residuals(report: Report, calibration: Calibration) -> None:
    section = report.section(
        "Residuals over the image",
        "Noise alone makes short arrows without order. Arrows that agree with their neighbours show a lens that "
        "the model cannot follow, or a board that is not as described.",
    )
    cameras = _camera_residuals(calibration)
    figure, unit = residual_fields(cameras)
    section.plot(
        figure,
        f"Mean error per cell (arrows; one as long as a cell is {unit:g} px) and RMS error (colour).",
        "Vector fields of the mean reprojection error over each camera's image",
        "png",
    )
    section.plot(
        coverage_maps(cameras),
        "Coverage: every corner that was used. A lens is only known where the board has been.",
        "Positions of all used corners in each camera's image",
        "png",
    )


def _frames(report: Report, calibration: Calibration) -> None:
    section = report.section(
        "Frames",
        "Reprojection errors as if the board stood still in each frame, whatever cameras saw it when.",
    )
    seen = calibration.observations
    squared = np.where(calibration.inliers, (calibration.residuals_at_rest**2).sum(axis=-1), 0.0)
    frames, cameras = len(seen.frame_ids), len(seen.camera_ids)
    count = np.bincount(seen.frame, calibration.inliers, frames)
    total = np.bincount(seen.frame, minlength=frames)
    square = np.bincount(seen.frame, squared, frames)
    views = (seen.counts > 0).sum(axis=0)
    rows = [
        {
            "frame": seen.frame_ids[frame],
            "RMS": float(np.sqrt(square[frame] / count[frame])) if count[frame] else None,
            "cameras": int(views[frame]),
            "corners": int(count[frame]),
            "left out": 100 * float(1 - count[frame] / total[frame]),
        }
        for frame in np.flatnonzero(total)
    ]
    rows.sort(key=lambda row: -(row["RMS"] or 0.0))
    listed = rows[:MAX_FRAMES_LISTED]
    caption = f"The {len(listed)} worst of {len(rows)} frames" if len(rows) > len(listed) else "Worst first"
    section.table(listed, caption, units={"RMS": "px", "left out": "%"}, sort_by="RMS")
    place = seen.camera * frames + seen.frame
    by_view = np.bincount(place, squared, cameras * frames)
    of_view = np.bincount(place, calibration.inliers, cameras * frames)
    errors = np.sqrt(np.divide(by_view, of_view, out=np.full(len(by_view), np.nan), where=of_view > 0))
    section.plot(
        error_matrix(errors.reshape(cameras, frames), seen.camera_ids, seen.frame_ids),
        "RMS error of every view. A dark column is a frame whose pictures are not of one instant, a dark row "
        "a camera that moved; grey views do not show the board.",
        "Reprojection error by camera and frame",
        "png",
    )


def _pairs(report: Report, calibration: Calibration) -> None:
    errors = epipolar_errors(calibration)
    if not errors:
        return
    section = report.section(
        "Pairs of cameras",
        "How far a corner in one image lies from the line on which the other image says that it is. Unlike the "
        "reprojection error this does not depend on the board's pose.",
    )
    rows: list[dict[str, Any]] = [
        {
            "cameras": f"{pair.first}, {pair.second}",
            "RMS": pair.rms,
            "median": pair.median,
            "corners": pair.count,
        }
        for pair in errors
    ]
    rows.sort(key=lambda row: -row["RMS"])
    listed = rows[:MAX_FRAMES_LISTED]
    caption = "Epipolar error, worst first"
    if len(rows) > len(listed):
        caption = f"Epipolar error, the {len(listed)} worst of {len(rows)} pairs"
    section.table(listed, caption, units={"RMS": "px", "median": "px"}, sort_by="RMS")


def _selection(report: Report, calibration: Calibration) -> None:
    if not calibration.selection:
        return
    section = report.section("Choice of the model", f"Chosen: {CRITERION}.")
    rows = [
        {
            "camera model": candidate.camera_model,
            "board": "bowed" if candidate.board_warp else "flat",
            "parameters": candidate.parameters,
            "training": candidate.training_rms,
            "held out": candidate.held_out_rms,
            "excess": candidate.excess,
            "± excess": candidate.standard_error,
            "verdict": "chosen" if candidate.chosen else candidate.refused.partition(";")[0] or "possible",
            "held at 0": ", ".join(candidate.held),
        }
        for candidate in calibration.selection
    ]
    units = {"training": "px", "held out": "px", "excess": "px²", "± excess": "px²"}
    section.table(
        rows, "Candidates, simplest first; excess is the mean squared error beyond the best's", units=units
    )


def _rig(report: Report, calibration: Calibration) -> None:
    section = report.section("The rig in space")
    figure = rig_view(
        calibration.observations.camera_ids,
        calibration.cameras,
        calibration.camera_from_rig,
        board_outlines(calibration),
    )
    section.plot(
        figure,
        "Cameras with their fields of view (blue) and the boards (grey), about the middle of the boards.",
        "Positions of cameras and boards",
        "svg",
    )


def _outliers(report: Report, calibration: Calibration, load_image: LoadImage) -> None:
    wrong = int((~calibration.inliers).sum())
    unplaced = int(np.isnan(calibration.residuals).any(axis=1).sum())
    words = f"{wrong} of {len(calibration.inliers)} corners were left out: "
    words += f"{wrong - unplaced} further than four standard deviations from where the rig has them, and "
    words += f"{unplaced} of views in which too little of the board is seen to say where it is."
    section = report.section("Outliers", words if wrong else "No corner was left out.")
    whole = views_left_out(calibration)
    if whole:
        section.text(
            f"In {len(whole)} views nearly all corners were left out together, {', '.join(whole[:MAX_NAMED])}"
            f"{' and others' if len(whole) > MAX_NAMED else ''}: most likely these pictures are not of the same "
            "instant as the other cameras', or the camera was moved."
        )
    sheet = outlier_sheet(calibration, load_image) if wrong else None
    if sheet is not None:
        section.image(
            sheet,
            "The views with the largest errors: corners left out (red) and where the rig has them (yellow), "
            "corners used (green).",
            "Cut-outs of images with outliers marked",
            "jpeg",
        )


def _drift(report: Report, drifts: Sequence[TakeDrift]) -> None:
    section = report.section(
        "Drift between takes",
        "What changed since the neighbouring take, after its rig was laid onto this one. Moves of some three "
        "standard deviations and more are real: calibrate before each take.",
    )
    for drift in drifts:
        rows = [
            {
                "camera": camera.camera,
                "centre": 1e3 * camera.center,
                "± centre": 1e3 * camera.center_deviation,
                "rotation": 1e3 * camera.rotation,
                "focal length": 100 * camera.focal,
                "in the image": camera.pixels,
            }
            for camera in drift.cameras
        ]
        units = {
            "centre": "mm",
            "± centre": "mm",
            "rotation": "mrad",
            "focal length": "%",
            "in the image": "px",
        }
        _drift_table(section, rows, f"Since take '{drift.since}', largest first", units)


def _drift_table(section: Section, rows: list[dict[str, Any]], caption: str, units: dict[str, str]) -> None:
    if rows:
        section.table(rows, caption, units=units, sort_by="in the image")
    else:
        section.text(f"{caption}: no camera is in both takes.")


# ------------------------------------------------------------------------------------------ figures


def _camera_residuals(calibration: Calibration) -> list[CameraResiduals]:
    seen = calibration.observations
    used = [calibration.inliers & (seen.camera == index) for index in range(len(seen.camera_ids))]
    return [
        CameraResiduals(name, seen.image_sizes[index], seen.pixels[mine], calibration.residuals[mine])
        for index, (name, mine) in enumerate(zip(seen.camera_ids, used, strict=True))
    ]


def _root_mean_square(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if known.size else float("nan")
