"""The report of calibrated photographs: which were placed, which lens they have, and why that one."""

import numpy as np

from preface.capture.calibration_figures import (
    CameraResiduals,
    coverage_maps,
    photographs_in_space,
    residual_fields,
)
from preface.capture.photos import PhotoCalibration
from preface.geometry import lens
from preface.geometry.cameras import stack_intrinsics
from preface.reports import KeyFigure, Report

MAX_LISTED = 40  # photographs
OUTLYING = 95  # percentile of the points' distances from their middle; further ones would shrink the others
MAX_ERROR = 4.0  # pixels; sightings further off are mismatches, and would hide the field of the others


def photo_report(found: PhotoCalibration) -> Report:
    """Put the report together; the page ends with the rig's provenance."""
    report = Report(f"Calibration of {len(found.rig.cameras)} photographs", found.rig.provenance or {})
    _summary(report, found)
    _models(report, found)
    _photographs(report, found)
    _residuals(report, found)
    return report


def _summary(report: Report, found: PhotoCalibration) -> None:
    section = report.section("Summary", "\n\n".join(map(_sentence, found.warnings)))
    chosen, count = found.candidates[found.chosen], len(found.rig.cameras)
    section.key_figures(
        [
            KeyFigure("Photographs registered", f"{count} of {count + len(found.missing)}"),
            KeyFigure("Reprojection error, RMS", chosen.training_error, "px"),
            KeyFigure("Held-out error, RMS", chosen.held_out_error, "px"),
            KeyFigure("Camera model", chosen.model),
            KeyFigure("Points", len(np.unique(found.tracks.point))),
        ]
    )
    section.text(f"Scale: {found.scale}.")


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


def _models(report: Report, found: PhotoCalibration) -> None:
    section = report.section(
        "Choice of the camera model",
        "Chosen: the simplest plausible candidate whose error on sightings that were held out is within one "
        "standard error of the best plausible one's.",
    )
    rows = [
        {
            "model": candidate.model,
            "principal point": "free" if candidate.refine.principal_point else "centre",
            "free parameters": candidate.free_parameters,
            "training": candidate.training_error,
            "held out": candidate.held_out_error,
            "verdict": "chosen" if index == found.chosen else "; ".join(candidate.objections) or "possible",
        }
        for index, candidate in enumerate(found.candidates)
    ]
    section.table(rows, "Candidates, from simple to complex", units={"training": "px", "held out": "px"})
    chosen = found.candidates[found.chosen].summary()
    params, deviations = chosen["params"], chosen["standard_deviations"]
    assert isinstance(params, dict)
    assert isinstance(deviations, dict)
    lens_rows = [
        {"parameter": name, "value": value, "standard deviation": deviations[name]}
        for name, value in params.items()
    ]
    section.table(lens_rows, "The chosen lens (of the first camera, where there are several)")


def _photographs(report: Report, found: PhotoCalibration) -> None:
    section = report.section("Photographs")
    rows = [
        {
            "photograph": name,
            "RMS": camera.reprojection_error.rms if camera.reprojection_error else None,
            "median": camera.reprojection_error.median if camera.reprojection_error else None,
            "points": camera.reprojection_error.count if camera.reprojection_error else 0,
        }
        for name, camera in found.rig.cameras.items()
    ]
    rows = sorted(rows, key=lambda row: -float(row["RMS"] or 0))[:MAX_LISTED]
    section.table(rows, "Registered, worst first", units={"RMS": "px", "median": "px"}, sort_by="RMS")
    if found.missing:
        missing = [{"photograph": name, "why": why} for name, why in found.missing.items()]
        section.table(missing, "Not registered")
    structure = found.structure
    points = structure.points[np.unique(found.tracks.point)]
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    cameras = [structure.cameras[index] for index in found.tracks.camera_of_image]
    section.plot(
        photographs_in_space(
            list(found.rig.cameras),
            cameras,
            structure.camera_from_world,
            points[distance <= np.percentile(distance, OUTLYING)],
            "arbitrary unit" if found.scale.startswith("arbitrary") else "m",
        ),
        f"Where the photographs were taken from; grey: the nearest {OUTLYING}% of the points. Names that would "
        "cover others are left out.",
        "Positions of the cameras",
        "png",
    )


def _residuals(report: Report, found: PhotoCalibration) -> None:
    section = report.section(
        "Residuals over the image",
        "Of all photographs of a camera together. Arrows that agree with their neighbours show a lens that the "
        "model cannot follow.",
    )
    tracks, structure = found.tracks, found.structure
    intrinsics, radii = stack_intrinsics(structure.cameras)
    camera = tracks.camera_of_image[tracks.image]
    projected, seen = lens.project(intrinsics[camera], radii[camera], structure.in_cameras(tracks))
    residuals = projected - tracks.pixels
    good = seen & (np.linalg.norm(np.where(seen[:, None], residuals, np.inf), axis=1) <= MAX_ERROR)
    fields = [
        CameraResiduals(
            f"camera {index + 1}",
            (entry.width, entry.height),
            tracks.pixels[good & (camera == index)],
            residuals[good & (camera == index)],
        )
        for index, entry in enumerate(structure.cameras[:20])
        if (good & (camera == index)).any()
    ]
    figure, unit = residual_fields(fields)
    section.plot(
        figure,
        f"Mean error per cell (arrows; one as long as a cell is {unit:g} px) and RMS error (colour).",
        "Vector field of the mean reprojection error over the image",
        "png",
    )
    section.plot(
        coverage_maps(fields),
        "Coverage: every sighting that was used.",
        "Positions of all sightings in the image",
        "png",
    )
