"""Who is in a dataset: every aligned person with photographs, cameras and what the alignment says of both.

Nobody is left out without a word: what cannot be used comes back as `LeftOut`, with the reason as part of a sentence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.alignment_files import TEMPLATE_FILE, AlignedEntry, AlignmentIndex, read_index
from preface.align.person_file import Alignment, read_alignment
from preface.artifacts import ArtifactError, sha256
from preface.capture.images import IMAGE_SUFFIXES, read_header
from preface.capture.manifest import (
    FILE_NAME,
    Capture,
    CaptureCamera,
    Manifest,
    Subject,
    Take,
    read_capture,
)
from preface.capture.photos.files import camera_name
from preface.capture.rig import Rig, RigCamera
from preface.capture.upright import read_upright_header
from preface.geometry import Similarity
from preface.plain_words import suggestion

TEMPLATE_INPUT = f"alignment/{TEMPLATE_FILE}"
MIRRORED = "mirrored"  # the alignment's word for a photograph that was turned over


@dataclass(frozen=True)
class LeftOut:
    """A person, or one view of a person, that is not in the dataset; the reason is part of a sentence."""

    identity: str
    camera: str | None
    reason: str

    def __str__(self) -> str:
        where = self.identity if self.camera is None else f"{self.identity}/{self.camera}"
        return f"{where} is left out: {self.reason}"


@dataclass(frozen=True, eq=False)
class View:
    """One photograph of a person.

    Attributes:
        camera: its name.
        rig_camera: lens and pose, in the rig's frame.
        photograph: the file.
        name: how the dataset calls that file: relative to the capture, with forward slashes.
        mask, plate: the files, where there are any.
        aligned_sha256: of the photograph when it was aligned, where the alignment has recorded it.
        upright: whether it is turned as EXIF says, as `preface-align photos` does with photographs that are their
            own calibration.
    """

    camera: str
    rig_camera: RigCamera
    photograph: Path
    name: str
    mask: Path | None
    plate: Path | None
    aligned_sha256: str | None
    upright: bool = False


@dataclass(frozen=True, eq=False)
class Person:
    """One aligned person.

    Attributes:
        identity, take: names.
        views: of the cameras that have one that can be used, as far as headers tell.
        canonical_from_rig: the alignment.
        keypoints: float64 [5, 3], canonical frame, metres, NaN where missing.
        left_out: camera -> why it is not among the views.
        metadata: for the dataset, JSON types.
    """

    identity: str
    take: str
    views: tuple[View, ...]
    canonical_from_rig: Similarity
    keypoints: np.ndarray
    left_out: Mapping[str, str]
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Who may be in a dataset, as the capture's manifest and the alignment's index tell: no photograph, and no
    person's alignment has been opened.

    Attributes:
        capture: what they are from.
        alignment: the folder.
        index: of the alignment.
        subjects: those that were asked for, in the capture's order, aligned or not.
    """

    capture: Capture
    alignment: Path
    index: AlignmentIndex
    subjects: tuple[Subject, ...]

    @property
    def aligned(self) -> Mapping[str, AlignedEntry]:
        """Identity -> entry of those who are aligned; everybody who will be in the dataset is among them."""
        entries = {entry.identity: entry for entry in self.index.aligned}
        return {subject.id: entries[subject.id] for subject in self.subjects if subject.id in entries}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that have a photograph of one of these, in the capture's order."""
        aligned = self.aligned
        seen = {camera for identity, camera in self.capture.images if identity in aligned}
        return tuple(camera.id for camera in self.capture.manifest.cameras if camera.id in seen)


@dataclass(frozen=True, eq=False)
class People:
    """Everybody who can be used, in the capture's order.

    Attributes:
        capture: what they are from; its images are those of views that can be used.
        people: with at least one view.
        cameras: names of all cameras that have a view of somebody, in the capture's order.
        left_out: people and views that cannot be used.
        inputs: name -> file of what they were read from, for provenance; `TEMPLATE_INPUT` is the template.
    """

    capture: Capture
    people: tuple[Person, ...]
    cameras: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    inputs: Mapping[str, Path]


def persons_of(capture: Capture) -> Mapping[str, str]:
    """Identity -> person, where an imported capture has several identities of one person, as expressions."""
    return capture.manifest.metadata.get("imported", {}).get("people", {})


