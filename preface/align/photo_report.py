"""The report of a few photographs of one person: the cameras, the face, and how far each choice is trusted."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from preface.align.aligned import AlignedStudio, median
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.landmark_sheet import LoadImage, landmark_sheet, photograph_sheet
from preface.align.landmarks import NoFace
from preface.align.photos import PhotoAlignment
from preface.capture.calibration_figures import rig_view
from preface.geometry import Rigid
from preface.reports import KeyFigure, Report

MAX_TILES = 40


def photo_report(
    identity: str,
    found: PhotoAlignment,
    studio: AlignedStudio,
    provenance: Mapping[str, Any],
    load_image: LoadImage,
) -> Report:
    """Put the report together.

    Args:
        identity: the person.
        found: cameras and face.
        studio: the same as an alignment of one person, photographs in place of cameras.
        provenance: of the alignment; the page ends with it.
        load_image: gives the photographs.
    """
    report = Report(f"Alignment of {identity}, {len(found.views)} photographs", provenance)
    _summary(report, found, studio)
    _trust(report, found)
    _overlay(report, studio, load_image)
    _cameras(report, found)
    return report


def _summary(report: Report, found: PhotoAlignment, studio: AlignedStudio) -> None:
    section = report.section("Summary", "\n\n".join(found.warnings))
    lenses = [entry.camera for entry in found.rig.cameras.values()]
    section.key_figures(
        [
            KeyFigure("Photographs used", f"{len(found.views)} of {len(studio.landmarks)}"),
            KeyFigure("Reprojection of landmarks, median", median(found.residuals[found.inliers]), "px"),
            KeyFigure("Landmarks that agree", 100 * float(found.inliers.mean()), "%"),
            KeyFigure("Focal length", float(lenses[0].intrinsics[0]), "px"),
            KeyFigure("Outer eye corners apart", 1e3 * median(studio.eye_distances), "mm"),
        ]
    )
    if found.excluded:
        rows = [{"photograph": name, "reason": reason} for name, reason in found.excluded.items()]
        section.table(rows, "Photographs that are not used")
    for identity, place in studio.placements.items():
        for flag in place.flags:
            section.text(f"{identity}: {flag.text}")


def _trust(report: Report, found: PhotoAlignment) -> None:
    section = report.section(
        "How far each choice is trusted", "\n\n".join(statement.text for statement in found.trust)
    )
    section.table(
        [
            {
                "what": statement.what,
                "value": statement.value,
                "±": statement.deviation,
                "unit": statement.unit,
                "rests on": statement.rests_on,
            }
            for statement in found.trust
        ],
        "The same in numbers; ± is one standard deviation",
    )
    deviations = np.sqrt(np.einsum("kii->ki", found.keypoint_covariance))
    section.table(
        [
            {
                "keypoint": name,
                **{axis: 1e3 * float(v) for axis, v in zip("xyz", point, strict=True)},
                **{f"± {axis}": 1e3 * float(v) for axis, v in zip("xyz", spread, strict=True)},
                "from the photographs": 100 * float(share),
            }
            for name, point, spread, share in zip(
                CANONICAL_KEYPOINTS, found.keypoints, deviations, found.from_photographs, strict=True
            )
        ],
        "The five keypoints in the cameras' frame; the last column is the share of what is unknown about faces "
        "that the photographs took away",
        units={
            **dict.fromkeys(("x", "y", "z", "± x", "± y", "± z"), "mm"),
            "from the photographs": "%",
        },
    )


def _overlay(report: Report, studio: AlignedStudio, load_image: LoadImage) -> None:
    section = report.section(
        "Landmarks",
        "Dots are landmarks: green agree with the face, red do not. Blue circles are the five keypoints as the "
        "detector has them, yellow circles the projections of the 3D keypoints.",
    )
    faces = [view for view, found in studio.landmarks.items() if not isinstance(found, NoFace)]
    section.image(
        landmark_sheet(studio, faces[:MAX_TILES], load_image),
        f"{len(faces[:MAX_TILES])} of {len(faces)} photographs with a face. Click to enlarge.",
        "Faces with landmarks and keypoints drawn over them",
        "jpeg",
    )
    faceless = [view for view, found in studio.landmarks.items() if isinstance(found, NoFace)]
    faceless = [view for view in faceless if load_image(*view) is not None][:MAX_TILES]
    if faceless:
        section.image(
            photograph_sheet(faceless, load_image),
            f"{len(faceless)} photographs without landmarks.",
            "Photographs in which no face was found",
            "jpeg",
        )


def _cameras(report: Report, found: PhotoAlignment) -> None:
    section = report.section("Cameras")
    poses = [entry.camera_from_rig for entry in found.rig.cameras.values()]
    together = Rigid(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
    eyes, chin = found.keypoints[:2], found.keypoints[-1]
    outline = np.array([[eyes[0], eyes[1], chin + (eyes[1] - eyes[0]) / 4, chin - (eyes[1] - eyes[0]) / 4]])
    if np.isfinite(outline).all():
        lenses = [entry.camera for entry in found.rig.cameras.values()]
        section.plot(
            rig_view(list(found.rig.cameras), lenses, together, outline),
            "Where the photographs were taken from; grey: from the eyes to the chin.",
            "Positions of the cameras about the face",
            "svg",
        )
    rows = []
    for index, (name, entry) in enumerate(found.rig.cameras.items()):
        errors = found.residuals[index][found.inliers[index]]
        rows.append(
            {
                "photograph": name,
                "distance": float(
                    np.linalg.norm(entry.camera_from_rig.inverse.translation - found.keypoints.mean(0))
                ),
                "landmarks": len(errors),
                "reprojection": median(errors),
                "focal length": float(entry.camera.intrinsics[0]),
            }
        )
    units = {"distance": "m", "reprojection": "px", "focal length": "px"}
    section.table(rows, "Photographs, worst first", units=units, sort_by="reprojection")
