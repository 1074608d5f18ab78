"""The report of an aligned studio: who is where, how far views agree, and who and what was left out and why."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from preface.align.aligned import AlignedStudio, median, median_keypoints, root_mean_square
from preface.align.figures import agreement_map, histograms, keypoint_clouds
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.landmark_sheet import LoadImage, landmark_sheet, photograph_sheet, worst_first
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.geometry import GeometryError, fit_similarity
from preface.reports import KeyFigure, Report, Section, Target

MAX_TILES = 40  # views on the sheet of landmarks
MAX_FACELESS_TILES = 10
MAX_HISTOGRAM_CAMERAS = 5  # as many as there are colours
# Adults' outer eye corners are about 80 to 100 mm apart; a distance outside by far speaks of wrong units.
USUAL_EYE_DISTANCE = (0.07, 0.115)  # metres
ACCEPTED = 3.0  # per cent of the eye distance, from which on keypoints are left out
VIEWS_WANTED = 10  # on average, of a rig of thirteen


def alignment_report(studio: AlignedStudio, provenance: Mapping[str, Any], load_image: LoadImage) -> Report:
    """Put the report together.

    Args:
        studio: the result.
        provenance: of the alignment; the page ends with it.
        load_image: gives the photographs; None where one is not at hand.
    """
    report = Report("Alignment of a studio", provenance)
    _summary(report, studio)
    _left_out(report, studio)
    _landmarks(report, studio, load_image)
    if studio.template is not None and studio.placements:
        _keypoints(report, studio, studio.template.keypoints)
        _residuals(report, studio)
    _agreement(report, studio)
    if studio.placements:
        _people(report, studio)
    return report


def _summary(report: Report, studio: AlignedStudio) -> None:
    section = report.section("Summary", _template_in_words(studio))
    accepted = _accepted_disagreements(studio)
    errors = np.concatenate([np.empty(0), *(studio.reprojection_errors(*view) for view in studio.landmarks)])
    wanted = Target(at_least=VIEWS_WANTED) if len(studio.cameras) >= VIEWS_WANTED else None
    section.key_figures(
        [
            KeyFigure("People aligned", f"{len(studio.placements)} of {len(studio.subjects)}"),
            KeyFigure("Views used per person, mean", _mean(studio.views_used), "", wanted),
            KeyFigure("Reprojection of landmarks, median", median(errors), "px"),
            KeyFigure(
                "Worst keypoint used of a view",
                float(np.max(accepted)) if accepted.size else None,
                "% of the eye distance",
            ),
        ]
    )
    section.key_figures(
        [
            KeyFigure("Spread of keypoints before, RMS", 1e3 * root_mean_square(studio.spread_before), "mm"),
            KeyFigure("Spread of keypoints after, RMS", 1e3 * root_mean_square(studio.spread_after), "mm"),
            KeyFigure("Outer eye corners apart, median", 1e3 * median(studio.eye_distances), "mm"),
            KeyFigure("Scale, median", median(studio.scales)),
        ]
    )
    if accepted.size and np.max(accepted) > ACCEPTED:
        section.text(
            f"Keypoints more than {ACCEPTED:g}% off the other views are left out, and then those that other views show "
            "better; what remains is measured against what remains, which is why one that is used may be further off."
        )
    eyes = median(studio.eye_distances)
    if np.isfinite(eyes) and not USUAL_EYE_DISTANCE[0] <= eyes <= USUAL_EYE_DISTANCE[1]:
        section.text(
            f"The outer eye corners are {1e3 * eyes:.1f} mm apart in the rig, and adults' are about 80 to 100 mm "
            "apart: the rig's unit is most likely not the metre. Measure the board's square and calibrate again, "
            "or read lengths here as relative ones."
        )


def _template_in_words(studio: AlignedStudio) -> str:
    template = studio.template
    if template is None:
        return "Nobody could be aligned: there is no template."
    names = template.identities
    people = f"{len(names)} {'person' if len(names) == 1 else 'people'}"
    if studio.joined:
        return f"The people were placed on a given template, the median of {people}."
    together = " after they were brought together (generalised Procrustes)" if template.procrustes else ""
    return (
        f"The template is the per-coordinate median of the five keypoints of {people}{together}, the first ones of "
        "the manifest that can be used; the paper takes the first 260."
    )


def _left_out(report: Report, studio: AlignedStudio) -> None:
    section = report.section("Left out")
    if studio.excluded:
        rows = [{"person": name, "reason": reason} for name, reason in studio.excluded.items()]
        section.table(rows, f"{len(rows)} of {len(studio.subjects)} people are not aligned")
    else:
        section.text("Nobody: all people are aligned.")
    _views_left_out(section, studio)
    _keypoints_left_out(section, studio)


def _views_left_out(section: Section, studio: AlignedStudio) -> None:
    views = [view for view in studio.landmarks if not studio.used(*view)]
    if not views:
        section.text("No view was left out.")
        return
    counts: dict[tuple[str, str], int] = {}
    for identity, camera in views:
        key = camera, _code(studio, identity, camera)
        counts[key] = counts.get(key, 0) + 1
    total = {camera: sum(of == camera for _, of in studio.landmarks) for camera in studio.cameras}
    section.table(
        [{"camera": c, "why": code, "views": n, "of": total[c]} for (c, code), n in sorted(counts.items())],
        f"{len(views)} of {len(studio.landmarks)} views are not used, by camera",
        sort_by="views",
    )
    section.table(
        [{"person": i, "camera": c, "reason": studio.why_not(i, c)} for i, c in views], "Each of them"
    )


def _keypoints_left_out(section: Section, studio: AlignedStudio) -> None:
    """Detectors slide along chin and nose as the head turns: such keypoints of a view that is used are left out."""
    counts = {camera: dict.fromkeys(CANONICAL_KEYPOINTS, 0) for camera in studio.cameras}
    for identity, camera in studio.landmarks:
        for name in studio.keypoints_left_out(identity, camera):
            counts[camera][name] += 1
    rows = [
        {"camera": camera, **{name.replace("_", " "): n for name, n in of_camera.items()}}
        for camera, of_camera in counts.items()
        if any(of_camera.values())
    ]
    if rows:
        section.table(
            rows, "Views that are used but for a keypoint that the others have elsewhere, by camera"
        )
    else:
        section.text("Every view that is used contributes all of its keypoints.")


def _landmarks(report: Report, studio: AlignedStudio, load_image: LoadImage) -> None:
    section = report.section(
        "Landmarks, worst first",
        "First the views that were left out, then those used, by how far their worst keypoint is from where the "
        "other views put it (per cent of the eye distance). Dots are landmarks: green used, red not. Blue circles "
        "are the five keypoints as this view has them, yellow circles the projections of the 3D keypoints; where "
        "all is well, they share their centres.",
    )
    views = worst_first(studio)
    if views:
        shown = views[:MAX_TILES]
        section.image(
            landmark_sheet(studio, shown, load_image),
            f"{len(shown)} of {len(views)} views with landmarks. Click to enlarge.",
            f"Faces of {len(shown)} views with landmarks and keypoints drawn over them",
            "jpeg",
        )
    warnings = [
        {"person": identity, "camera": camera, "warning": words}
        for (identity, camera), found in studio.landmarks.items()
        if isinstance(found, ViewLandmarks)
        for words in found.warnings
    ]
    if warnings:
        section.table(warnings, "What the detector remarks")
    faceless = [view for view, found in studio.landmarks.items() if isinstance(found, NoFace)]
    faceless = [view for view in faceless if load_image(*view) is not None][:MAX_FACELESS_TILES]
    if faceless:
        section.image(
            photograph_sheet(faceless, load_image),
            f"{len(faceless)} of the views without landmarks.",
            "Photographs in which no face was found",
            "jpeg",
        )


def _keypoints(report: Report, studio: AlignedStudio, template: np.ndarray) -> None:
    section = report.section("Keypoints about the template")
    before = studio.rig_keypoints - np.nanmean(studio.rig_keypoints.reshape(-1, 3), axis=0)
    rows = {"before": _facing(before, template), "after": studio.canonical_keypoints}
    section.plot(
        keypoint_clouds(rows, template),
        "The five keypoints of every person, before (as the rigs have them, moved and turned as one) and after "
        "each person's similarity, with the template.",
        "Keypoints of all people from the front, the left and above",
        "svg" if len(studio.placements) <= 100 else "png",
    )
    table = [
        {"keypoint": name, "before": 1e3 * float(b), "after": 1e3 * float(a), "deviation": 1e3 * float(d)}
        for name, b, a, d in zip(
            CANONICAL_KEYPOINTS, studio.spread_before, studio.spread_after, _deviations(studio), strict=True
        )
    ]
    units = dict.fromkeys(("before", "after", "deviation"), "mm")
    section.table(
        table,
        "Spread: root mean square distance from the median (before) and the template (after); and one predicted "
        "standard deviation of a keypoint's own position, all axes together, median over people",
        units=units,
    )


def _facing(points: np.ndarray, template: np.ndarray) -> np.ndarray:
    """Keypoints of the rigs' frames [S, 5, 3], all moved and turned alike, so that their median faces forward."""
    try:
        fit = fit_similarity(median_keypoints(points), template, fixed_scale=1.0)
    except GeometryError:  # fewer than three keypoints are known
        return points
    moved = np.full(points.shape, np.nan)
    known = np.isfinite(points).all(axis=-1)
    moved[known] = fit.target_from_source.apply(points[known])
    return moved


