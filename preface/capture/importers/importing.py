"""From a dataset's frames to a capture: images and masks by name, a rig per take, and the manifest last."""

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError, provenance
from preface.capture.importers import cafca, facescape
from preface.capture.importers.frames import Frame, ImportOptions, LeftOut
from preface.capture.importers.placing import placed
from preface.capture.manifest import CaptureCamera, Manifest, Subject, Take, write_capture
from preface.capture.rig import Rig, RigCamera, write_rig
from preface.geometry.transforms import Similarity
from preface.plain_words import suggestion

RIGS_FOLDER = "rigs"


@dataclass(frozen=True)
class _Layout:
    """How a dataset lies on disk: its reader, its shape in words, and what is assumed about it."""

    frames: Callable[[Path, ImportOptions], Iterator[Frame]]
    shape: str
    assumptions: tuple[str, ...]


LAYOUTS: Mapping[str, _Layout] = {
    "cafca": _Layout(cafca.frames, cafca.SHAPE, cafca.ASSUMPTIONS),
    "facescape": _Layout(facescape.frames, facescape.SHAPE, facescape.ASSUMPTIONS),
}


@dataclass(frozen=True)
class Imported:
    """What an import wrote.

    Attributes:
        capture: the folder.
        people, subjects, views, masks, takes: how many.
        left_out: frames and views that were not imported.
        notes: for the user.
    """

    capture: Path
    people: int
    subjects: int
    views: int
    masks: int
    takes: int
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]


@dataclass
class _Tally:
    """What has been imported so far."""

    takes: dict[tuple, str] = field(default_factory=dict)  # cameras -> take
    people: dict[str, str] = field(default_factory=dict)  # subject -> person
    subjects: list[Subject] = field(default_factory=list)
    sizes: dict[str, set[tuple[int, int]]] = field(default_factory=dict)  # of each camera
    left_out: list[LeftOut] = field(default_factory=list)
    views: int = 0
    masks: int = 0


def import_dataset(
    layout: str, source: str | os.PathLike[str], output: str | os.PathLike[str], options: ImportOptions
) -> Imported:
    """Make a capture of a dataset. It appears as a whole, or not at all.

    Args:
        layout: a name in `LAYOUTS`.
        source: folder of the dataset.
        output: folder to write, new or empty, outside the dataset.
        options: see `ImportOptions`.

    Raises:
        ArtifactError: no frame of this layout, nothing usable in any, with `strict` the first view that is not
            usable, an output that is not empty, or the disk refuses. Nothing is left behind.
    """
    if layout not in LAYOUTS:
        raise ArtifactError(
            source, "layout", f"'{layout}' is not a known layout", suggestion(layout, LAYOUTS)
        )
    folder, target = Path(source), Path(output).absolute()
    try:
        _check_folders(folder, target)
        with _staged(target) as staging:
            tally = _import_frames(layout, folder, staging, options)
            _write_manifest(layout, staging, tally, options)
    except OSError as error:
        raise ArtifactError.from_os(error.filename or output, "file", error) from error
    return Imported(
        capture=Path(output),
        people=len(set(tally.people.values())),
        subjects=len(tally.subjects),
        views=tally.views,
        masks=tally.masks,
        takes=len(tally.takes),
        left_out=tuple(tally.left_out),
        notes=_notes(layout, options, len(tally.takes)),
    )


def _check_folders(source: Path, target: Path) -> None:
    if not source.is_dir():
        raise ArtifactError(source, "folder", "does not exist or is a file", "Name the dataset's folder")
    if target.resolve().is_relative_to(source.resolve()):
        problem = f"lies within the dataset, {source}"
        raise ArtifactError(target, "output", problem, "Name a folder outside of it")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        problem = "is not an empty folder, and its files would mix with the imported ones"
        raise ArtifactError(target, "output", problem, "Name a new folder, or empty this one")


@contextlib.contextmanager
def _staged(target: Path) -> Iterator[Path]:
    """A folder beside the target that takes its name when all is well, and is removed otherwise."""
    target.parent.mkdir(parents=True, exist_ok=True)
    staging = target.with_name(f".{target.name[:200]}.{secrets.token_hex(6)}.tmp")
    staging.mkdir()
    try:
        yield staging
        staging.replace(target)  # an empty folder may be there
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


# ------------------------------------------------------------------------------------------ frames


def _import_frames(layout: str, source: Path, staging: Path, options: ImportOptions) -> _Tally:
    kind, tally, found = LAYOUTS[layout], _Tally(), 0
    seen: dict[str, str] = {}
    for frame in kind.frames(source, options):
        found += 1
        same = seen.setdefault(frame.identity.casefold(), frame.place)
        if same != frame.place or (frame.identity in tally.people):
            problem = f"would have the name of {same}, upper and lower case being the same"
            frame.images.clear()
            frame.leave_out(ArtifactError(source / frame.place, "name", problem, "Rename one of the folders"))
        if not frame.images and not frame.left_out:
            problem = "has no views"
            frame.leave_out(ArtifactError(source / frame.place, "views", problem, "Download the frame again"))
        if frame.left_out and options.strict:
            raise frame.left_out[0].error
        tally.left_out += frame.left_out
        if frame.images:
            _import_frame(layout, frame, staging, options, tally)
    if not found:
        problem = f"has no frame that matches {' or '.join(options.patterns)} in the layout {kind.shape}"
        remedy = "Name the folder that holds the people's folders, and check --layout and --frames"
        raise ArtifactError(source, "frames", problem, remedy)
    if not tally.subjects:
        problem = (
            f"none of its {found} frames can be used; the first is left out because of {tally.left_out[0]}"
        )
        raise ArtifactError(source, "frames", problem, "Correct what is said there")
    return tally


