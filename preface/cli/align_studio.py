"""``preface-align studio``: landmarks in every view, a face per person, a template, and a place for everybody."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from preface.align.aligned import AlignedStudio, median, root_mean_square
from preface.align.alignment_files import (
    TEMPLATE_FILE,
    AlignedEntry,
    AlignmentIndex,
    ExcludedEntry,
    alignment_file,
    read_template,
    write_index,
    write_template,
)
from preface.align.errors import AlignmentError
from preface.align.landmark_bias import LandmarkBias
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.align.options import AlignmentOptions
from preface.align.person_file import Alignment, write_alignment
from preface.align.placement import Placement, place_subject
from preface.align.report import alignment_report
from preface.align.subject import align_subject
from preface.align.template import Template, build_template, require_same_scheme
from preface.artifacts import ArtifactError, provenance
from preface.capture.images import displayable, read_image
from preface.capture.manifest import FILE_NAME, Capture, Subject, read_capture
from preface.capture.rig import Rig
from preface.cli.align_folder import forget
from preface.cli.align_inputs import (
    TakeRig,
    chosen_subjects,
    rigs_of_takes,
    template_file,
    usable_photographs,
)
from preface.cli.align_landmarks import Landmarks, landmarks_of
from preface.cli.folders import make_folder, require_writable
from preface.cli.output import say
from preface.cli.usage import UsageError

MAX_NAMED = 8  # people in a note
REPORT_FILE = "report.html"


def run(config: argparse.Namespace) -> list[str]:
    """Find landmarks, align, write the report and then the alignment; returns the lines to print."""
    options = _options(config)
    capture = read_capture(config.source)
    subjects = chosen_subjects(capture, config.only)
    for subject in subjects:
        alignment_file(subject.id)  # refuses names that files of an alignment have
    rigs, notes = rigs_of_takes(config.rig, list(dict.fromkeys(subject.take for subject in subjects)))
    given = read_template(config.template) if config.template else None
    photographs, unusable = usable_photographs(capture, subjects, rigs)
    _require_metric(rigs, config)
    require_writable(config.output)
    landmarks = landmarks_of(config, photographs)
    found = {
        (subject.id, camera.id): landmarks.found[subject.id, camera.id]
        if (subject.id, camera.id) in photographs
        else NoFace(unusable[subject.id, camera.id])
        for subject in subjects
        for camera in capture.manifest.cameras
    }
    cameras = {take: entry.rig for take, entry in rigs.items()}
    studio = align_people(subjects, cameras, found, given, options, landmarks.bias)
    for note in (*notes, *_notes(studio, options)):
        say(f"note: {note}")
    return _write(config, studio, subjects, capture, _history(config, capture, rigs, landmarks), landmarks)


def _options(config: argparse.Namespace) -> AlignmentOptions:
    if config.template and (config.procrustes or config.identities):
        flag = "--procrustes" if config.procrustes else "--identities"
        raise UsageError(
            f"{flag} says how a template is made, but --template gives one: leave one of them out"
        )
    chosen: dict[str, Any] = {"procrustes": config.procrustes, "scale": config.scale}
    if config.identities:
        chosen["template_identities"] = config.identities
    return AlignmentOptions(**chosen)


def _require_metric(rigs: Mapping[str, TakeRig], config: argparse.Namespace) -> None:
    """Refuse a rig of arbitrary scale where its lengths would count as metres."""
    for entry in rigs.values():
        if entry.rig.scale == "metric" or (config.template and config.scale == "free"):
            continue
        if config.template:
            problem, remedy = "arbitrary, and --scale fixed would keep it", "Leave --scale fixed away"
        else:
            problem = "arbitrary, so that no template can be made with this rig"
            remedy = "Give --template, or calibrate with a known distance"
        raise ArtifactError(entry.path, "scale", problem, remedy)


# --------------------------------------------------------------------------------------- alignment


def align_people(
    subjects: Sequence[Subject],
    rigs: Mapping[str, Rig],
    found: Mapping[tuple[str, str], ViewLandmarks | NoFace],
    given: Template | None,
    options: AlignmentOptions,
    bias: LandmarkBias | None = None,
) -> AlignedStudio:
    """Triangulate everybody, make the template unless one is given, and place everybody on it.

    Args:
        subjects: in the manifest's order.
        rigs: take to its rig.
        found: (identity, camera) to what is in the view.
        given: an existing template.
        options: see `AlignmentOptions`.
        bias: of the detector that found the landmarks; None leaves them as they are.

    Raises:
        AlignmentError: landmarks of another scheme than the given template's.
    """
    faces = {
        subject.id: align_subject(_views_of(subject.id, found), rigs[subject.take], options, bias)
        for subject in subjects
    }
    takes = {subject.id: rigs[subject.take] for subject in subjects}
    usable = {identity: face for identity, face in faces.items() if face.excluded is None}
    excluded = {identity: face.excluded for identity, face in faces.items() if face.excluded is not None}
    schemes = list(dict.fromkeys(face.scheme for face in usable.values()))
    template = given
    if template is None and usable:
        keypoints = {identity: face.keypoints for identity, face in usable.items()}
        template = build_template(keypoints, schemes[0], options.template_identities, options.procrustes)
    placements: dict[str, Placement] = {}
    if template is not None:
        require_same_scheme(template, schemes)
        for identity, face in usable.items():
            try:
                metric = takes[identity].scale == "metric"
                placements[identity] = place_subject(face.keypoints, template, options, metric)
            except AlignmentError as error:
                excluded[identity] = str(error)
    return AlignedStudio(
        landmarks=found,
        rigs=takes,
        subjects=faces,
        template=template,
        joined=given is not None,
        placements=placements,
        excluded={subject.id: excluded[subject.id] for subject in subjects if subject.id in excluded},
    )


def _views_of(
    identity: str, found: Mapping[tuple[str, str], ViewLandmarks | NoFace]
) -> dict[str, ViewLandmarks | NoFace]:
    return {camera: view for (of, camera), view in found.items() if of == identity}


def _notes(studio: AlignedStudio, options: AlignmentOptions) -> list[str]:
    """What a user should know without opening the report."""
    notes = [f"'{identity}' is excluded: {reason}" for identity, reason in studio.excluded.items()]
    if len(notes) > MAX_NAMED:
        notes = [*notes[:MAX_NAMED], f"... and {len(notes) - MAX_NAMED} more people are excluded"]
    template = studio.template
    if template is not None and not studio.joined and len(template.identities) < options.template_identities:
        notes.append(
            f"the template is the median of {len(template.identities)} people; the paper takes "
            f"{options.template_identities}"
        )
    flags = [
        f"'{identity}': {flag.text}" for identity, place in studio.placements.items() for flag in place.flags
    ]
    notes += flags[:MAX_NAMED]
    if len(flags) > MAX_NAMED:
        notes.append(f"... and {len(flags) - MAX_NAMED} more remarks, all in the report")
    return notes


# ----------------------------------------------------------------------------------------- writing


def _history(
    config: argparse.Namespace, capture: Capture, rigs: Mapping[str, TakeRig], landmarks: Landmarks
) -> dict[str, Any]:
    """The provenance of the whole; photographs are named in the people's own."""
    settings = {
        "command": "studio",
        "only": config.only or [],
        "procrustes": config.procrustes,
        "scale": config.scale,
        "identities": config.identities,
        "template": None if config.template is None else "given",
        **landmarks.config,
    }
    inputs = {f"rigs/{take}.json": entry.path for take, entry in rigs.items()}
    if not capture.inferred:
        inputs[FILE_NAME] = capture.directory / FILE_NAME
    if config.template is not None:
        inputs["given template"] = template_file(config.template)
    return provenance(settings, inputs)