def find_candidates(
    source: Path, alignment: Path, only: Sequence[str] | None, masks: Path | None = None
) -> Candidates:
    """Find the people of a capture, or the one in a folder of photographs, without looking at them.

    Args:
        source: the capture, or the folder that `preface-align photos` was given.
        alignment: the folder of the alignment.
        only: these people, None for all.
        masks: of a folder of photographs, the folder of their masks, which have their names.

    Raises:
        ArtifactError: a malformed manifest or index, or somebody who is not there.
    """
    index = read_index(alignment)
    capture = read_capture(source) if is_capture(source) else capture_of_photographs(source, index, masks)
    return Candidates(capture, alignment, index, tuple(chosen_subjects(source, capture, only)))


def find_people(candidates: Candidates, rigs: Mapping[str, tuple[Path, Rig]], max_pixels: int) -> People:
    """Look at the alignment of each candidate and at the headers of the photographs, which takes a while for many.

    Args:
        candidates: see `find_candidates`.
        rigs: take -> file and rig.
        max_pixels: photographs of more are left out.

    Raises:
        ArtifactError: a malformed file, or a rig other than the alignment's.
        KeyError: a take without a rig.
    """
    capture, alignment, index = candidates.capture, candidates.alignment, candidates.index
    inputs = {f"rigs/{take}.json": file for take, (file, _) in rigs.items()}
    inputs[TEMPLATE_INPUT] = alignment / TEMPLATE_FILE
    if not capture.inferred:
        inputs[FILE_NAME] = capture.directory / FILE_NAME
    aligned = candidates.aligned
    excluded = {entry.identity: entry.reason for entry in index.excluded}
    people: list[Person] = []
    left_out: list[LeftOut] = []
    for subject in candidates.subjects:
        if subject.id not in aligned:
            why = excluded.get(subject.id, "it is not in the alignment")
            left_out.append(LeftOut(subject.id, None, f"not aligned: {why}"))
            continue
        file = alignment / aligned[subject.id].file
        person, missing = _person(subject, file, capture, rigs, max_pixels)
        left_out += missing
        if person is not None:
            people.append(person)
            inputs[f"alignment/{file.name}"] = file
    usable = {(person.identity, view.camera): view.photograph for person in people for view in person.views}
    seen = {camera for _, camera in usable}
    cameras = tuple(camera.id for camera in capture.manifest.cameras if camera.id in seen)
    return People(replace(capture, images=usable), tuple(people), cameras, tuple(left_out), inputs)


# ---------------------------------------------------------------------------------------- sources


def is_capture(source: Path) -> bool:
    """Whether a path is a capture of a studio, rather than a folder of photographs of one person."""
    return not source.is_dir() or (source / FILE_NAME).exists() or (source / "subjects").is_dir()


def chosen_subjects(source: Path, capture: Capture, only: Sequence[str] | None) -> list[Subject]:
    """The capture's people, or those of some names.

    Raises:
        ArtifactError: a name that is not there.
    """
    known = [subject.id for subject in capture.manifest.subjects]
    for name in only or ():
        if name not in known:
            raise ArtifactError(source, "identities", f"there is no '{name}'", suggestion(name, known))
    return [subject for subject in capture.manifest.subjects if not only or subject.id in only]


def capture_of_photographs(folder: Path, index: AlignmentIndex, masks: Path | None) -> Capture:
    """A folder of photographs of one person as a capture, each photograph a camera of its name.

    Raises:
        ArtifactError: no photographs, or an alignment of any other number of people than one.
    """
    files = _images(folder)
    everybody = [(entry.identity, entry.take) for entry in index.aligned]
    everybody += [(entry.identity, entry.take) for entry in index.excluded]
    if not files or len(everybody) != 1:
        problem = (
            f"holds no capture.json, no folder 'subjects' and {len(files)} photographs, and the alignment is of "
            f"{len(everybody)} people"
        )
        remedy = "Name a capture, or the folder of one person's photographs and its alignment"
        raise ArtifactError(folder, "folder", problem, remedy)
    given = {file.stem: file for file in _images(masks)} if masks else {}
    photographs = {camera_name(file.stem): file for file in files}
    if len(photographs) < len(files):
        problem = "two photographs differ in nothing but their suffix, or in signs that names of cameras lack"
        raise ArtifactError(folder, "photographs", problem, "Rename or remove one, and align again")
    ((identity, take),) = everybody
    manifest = Manifest(
        cameras=tuple(CaptureCamera(name) for name in photographs),
        takes=(Take(take),),
        subjects=(Subject(identity, take),),
    )
    found = {(identity, n): given[file.stem] for n, file in photographs.items() if file.stem in given}
    images = {(identity, name): file for name, file in photographs.items()}
    return Capture(folder, manifest, True, images, found, {})


