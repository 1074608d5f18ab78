"""The capture manifest: which cameras, takes, boards and people a capture folder holds, and its files.

A `Manifest` is what ``capture.json`` says; a `Capture` adds the files that lie in the folder. See
``data_specs/capture.md`` for the format. Without ``capture.json`` the manifest is inferred from the
standard layout.
"""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, read_artifact, resolve_inside, validate, write_artifact
from preface.capture.folders import files, images_by_stem, implied_manifest
from preface.capture.images import IMAGE_SUFFIXES
from preface.plain_words import suggestion

SCHEMA = "preface/capture"
FILE_NAME = "capture.json"

# How many markers each of OpenCV's dictionaries holds.
DICTIONARY_SIZES = {
    **{f"DICT_{n}X{n}_{size}": size for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}


@dataclass(frozen=True)
class CaptureCamera:
    """A camera by name, with the size of its images in pixels where that is known beforehand."""

    id: str
    width: int | None = None
    height: int | None = None


@dataclass(frozen=True)
class Board:
    """A flat calibration board; ``squares`` is (columns, rows), sizes in metres."""

    id: str
    type: str
    squares: tuple[int, int]
    square_size: float
    marker_size: float | None = None
    dictionary: str | None = None
    legacy: bool | None = None
    inverted: bool | None = None

    @property
    def marker_count(self) -> int:
        """How many markers the board shows."""
        columns, rows = self.squares
        return {"charuco": columns * rows // 2, "aprilgrid": columns * rows}.get(self.type, 0)


@dataclass(frozen=True)
class Take:
    """A span of time with one calibration and one background; folders are relative to the capture."""

    id: str
    board: str | None = None
    background: str = "unknown"
    calibration: str | None = None
    plates: str | None = None

    @property
    def calibration_folder(self) -> str:
        """The folder with one folder of calibration images per camera."""
        return self.calibration or f"calibration/{self.id}"

    @property
    def plates_folder(self) -> str:
        """The folder with one image of the empty background per camera."""
        return self.plates or "background"


@dataclass(frozen=True)
class Subject:
    """A person, photographed once by all cameras, during one take.

    Attributes:
        id: the name.
        take: the take's id.
        images: camera id to the photograph, relative to the capture, where the layout does not say it, as when
            there are several of each camera; cameras without an entry have not seen the subject then.
    """

    id: str
    take: str
    images: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Layout:
    """Where images and masks lie: paths with ``{identity}`` and ``{camera}``; ``.*`` is any suffix."""

    images: str = "subjects/{identity}/{camera}.*"
    masks: str = "masks/{identity}/{camera}.*"


@dataclass(frozen=True)
class Manifest:
    """What ``capture.json`` says."""

    cameras: tuple[CaptureCamera, ...]
    takes: tuple[Take, ...]
    subjects: tuple[Subject, ...]
    boards: tuple[Board, ...] = ()
    layout: Layout = field(default_factory=Layout)
    provenance: Mapping[str, Any] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def board_of(self, take: Take) -> Board | None:
        """The board of a take: the one it names, or the only one there is."""
        if take.board is None:
            return self.boards[0] if len(self.boards) == 1 else None
        return next(board for board in self.boards if board.id == take.board)


@dataclass(frozen=True)
class Capture:
    """A manifest and the files found for it.

    Attributes:
        directory: the capture's folder.
        manifest: what it holds.
        inferred: whether the manifest was inferred for want of a ``capture.json``.
        images: (subject id, camera id) to the image.
        masks: (subject id, camera id) to the mask, where there is one.
        plates: (take id, camera id) to the clean plate, where there is one.
    """

    directory: Path
    manifest: Manifest
    inferred: bool
    images: Mapping[tuple[str, str], Path]
    masks: Mapping[tuple[str, str], Path]
    plates: Mapping[tuple[str, str], Path]

    @property
    def missing_views(self) -> list[tuple[str, str]]:
        """(subject id, camera id) of every view without an image, in the manifest's order."""
        views = [(s.id, c.id) for s in self.manifest.subjects for c in self.manifest.cameras]
        return [view for view in views if view not in self.images]

    def calibration_files(self, take: Take, camera_id: str) -> list[Path]:
        """The calibration images (or the one video) of a camera in a take, by name; hidden files left out.

        Raises:
            ArtifactError: one of them leads out of the capture's folder.
        """
        artifact, folder = self.directory / FILE_NAME, f"{take.calibration_folder}/{camera_id}"
        names = sorted(entry.name for entry in files(self.directory / folder))
        return [resolve_inside(artifact, folder, f"{folder}/{name}") for name in names]


def read_capture(path: str | os.PathLike[str]) -> Capture:
    """Read a capture and find its files.

    Args:
        path: the capture's folder, or its manifest.

    Returns:
        The capture. Missing views are no error; see `Capture.missing_views`.

    Raises:
        ArtifactError: the manifest is malformed or contradicts itself, a subject has no image at all,
            a view has two images, or a path leaves the folder.
    """
    try:
        return _read_capture(Path(path))
    except OSError as error:  # a folder that may not be listed
        raise ArtifactError.from_os(error.filename or path, "file", error) from error


def _read_capture(path: Path) -> Capture:
    manifest_path = path / FILE_NAME if path.is_dir() else path
    inferred = path.is_dir() and not os.path.lexists(manifest_path)
    if inferred:
        manifest_path = path / f"{FILE_NAME} (inferred)"
        payload = _inferred(path)
        validate(payload, manifest_path, SCHEMA)
    else:
        payload = read_artifact(manifest_path, SCHEMA)
    manifest = _manifest(payload)
    _check(manifest, manifest_path)
    return Capture(manifest_path.parent, manifest, inferred, *_find_files(manifest, manifest_path))


def write_capture(directory: str | os.PathLike[str], manifest: Manifest) -> Path:
    """Write ``capture.json`` into a capture's folder; its images may follow later.

    Returns:
        The path of the file.

    Raises:
        ArtifactError: the manifest contradicts itself, or the disk refuses.
    """
    path = Path(directory) / FILE_NAME
    _check(manifest, path)
    content = {key: value for key, value in asdict(manifest, dict_factory=_without_none).items() if value}
    content["subjects"] = content.get("subjects", ())  # required, even while there is none yet
    if manifest.layout == Layout():
        del content["layout"]
    return write_artifact(path, {"schema": SCHEMA, "schema_version": 1, **content})


def _without_none(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {key: value for key, value in items if value is not None}


def _manifest(payload: Mapping[str, Any]) -> Manifest:
    return Manifest(
        cameras=tuple(CaptureCamera(**entry) for entry in payload["cameras"]),
        takes=tuple(Take(**entry) for entry in payload["takes"]),
        subjects=tuple(Subject(**entry) for entry in payload["subjects"]),
        boards=tuple(
            Board(**{**entry, "squares": tuple(entry["squares"])}) for entry in payload.get("boards", ())
        ),
        layout=Layout(**payload.get("layout", {})),
        provenance=payload.get("provenance"),
        metadata=payload.get("metadata", {}),
    )


# --------------------------------------------------------------------------------- contradictions


def _check(manifest: Manifest, path: Path) -> None:
    """Refuse what a schema cannot express: repeated names, dangling references, impossible boards."""
    for kind in ("cameras", "takes", "subjects", "boards"):
        seen: dict[str, str] = {}
        for index, entry in enumerate(getattr(manifest, kind)):
            place, key = f"{kind}[{index}].id", entry.id.casefold()
            if key in seen:
                problem = f"'{entry.id}' repeats '{seen[key]}'"
                raise ArtifactError(path, place, problem, "Give each a name that differs in more than case")
            seen[key] = entry.id
    for index, board in enumerate(manifest.boards):
        _check_board(board, f"boards[{index}]", path)
    for index, take in enumerate(manifest.takes):
        if take.board is not None:
            _check_reference(take.board, manifest.boards, "board", f"takes[{index}].board", path)
        for key in ("calibration", "plates"):
            if getattr(take, key) is not None:
                resolve_inside(path, f"takes[{index}].{key}", getattr(take, key))
    for index, subject in enumerate(manifest.subjects):
        _check_reference(subject.take, manifest.takes, "take", f"subjects[{index}].take", path)
        for camera in subject.images or ():
            _check_reference(camera, manifest.cameras, "camera", f"subjects[{index}].images", path)
    for key in ("images", "masks"):
        _check_template(getattr(manifest.layout, key), f"layout.{key}", path)


def _check_reference(
    name: str,
    entries: tuple[Board, ...] | tuple[Take, ...] | tuple[CaptureCamera, ...],
    kind: str,
    place: str,
    path: Path,
) -> None:
    known = [entry.id for entry in entries]
    if name not in known:
        problem = f"'{name}' is not one of the {kind}s ({', '.join(known) or 'there are none'})"
        remedy = f"Correct the name or add the {kind}"
        raise ArtifactError(path, place, problem, f"{suggestion(name, known)}. {remedy}" if known else remedy)


def _check_board(board: Board, place: str, path: Path) -> None:
    if board.marker_size is not None and board.marker_size >= board.square_size:
        problem = f"{board.marker_size} m is not smaller than square_size, {board.square_size} m"
        raise ArtifactError(path, f"{place}.marker_size", problem, "Measure both again, in metres")
    capacity = DICTIONARY_SIZES.get(board.dictionary or "")
    if capacity is not None and board.marker_count > capacity:
        problem = f"{board.dictionary} holds {capacity} markers, but the board shows {board.marker_count}"
        raise ArtifactError(path, f"{place}.dictionary", problem, "Correct the dictionary or the squares")


def _check_template(template: str, place: str, path: Path) -> None:
    example = _expand(template, "identity", "camera")
    remedy = "Write it like subjects/{identity}/{camera}.* or subjects/{identity}/{camera}.png"
    for placeholder in ("{identity}", "{camera}"):
        if placeholder not in template:
            raise ArtifactError(path, place, f"'{template}' lacks {placeholder}", remedy)
    stem, _, suffix = example.rpartition(".")
    if any(c in stem for c in "{}*?[]") or (suffix != "*" and f".{suffix.lower()}" not in IMAGE_SUFFIXES):
        problem = f"'{template}' is not a path with {{identity}} and {{camera}} that ends in .* or a suffix"
        raise ArtifactError(path, place, problem, f"{remedy}; suffixes: {', '.join(IMAGE_SUFFIXES)}")
    resolve_inside(path, place, example)


def _expand(template: str, identity: str, camera: str) -> str:
    return template.replace("{identity}", identity).replace("{camera}", camera)


# ------------------------------------------------------------------------------------------ files


def _find_files(manifest: Manifest, path: Path) -> list[dict[tuple[str, str], Path]]:
    """The images, masks and plates of a manifest, each by (subject or take id, camera id)."""
    folder = path.parent
    listing = cache(lambda relative: images_by_stem(folder / relative))

    def find(pattern: str, place: str) -> Path | None:
        parent, _, name = pattern.rpartition("/")
        stem, _, suffix = name.rpartition(".")
        found = [n for n in listing(parent).get(stem, ()) if suffix == "*" or n == name]
        if len(found) > 1:
            problem = f"several files claim to be {pattern}: {', '.join(found)}"
            raise ArtifactError(path, place, problem, "Keep one of them")
        return resolve_inside(path, place, f"{parent}/{found[0]}" if parent else found[0]) if found else None

    def find_all(patterns: Mapping[tuple[str, str], tuple[str, str]]) -> dict[tuple[str, str], Path]:
        found = {view: find(pattern, place) for view, (pattern, place) in patterns.items()}
        return {view: file for view, file in found.items() if file is not None}

    cameras = [camera.id for camera in manifest.cameras]
    subjects = [(f"subjects[{i}]", s.id) for i, s in enumerate(manifest.subjects)]
    takes = [(f"takes[{i}].plates", take) for i, take in enumerate(manifest.takes)]
    images, masks = (
        find_all({(s, c): (_expand(template, s, c), place) for place, s in subjects for c in cameras})
        for template in (manifest.layout.images, manifest.layout.masks)
    )
    for (place, identity), subject in zip(subjects, manifest.subjects, strict=True):
        if subject.images is not None:
            images = {view: file for view, file in images.items() if view[0] != identity}
            images |= _listed_images(path, f"{place}.images", subject)
    plates = find_all({(t.id, c): (f"{t.plates_folder}/{c}.*", p) for p, t in takes for c in cameras})
    for place, identity in subjects:
        if not any((identity, c) in images for c in cameras):
            problem = f"no image at {_expand(manifest.layout.images, identity, '<camera>')} for any camera"
            remedy = "Add the images, correct the names of files or cameras, or remove the subject"
            raise ArtifactError(path, place, problem, remedy)
    for place, take in takes:
        needed = take.plates is not None or take.background == "plate"
        if needed and not any((take.id, c) in plates for c in cameras):
            problem = f"no clean plate at {take.plates_folder}/<camera>.* for any camera"
            raise ArtifactError(
                path, place, problem, "Add the plates or correct the folder or the background"
            )
    return [images, masks, plates]


def _listed_images(path: Path, place: str, subject: Subject) -> dict[tuple[str, str], Path]:
    """The photographs that a subject lists, each of which must be there."""
    found = {}
    for camera, relative in (subject.images or {}).items():
        file = resolve_inside(path, f"{place}.{camera}", relative)
        if not file.is_file():
            problem = f"there is no file {relative}"
            raise ArtifactError(path, f"{place}.{camera}", problem, "Correct the path, or remove the entry")
        found[subject.id, camera] = file
    return found


def _inferred(folder: Path) -> dict[str, Any]:
    """The manifest, as JSON, of a folder in a standard layout."""
    found = implied_manifest(folder)
    subjects = [{**subject, "take": found["takes"][0]["id"]} for subject in found["subjects"]]
    return {"schema": SCHEMA, "schema_version": 1, **found, "subjects": subjects}