def _write(
    config: argparse.Namespace,
    studio: AlignedStudio,
    subjects: Sequence[Subject],
    capture: Capture,
    history: Mapping[str, Any],
    landmarks: Landmarks,
) -> list[str]:
    """Write everything, the index last; a folder without one is not complete."""

    def load_image(identity: str, camera: str) -> np.ndarray | None:
        file = capture.images.get((identity, camera))
        try:
            return None if file is None else displayable(read_image(file))
        except ArtifactError:  # the view's reason says so
            return None

    folder = make_folder(config.output)
    report = alignment_report(studio, history, load_image).write(folder / REPORT_FILE)
    if studio.template is None or not studio.placements:
        problem = f"not one of {len(subjects)} people can be aligned"
        raise ArtifactError(config.source, "subjects", problem, f"See {report} for the reasons")
    forget(folder)
    write_template(
        folder / TEMPLATE_FILE, replace(studio.template, provenance=studio.template.provenance or history)
    )
    takes = {subject.id: subject.take for subject in subjects}
    aligned = []
    for identity, place in studio.placements.items():
        face = studio.subjects[identity]
        of_person = [inputs for view, inputs in landmarks.inputs.items() if view[0] == identity]
        inputs = dict(history["inputs"]) | {
            name: digest for entry in of_person for name, digest in entry.items()
        }
        person = Alignment(
            identity, takes[identity], face, place, _views_of(identity, studio.landmarks),
            {**history, "inputs": inputs},
        )  # fmt: skip
        write_alignment(folder / alignment_file(identity), person)
        aligned.append(AlignedEntry.of(identity, takes[identity], face, place))
    excluded = tuple(ExcludedEntry(name, takes[name], reason) for name, reason in studio.excluded.items())
    index = AlignmentIndex(studio.template.scheme, tuple(aligned), excluded, (), history)
    return [*_summary(studio), f"report: {report}", str(write_index(folder, index))]


def _summary(studio: AlignedStudio) -> list[str]:
    used = sum(studio.used(*view) for view in studio.landmarks)
    errors = np.concatenate([studio.reprojection_errors(*view) for view in studio.landmarks])
    before, after = root_mean_square(studio.spread_before), root_mean_square(studio.spread_after)
    return [
        f"{len(studio.placements)} of {len(studio.subjects)} people aligned, {used} of {len(studio.landmarks)} views "
        f"used, {studio.views_used.mean():.1f} per person",
        f"landmarks reproject to {median(errors):.2f} px (median); outer eye corners "
        f"{1e3 * median(studio.eye_distances):.1f} mm apart, scale {median(studio.scales):.3f} (medians)",
        f"keypoints about the template: {1e3 * before:.2f} mm before, {1e3 * after:.2f} mm after (RMS)",
    ]