def _import_frame(layout: str, frame: Frame, staging: Path, options: ImportOptions, tally: _Tally) -> None:
    cameras: dict[str, RigCamera] = frame.cameras
    if options.metres_per_unit != 1:
        cameras = placed(cameras, Similarity(np.array(options.metres_per_unit), np.eye(3), np.zeros(3)))
    key = tuple(sorted(cameras.items(), key=lambda item: item[0]))
    if key not in tally.takes:
        tally.takes[key] = frame.identity
        _write_rig(layout, frame, cameras, staging, options)
    for camera, file in frame.images.items():
        _place(file, staging / "subjects" / frame.identity / f"{camera}{file.suffix.lower()}", options)
    for camera, file in frame.masks.items():
        _place(file, staging / "masks" / frame.identity / f"{camera}{file.suffix.lower()}", options)
    for name, placed_camera in cameras.items():
        lens = placed_camera.camera
        tally.sizes.setdefault(name, set()).add((lens.width, lens.height))
    tally.people[frame.identity] = frame.person
    tally.subjects.append(Subject(frame.identity, tally.takes[key]))
    tally.views += len(frame.images)
    tally.masks += len(frame.masks)


def _place(file: Path, destination: Path, options: ImportOptions) -> None:
    """Link or copy a file of the dataset; what symbolic links within the dataset lead to is what is placed."""
    destination.parent.mkdir(parents=True, exist_ok=True)
    if options.link == "copy":
        with file.open("rb") as original, destination.open("xb") as copy:
            shutil.copyfileobj(original, copy, 2**20)
            copy.flush()
            os.fsync(copy.fileno())
        return
    try:
        os.link(file.resolve(), destination)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise
        problem = f"cannot be linked into the capture ({error.strerror})"
        remedy = "Use --link copy, or an --output on the dataset's file system"
        raise ArtifactError(file, "link", problem, remedy) from error


# ------------------------------------------------------------------------------------------- files


def _described(layout: str, options: ImportOptions) -> dict[str, Any]:
    """The configuration as JSON has it, without what differs between equal results."""
    registered = (facescape.REGISTERED,) if options.registrations is not None else ()
    return {
        "layout": layout,
        "metres_per_unit": None if registered else options.metres_per_unit,
        "registrations": options.registrations.name if options.registrations is not None else None,
        "assumptions": [*LAYOUTS[layout].assumptions, *registered],
    }


def _write_rig(
    layout: str, frame: Frame, cameras: Mapping[str, RigCamera], staging: Path, options: ImportOptions
) -> None:
    inputs = {f"{frame.place}/{file.name}": file for file in frame.camera_files}
    if options.registrations is not None:
        inputs[options.registrations.name] = options.registrations
    config = _described(layout, options)
    rig = Rig(
        take=frame.identity,
        cameras=dict(cameras),
        provenance=provenance(config, inputs),
        metadata={"imported": {"format": layout, "assumptions": config["assumptions"]}},
    )
    (staging / RIGS_FOLDER).mkdir(exist_ok=True)
    write_rig(staging / RIGS_FOLDER / f"{frame.identity}.json", rig)


def _write_manifest(layout: str, staging: Path, tally: _Tally, options: ImportOptions) -> None:
    config = _described(layout, options)
    cameras = []
    for name in sorted(tally.sizes):
        sizes = tally.sizes[name]
        width, height = next(iter(sizes)) if len(sizes) == 1 else (None, None)
        cameras.append(CaptureCamera(name, width, height))
    left_out = [
        {"place": left.place, "why": f"{left.error.problem}. {left.error.remedy}"} for left in tally.left_out
    ]
    manifest = Manifest(
        cameras=tuple(cameras),
        takes=tuple(Take(take) for take in tally.takes.values()),
        subjects=tuple(tally.subjects),
        provenance=provenance({**config, "frames": list(options.patterns)}, {}),
        metadata={"imported": {**config, "people": tally.people, "left_out": left_out}},
    )
    write_capture(staging, manifest)


def _notes(layout: str, options: ImportOptions, takes: int) -> tuple[str, ...]:
    notes = [f"assumed: {words}" for words in _described(layout, options)["assumptions"]]
    if takes > 1 and options.registrations is None:
        notes.append(
            f"there are {takes} takes, each with cameras of its own; unless they share one world and unit, align them "
            "with preface-align studio --procrustes"
        )
    return tuple(notes)