def _deviations(studio: AlignedStudio) -> np.ndarray:
    """Median standard deviation [5] of the keypoints, rig units, square root of the covariance's trace."""
    found = [studio.subjects[identity].keypoints.covariance for identity in studio.placements]
    traces = np.trace(np.array(found), axis1=-2, axis2=-1)
    return np.array([median(np.sqrt(column)) for column in traces.T])


def _residuals(report: Report, studio: AlignedStudio) -> None:
    section = report.section("Residuals")
    errors: dict[str, list[np.ndarray]] = {camera: [] for camera in studio.cameras}
    for identity, camera in studio.landmarks:
        errors[camera].append(studio.reprojection_errors(identity, camera))
    of_camera = {camera: np.concatenate(parts) for camera, parts in errors.items() if parts}
    if len(of_camera) > MAX_HISTOGRAM_CAMERAS:
        of_camera = {"all cameras": np.concatenate(list(of_camera.values()))}
    residuals = np.array([place.residuals for place in studio.placements.values()])
    of_keypoint = {
        name.replace("_", " "): 1e3 * column
        for name, column in zip(CANONICAL_KEYPOINTS, residuals.T, strict=True)
    }
    used = {"used views": _accepted_disagreements(studio)}
    section.plot(
        histograms(
            [
                ("Reprojection of landmarks", "distance (px)", of_camera),
                ("Worst keypoint used of each view", "% of the eye distance", used),
                ("Keypoints to the template", "distance (mm)", of_keypoint),
            ]
        ),
        "Distances between landmarks and the projections of their 3D points; how far each view that was used is "
        "from the others; and how far people's keypoints are from the template after alignment: faces differ.",
        "Three histograms of residuals",
        "svg",
    )


