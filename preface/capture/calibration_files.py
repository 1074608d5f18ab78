"""Where the pictures of a board lie in a capture, camera by camera and take by take.

With a manifest it says. Without one, the layout is inferred, the first of these that holds anything:

    CAPTURE/calibration/<camera>/*            CAPTURE/calibration/<camera>.mp4
    CAPTURE/calibration/<take>/<camera>/*     CAPTURE/calibration/<take>/<camera>.mp4
    CAPTURE/<camera>/*                        CAPTURE/<camera>.mp4

Each camera has images, or one video. ``timestamps.csv`` beside the cameras says which frames of the videos
belong together; without it, images of the same name do, and frames of the same number.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from preface.artifacts import ArtifactError, resolve_inside
from preface.capture.images import IMAGE_SUFFIXES
from preface.capture.manifest import FILE_NAME, Board, Capture, Take, read_capture
from preface.capture.video import TIMESTAMPS, VIDEO_SUFFIXES

DEFAULT_TAKE = "default"
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_NOT_CAMERAS = frozenset({"calibration", "subjects", "masks", "background"})


@dataclass(frozen=True)
class CalibrationTake:
    """The pictures of a board that were taken with one rig.

    Attributes:
        id: the take's name.
        folder: what holds the cameras.
        cameras: camera id to its images by name, or to its one video, or to nothing.
        timestamps: the file that says which frames belong together, where there is one.
        board: the board, where the manifest says.
    """

    id: str
    folder: Path
    cameras: Mapping[str, tuple[Path, ...]]
    timestamps: Path | None = None
    board: Board | None = None


def is_video(files: tuple[Path, ...]) -> bool:
    """Whether a camera's files are one video."""
    return len(files) == 1 and files[0].suffix.lower() in VIDEO_SUFFIXES


def find_calibration(capture: str | os.PathLike[str]) -> list[CalibrationTake]:
    """Find the takes of a capture and the files of their cameras.

    Raises:
        ArtifactError: nothing found, a name that cannot be a camera's or a take's, or a camera with more than
            images or one video.
    """
    path = Path(capture)
    try:
        if path.name == FILE_NAME or os.path.lexists(path / FILE_NAME):
            read = read_capture(path)
            return [_from_manifest(read, take) for take in read.manifest.takes]
        return _inferred(path)
    except OSError as error:
        raise ArtifactError.from_os(error.filename or path, "folder", error) from error


def _from_manifest(capture: Capture, take: Take) -> CalibrationTake:
    manifest, folder = capture.directory / FILE_NAME, capture.directory / take.calibration_folder
    found = _cameras(folder) if folder.is_dir() else {}
    known = [camera.id for camera in capture.manifest.cameras]
    for camera in found:
        if camera not in known:
            problem = f"'{camera}' is not one of the manifest's cameras ({', '.join(known)})"
            raise ArtifactError(folder, camera, problem, "Rename it, or add the camera to the manifest")
    if not found:
        problem = f"take '{take.id}' has no pictures of a board in {folder}"
        raise ArtifactError(manifest, "takes", problem, f"Put them at {folder}/<camera>/")
    for files in found.values():
        for file in files:
            resolve_inside(manifest, "takes", file.relative_to(capture.directory).as_posix())
    cameras = {camera: found.get(camera, ()) for camera in known}
    return CalibrationTake(take.id, folder, cameras, _timestamps(folder), capture.manifest.board_of(take))


def _inferred(capture: Path) -> list[CalibrationTake]:
    if not capture.is_dir():
        problem = "there is no such folder" if not capture.exists() else "is a file"
        raise ArtifactError(capture, "folder", problem, "Name the folder that holds the capture")
    folder = capture / "calibration"
    if folder.is_dir():
        holds_takes = any(_holds_videos_of_cameras(child) for child in _folders(folder))
        if not holds_takes and (cameras := _cameras(folder)):
            return [CalibrationTake(DEFAULT_TAKE, folder, cameras, _timestamps(folder))]
        takes = [
            CalibrationTake(_checked_id(take, "take"), take, cameras, _timestamps(take))
            for take in _folders(folder)
            if (cameras := _cameras(take))
        ]
        if takes:
            return takes
    elif cameras := _cameras(capture, _NOT_CAMERAS):
        return [CalibrationTake(DEFAULT_TAKE, capture, cameras, _timestamps(capture))]
    problem = "holds no pictures of a board"
    remedy = (
        "Put images at calibration/<camera>/ or calibration/<take>/<camera>/, or one video per camera, "
        "<camera>.mp4, and export other formats as PNG, JPEG, TIFF, EXR or MP4"
    )
    raise ArtifactError(capture, "folder", problem, remedy)


def _cameras(folder: Path, leave_out: frozenset[str] = frozenset()) -> dict[str, tuple[Path, ...]]:
    """The cameras of a folder: its sub-folders that hold pictures, and its videos; by name."""
    cameras: dict[str, tuple[Path, ...]] = {}
    for child in _folders(folder):
        if child.name not in leave_out and (files := _pictures(child)):
            cameras[_checked_id(child, "camera")] = files
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() in VIDEO_SUFFIXES and file.is_file() and not file.name.startswith("."):
            if file.stem in cameras:
                problem = f"the camera '{file.stem}' has a folder and a video, or two videos"
                raise ArtifactError(folder, file.name, problem, "Keep one of them")
            cameras[_checked_id(file.with_suffix(""), "camera")] = (file,)
    return dict(sorted(cameras.items()))


def _pictures(folder: Path) -> tuple[Path, ...]:
    """The images, or the one video, of a camera."""
    files = sorted(f for f in folder.iterdir() if f.is_file() and not f.name.startswith("."))
    images = tuple(f for f in files if f.suffix.lower() in IMAGE_SUFFIXES)
    videos = tuple(f for f in files if f.suffix.lower() in VIDEO_SUFFIXES)
    if videos and (images or len(videos) > 1):
        problem = f"holds {len(images)} images and {len(videos)} videos"
        raise ArtifactError(folder, "files", problem, "A camera has images, or one video: keep those")
    stems = [image.stem for image in images]
    if len(set(stems)) < len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        problem = f"two images are called {twice}, and the name says which instant an image shows"
        raise ArtifactError(folder, twice, problem, "Keep one of them")
    return images or videos


def _holds_videos_of_cameras(folder: Path) -> bool:
    """Whether a folder is a take of cameras with one video each, and not a camera: it has several videos."""
    suffixes = [f.suffix.lower() for f in folder.iterdir() if f.is_file() and not f.name.startswith(".")]
    images = any(suffix in IMAGE_SUFFIXES for suffix in suffixes)
    return not images and sum(suffix in VIDEO_SUFFIXES for suffix in suffixes) > 1


def _folders(folder: Path) -> list[Path]:
    return sorted(c for c in folder.iterdir() if c.is_dir() and not c.name.startswith("."))


def _timestamps(folder: Path) -> Path | None:
    path = folder / TIMESTAMPS
    return path if os.path.lexists(path) else None


def _checked_id(path: Path, kind: str) -> str:
    if not _ID.fullmatch(path.name):
        problem = f"'{path.name}' cannot be the name of a {kind}"
        remedy = "Rename it: letters, digits, '.', '_' and '-', a letter or digit first"
        raise ArtifactError(path, "name", problem, remedy)
    return path.name