def _images(folder: Path) -> list[Path]:
    try:
        return sorted(f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file())
    except OSError as error:
        raise ArtifactError.from_os(folder, "folder", error) from error


# ----------------------------------------------------------------------------------------- people


def _person(
    subject: Subject,
    file: Path,
    capture: Capture,
    rigs: Mapping[str, tuple[Path, Rig]],
    max_pixels: int,
) -> tuple[Person | None, list[LeftOut]]:
    """A person with the views that can be used, and why the others cannot."""
    found, upright = read_alignment(file), not is_capture(capture.directory)
    if found.take != subject.take:
        reason = f"aligned in take '{found.take}', but the capture says take '{subject.take}'; align again"
        return None, [LeftOut(subject.id, None, reason)]
    path, rig = rigs[found.take]
    _check_rig(path, file, found)
    hashes = dict((found.provenance or {}).get("inputs", {}))
    views, missing = [], []
    for camera in (camera.id for camera in capture.manifest.cameras):
        photograph = capture.images.get((subject.id, camera))
        reason = _unusable(photograph, camera, path, rig, found, (max_pixels, upright))
        if reason or photograph is None:
            missing.append(LeftOut(subject.id, camera, reason))
            continue
        views.append(
            View(
                camera=camera,
                rig_camera=rig.cameras[camera],
                photograph=photograph,
                name=photograph.relative_to(capture.directory).as_posix(),
                mask=capture.masks.get((subject.id, camera)),
                plate=capture.plates.get((subject.take, camera)),
                aligned_sha256=hashes.get(f"{subject.id}/{camera}/{photograph.name}"),
                upright=upright,
            )
        )
    if not views:
        return None, [*missing, LeftOut(subject.id, None, "not one of its views can be used")]
    similarity = found.placement.canonical_from_rig
    flags = [flag.code for flag in found.placement.flags]
    person = Person(
        identity=subject.id,
        take=subject.take,
        views=tuple(views),
        canonical_from_rig=similarity,
        keypoints=similarity.apply(found.subject.keypoints.positions),
        left_out={entry.camera: entry.reason for entry in missing if entry.camera},
        metadata={"alignment_flags": flags} if flags else {},
    )
    return person, missing


def _check_rig(path: Path, file: Path, found: Alignment) -> None:
    """Refuse a rig other than the one that a person was aligned with."""
    recorded = (found.provenance or {}).get("inputs", {}).get(f"rigs/{found.take}.json")
    if recorded is not None and recorded != sha256(path):
        problem = f"is not the rig that {file} was made with, or was changed since"
        raise ArtifactError(path, "file", problem, "Name that rig, or run preface-align again with this one")


def _unusable(
    file: Path | None, camera: str, path: Path, rig: Rig, found: Alignment, reading: tuple[int, bool]
) -> str:
    """Why a view cannot be used as far as its header tells; empty if it can. Reading: most pixels, and upright."""
    max_pixels, upright = reading
    if file is None:
        return "there is no photograph"
    if camera not in rig.cameras:
        return f"{path.name} has no camera '{camera}'"
    verdict = found.subject.views.get(camera)
    if verdict is not None and verdict.code == MIRRORED:
        return f"the alignment says: {verdict.reason}"
    try:
        header = read_upright_header(file) if upright else read_header(file)
    except ArtifactError as error:
        return f"{error.field}: {error.problem}. {error.remedy}"
    lens = rig.cameras[camera].camera
    if header.width * header.height > max_pixels:
        return f"{header.width}x{header.height} exceeds the limit of {max_pixels} pixels (--max-pixels)"
    if (header.width, header.height) != (lens.width, lens.height):
        return f"is {header.width}x{header.height}, but {path.name} has {lens.width}x{lens.height}"
    return ""
