"""``preface-align photos``: one to seven photographs of a still person become cameras, a face and its place."""

import argparse
import re
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.aligned import AlignedStudio, median
from preface.align.alignment_files import (
    TEMPLATE_FILE,
    AlignedEntry,
    AlignmentIndex,
    alignment_file,
    read_template,
    write_index,
    write_template,
)
from preface.align.keypoints3d import Keypoints
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.align.options import AlignmentOptions
from preface.align.person_file import Alignment, write_alignment
from preface.align.photo_report import photo_report
from preface.align.photos import PhotoAlignment, PhotoOptions, PhotoView, align_photos
from preface.align.placement import place_subject
from preface.align.subject import SubjectAlignment
from preface.align.template import build_template, require_same_scheme
from preface.align.triangulation import Reason, Triangulation
from preface.align.view_check import ViewVerdict
from preface.artifacts import ArtifactError, provenance
from preface.capture.images import IMAGE_SUFFIXES, displayable
from preface.capture.photos.files import Photograph, find_photographs
from preface.capture.rig import read_rig, write_rig
from preface.capture.upright import read_upright, read_upright_header
from preface.cli.align_folder import forget
from preface.cli.align_inputs import template_file
from preface.cli.align_landmarks import UPRIGHT, Landmarks, landmarks_of
from preface.cli.folders import make_folder, require_writable
from preface.cli.output import known_distance, say
from preface.cli.rig_files import RIG_FILE, one_rig_file
from preface.cli.usage import UsageError
from preface.plain_words import suggestion

REPORT_FILE = "report.html"
SCHEME = "facemesh478"


def run(config: argparse.Namespace) -> list[str]:
    """Find landmarks, cameras and face, write the report, the rig and then the alignment."""
    identity = _identity(config)
    photographs = _photographs(config)
    cameras = read_rig(one_rig_file(config.cameras)) if config.cameras else None
    given = read_template(config.template) if config.template else None
    if given is not None:
        require_same_scheme(given, [SCHEME])
    if config.metric_cameras and cameras is None:
        raise UsageError("--metric-cameras speaks of the cameras that --cameras gives, and there are none")
    known = known_distance(config.known_distance)
    require_writable(config.output)
    files = {(identity, photo.id): photo.path for photo in photographs}
    landmarks = landmarks_of(config, files, UPRIGHT)
    views = [
        PhotoView(photo.id, entry, photo.width, photo.height, photo.exif_focal)
        for photo in photographs
        if isinstance(entry := landmarks.found[identity, photo.id], ViewLandmarks)
    ]
    if not views:
        problem = f"none of {len(photographs)} photographs shows a face: {_reasons(landmarks)}"
        raise ArtifactError(
            config.source, "photographs", problem, "Give photographs of a face from the front"
        )
    options = PhotoOptions(known_distance=known, metric_cameras=config.metric_cameras, bias=landmarks.bias)
    began = time.perf_counter()
    found = align_photos(views, cameras, options)
    say(f"aligned in {time.perf_counter() - began:.1f} s")
    for warning in found.warnings:
        say(f"note: {warning}")
    subject = as_subject(found, landmarks.found)
    template = given or build_template({identity: subject.keypoints}, SCHEME, 1, procrustes=False)
    place = place_subject(subject.keypoints, template, AlignmentOptions(scale=config.scale))
    studio = AlignedStudio(
        landmarks=landmarks.found,
        rigs={identity: found.rig},
        subjects={identity: subject},
        template=template,
        joined=given is not None,
        placements={identity: place},
        excluded={},
    )
    return _write(config, identity, found, studio, _history(config, landmarks), photographs)


def _reasons(landmarks: Landmarks) -> str:
    reasons = {view[1]: entry.reason for view, entry in landmarks.found.items() if isinstance(entry, NoFace)}
    return "; ".join(f"{name}: {reason}" for name, reason in reasons.items())


# ----------------------------------------------------------------------------------- what is asked


def _identity(config: argparse.Namespace) -> str:
    name = config.identity or re.sub(r"[^A-Za-z0-9._-]", "_", config.source.resolve().name)
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        raise UsageError(
            f"'{name}' cannot be the name of a person: give --identity, of letters, digits, '.', '_' and '-', "
            "a letter or digit first"
        )
    alignment_file(name)  # refuses names that files of an alignment have
    return name


def _photographs(config: argparse.Namespace) -> list[Photograph]:
    """The photographs of the folder, or those that --only names."""
    if not config.source.is_dir():
        problem = "is not a folder" if config.source.exists() else "there is no such folder"
        raise ArtifactError(
            config.source, "photographs", problem, "Give the folder that holds the photographs"
        )
    files = sorted(f for f in config.source.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file())
    stems = [file.stem for file in files]
    for name in config.only or ():
        if name not in stems:
            problem = f"there is no photograph '{name}'"
            raise ArtifactError(config.source, "photographs", problem, suggestion(name, stems))
    files = [file for file in files if not config.only or file.stem in config.only]
    if not files:
        problem = f"holds no photograph ({', '.join(IMAGE_SUFFIXES)})"
        raise ArtifactError(
            config.source, "photographs", problem, "Give one to seven photographs of one person"
        )
    return [_single(files[0])] if len(files) == 1 else find_photographs(files, None, read_upright_header)