def _agreement(report: Report, studio: AlignedStudio) -> None:
    section = report.section("Agreement of views")
    rows = []
    for camera in studio.cameras:
        people = [identity for identity, of in studio.landmarks if of == camera]
        used = [identity for identity in people if studio.used(identity, camera)]
        disagreements = np.array([studio.accepted_disagreement(identity, camera) for identity in used])
        known = disagreements[~np.isnan(disagreements)]
        errors = np.concatenate([np.empty(0), *(studio.reprojection_errors(i, camera) for i in used)])
        rows.append(
            {
                "camera": camera,
                "used": len(used),
                "of": len(people),
                "median": median(known),
                "worst": float(known.max()) if known.size else None,
                "reprojection": median(errors),
            }
        )
    units = {"median": "%", "worst": "%", "reprojection": "px"}
    section.table(
        rows,
        "Per camera: views used; the worst keypoint that each contributes against the other views, per cent of the "
        "eye distance; and the median reprojection error of landmarks",
        units=units,
    )
    identities = list(studio.subjects)
    disagreement = np.array(
        [[studio.accepted_disagreement(i, c) for c in studio.cameras] for i in identities]
    )
    section.plot(
        agreement_map(identities, studio.cameras, disagreement, _states(studio, identities), ACCEPTED),
        "Every view of every person.",
        "Map of the views that were used and how far they agree",
        "png",
    )


def _states(studio: AlignedStudio, identities: list[str]) -> np.ndarray:
    """[identities, cameras]: 1 used, 0 left out, -1 without landmarks."""

    def state(identity: str, camera: str) -> int:
        if studio.used(identity, camera):
            return 1
        return 0 if isinstance(studio.landmarks.get((identity, camera)), ViewLandmarks) else -1

    return np.array([[state(identity, camera) for camera in studio.cameras] for identity in identities])


def _people(report: Report, studio: AlignedStudio) -> None:
    section: Section = report.section("People")
    rows = []
    for index, (identity, place) in enumerate(studio.placements.items()):
        keypoints = studio.subjects[identity].keypoints
        rows.append(
            {
                "person": identity,
                "views": int(studio.views_used[index]),
                "keypoints": int(np.isfinite(keypoints.positions).all(axis=-1).sum()),
                "± keypoint": 1e3
                * root_mean_square(np.sqrt(np.trace(keypoints.covariance, axis1=-2, axis2=-1))),
                "eyes apart": 1e3 * float(studio.eye_distances[index]),
                "scale": float(studio.scales[index]),
                "from the template": 1e3 * root_mean_square(place.residuals),
                "remarks": " ".join(flag.text for flag in place.flags),
            }
        )
    units = {"± keypoint": "mm", "eyes apart": "mm", "from the template": "mm"}
    section.table(rows, "Furthest from the template first", units=units, sort_by="from the template")


def _code(studio: AlignedStudio, identity: str, camera: str) -> str:
    verdict = studio.subjects[identity].views.get(camera)
    return "not judged" if verdict is None else verdict.code.replace("_", " ")


def _accepted_disagreements(studio: AlignedStudio) -> np.ndarray:
    """The worst keypoint that each view contributes, per cent of the eye distance; unchecked ones are left away."""
    found = np.array([studio.accepted_disagreement(*view) for view in studio.landmarks])
    return found[~np.isnan(found)]


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if values.size else None