def _single(file: Path) -> Photograph:
    """A photograph on its own, which `find_photographs` refuses: a calibration needs two."""
    import pycolmap

    header = read_upright_header(file)
    camera = None if header.format == "EXR" else pycolmap.infer_camera_from_image(file)
    focal = float(camera.mean_focal_length()) if camera and camera.has_prior_focal_length else None
    name = re.sub(r"[^A-Za-z0-9._-]", "_", file.stem)[:90]
    name = name if name[0].isalnum() else f"photo{name}"
    return Photograph(name, file, header.width, header.height, 0, focal)


# ----------------------------------------------------------------------------------------- results


def as_subject(
    found: PhotoAlignment, landmarks: Mapping[tuple[str, str], ViewLandmarks | NoFace]
) -> SubjectAlignment:
    """The face of a few photographs as that of a subject in a studio, photographs in place of cameras."""
    known = np.isfinite(found.points).all(axis=-1)
    triangulation = Triangulation(
        points=found.points,
        covariance=found.covariance,
        inliers=found.inliers.T & known[:, None],
        residuals=found.residuals.T,
        angle=_angles(found),
        reason=np.where(known, Reason.OK, Reason.TOO_FEW_VIEWS).astype(np.int8),
    )
    good = np.isfinite(found.keypoints).all(axis=-1)
    keypoints = Keypoints(
        positions=found.keypoints,
        covariance=found.keypoint_covariance,
        views=np.where(good, len(found.views), 0),
        reasons=tuple("" if there else Reason.TOO_FEW_VIEWS.words for there in good),
    )
    verdicts = {}
    for (_, name), entry in landmarks.items():
        if name in found.views:
            code = "agrees" if len(found.views) > 2 else "unchecked"
            verdicts[name] = ViewVerdict(True, code, "", np.full(len(good), np.nan))
        else:
            why = entry.reason if isinstance(entry, NoFace) else found.excluded.get(name, "was not used")
            verdicts[name] = ViewVerdict.without("no_face" if isinstance(entry, NoFace) else "disagrees", why)
    return SubjectAlignment(SCHEME, found.views, triangulation, keypoints, verdicts, 1.0, None)


def _angles(found: PhotoAlignment) -> np.ndarray:
    """The largest angle [N] between rays of the photographs that agree on a landmark, radians; NaN for one ray."""
    centers = np.array([entry.camera_from_rig.inverse.translation for entry in found.rig.cameras.values()])
    rays = found.points[:, None] - centers
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    cosines = np.einsum("nvi,nwi->nvw", rays, rays)
    both = found.inliers.T[:, :, None] & found.inliers.T[:, None, :]
    smallest = np.where(both, cosines, 1.0).min(axis=(1, 2))
    several = (found.inliers.sum(axis=0) > 1) & np.isfinite(found.points).all(axis=-1)
    return np.where(several, np.arccos(np.clip(smallest, -1, 1)), np.nan)


def _history(config: argparse.Namespace, landmarks: Landmarks) -> dict[str, Any]:
    settings = {
        "command": "photos",
        "only": config.only or [],
        "scale": config.scale,
        "known_distance": config.known_distance,
        "metric_cameras": config.metric_cameras,
        **landmarks.config,
    }
    inputs = {}
    if config.cameras is not None:
        inputs["given cameras"] = one_rig_file(config.cameras)
    if config.template is not None:
        inputs["given template"] = template_file(config.template)
    history = provenance(settings, inputs)
    for of_view in landmarks.inputs.values():
        history["inputs"] |= of_view
    return history


def _write(
    config: argparse.Namespace,
    identity: str,
    found: PhotoAlignment,
    studio: AlignedStudio,
    history: Mapping[str, Any],
    photographs: list[Photograph],
) -> list[str]:
    """Write everything, the index last."""
    files = {photo.id: photo.path for photo in photographs}

    def load_image(_: str, name: str) -> np.ndarray | None:
        try:
            return displayable(read_upright(files[name]))
        except ArtifactError:  # the photograph's reason says so
            return None

    folder, template = make_folder(config.output), studio.template
    assert template is not None
    report = photo_report(identity, found, studio, history, load_image).write(folder / REPORT_FILE)
    forget(folder)
    rig = write_rig(folder / RIG_FILE, replace(found.rig, provenance=history))
    write_template(folder / TEMPLATE_FILE, replace(template, provenance=template.provenance or history))
    subject, place, take = studio.subjects[identity], studio.placements[identity], found.rig.take
    views = {name: entry for (_, name), entry in studio.landmarks.items()}
    person = Alignment(identity, take, subject, place, views, history)
    write_alignment(folder / alignment_file(identity), person)
    entry = AlignedEntry.of(identity, take, subject, place)
    index = AlignmentIndex(template.scheme, (entry,), (), found.warnings, history)
    errors = median(found.residuals[found.inliers])
    return [
        f"{len(found.views)} of {len(photographs)} photographs used; landmarks reproject to {errors:.2f} px (median)",
        *(statement.text for statement in found.trust),
        f"rig: {rig}",
        f"report: {report}",
        str(write_index(folder, index)),
    ]
