"""Videos of boards: frames one after the other, and ``timestamps.csv``, which says what belongs together.

Frames are counted by decoding them in order, because seeking is inexact in many containers. No more than
one frame is held at a time.
"""

import csv
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from preface.artifacts import ArtifactError

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")
TIMESTAMPS = "timestamps.csv"
_COLUMNS = ("sync_index", "cam_id", "frame_index")


class VideoError(ArtifactError):
    """A video that cannot be read, or timestamps that do not fit the videos."""


@dataclass(frozen=True)
class VideoHeader:
    """What a container says: size in pixels, and how many frames (0 where it does not know)."""

    width: int
    height: int
    frames: int


def read_video_header(path: str | os.PathLike[str]) -> VideoHeader:
    """Open a video and read its header.

    Raises:
        VideoError: no video, empty, or with a rotation tag (as for images, pixels must stand upright).
    """
    import cv2

    capture = _open(path)
    try:
        width, height, frames, turn = (
            int(capture.get(name))
            for name in (
                cv2.CAP_PROP_FRAME_WIDTH,
                cv2.CAP_PROP_FRAME_HEIGHT,
                cv2.CAP_PROP_FRAME_COUNT,
                cv2.CAP_PROP_ORIENTATION_META,
            )
        )
    finally:
        capture.release()
    if turn % 360:
        remedy = "Rotate the pixels (ffmpeg does when it encodes again), in photographs alike"
        raise VideoError(path, "rotation", f"the file asks to be rotated by {turn} degrees", remedy)
    if width < 1 or height < 1:
        raise VideoError(path, "header", "holds no picture", "Record or export the video again")
    return VideoHeader(width, height, max(frames, 0))


def read_frames(
    path: str | os.PathLike[str], wanted: Sequence[int] | None = None, every: int = 1
) -> Iterator[tuple[int, np.ndarray]]:
    """Decode frames in order.

    Args:
        path: the video.
        wanted: indices of frames, counted from 0; None for all.
        every: without `wanted`, take each n-th frame.

    Yields:
        (index, grey uint8 [height, width]).

    Raises:
        VideoError: no video, no frame at all, or it ends before the last wanted frame.
    """
    import cv2

    capture = _open(path)
    pending = None if wanted is None else set(wanted)
    index = 0
    try:
        while (pending is None or pending) and capture.grab():
            if index % every == 0 if pending is None else index in pending:
                decoded, frame = capture.retrieve()
                if not decoded:
                    raise VideoError(path, f"frame {index}", "cannot be decoded", "Export the video again")
                yield index, frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            if pending is not None:
                pending.discard(index)
            index += 1
    finally:
        capture.release()
    if index == 0:
        raise VideoError(path, "frames", "the video is empty", "Record or export it again")
    if pending:
        problem = f"ends after {index} frames, but frame {max(pending)} is needed"
        raise VideoError(path, "frames", problem, f"Copy the video again, or correct {TIMESTAMPS}")


def _open(path: str | os.PathLike[str]) -> "cv2.VideoCapture":  # type: ignore[name-defined] # noqa: F821
    import cv2

    try:
        with Path(path).open("rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise VideoError.from_os(path, "file", error) from error
    if empty:
        raise VideoError(path, "file", "is empty", "Copy or record the video again")
    capture = cv2.VideoCapture(os.fspath(path))
    if not capture.isOpened():
        remedy = "Copy it again, or export it as MP4 with H.264"
        raise VideoError(path, "header", "is no video that OpenCV can read, or is damaged", remedy)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


# ------------------------------------------------------------------------------------- timestamps


@dataclass(frozen=True)
class Timestamps:
    """Which frames of which cameras are of one instant.

    Attributes:
        path: the file.
        frames: for each cam_id, {sync_index: frame_index}.
    """

    path: Path
    frames: Mapping[int, Mapping[int, int]]


def read_timestamps(path: str | os.PathLike[str]) -> Timestamps:
    """Read ``timestamps.csv``: a header with sync_index, cam_id and frame_index, in any order; more is ignored.

    Raises:
        VideoError: columns are missing, a cell is no whole number, or a frame appears twice.
    """
    frames: dict[int, dict[int, int]] = {}
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            missing = [name for name in _COLUMNS if name not in (rows.fieldnames or ())]
            if missing:
                problem = f"lacks the column {missing[0]}"
                raise VideoError(path, "line 1", problem, f"The first line names {', '.join(_COLUMNS)}")
            for line, row in enumerate(rows, start=2):
                sync, camera, index = (_whole(path, line, name, row[name]) for name in _COLUMNS)
                if sync in frames.setdefault(camera, {}):
                    problem = f"cam_id {camera} has sync_index {sync} a second time"
                    raise VideoError(path, f"line {line}", problem, "Keep one of the lines")
                frames[camera][sync] = index
    except OSError as error:
        raise VideoError.from_os(path, "file", error) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise VideoError(path, "file", f"is no CSV text ({error})", "Save it as UTF-8 CSV") from error
    if not frames:
        raise VideoError(path, "file", "holds no line", "Write one line per frame, or remove the file")
    return Timestamps(Path(path), frames)


def _whole(path: str | os.PathLike[str], line: int, name: str, text: str | None) -> int:
    try:
        value = int(text or "")
    except ValueError as error:
        problem = f"{name} is '{text or ''}', no whole number"
        raise VideoError(path, f"line {line}", problem, "Correct that line") from error
    if value < 0:
        raise VideoError(path, f"line {line}", f"{name} is negative", "Correct that line")
    return value


def assign_cameras(timestamps: Timestamps, camera_ids: Sequence[str]) -> dict[str, int]:
    """Which cam_id belongs to which camera: the name is the number, or ends in it (``cam_3``, ``camera03``).

    Raises:
        VideoError: a camera has none, or two cameras have the same.
    """
    assigned: dict[str, int] = {}
    for camera in camera_ids:
        match = re.search(r"(\d+)$", camera)
        number = int(match[1]) if match else None
        if number is None or number not in timestamps.frames:
            known = ", ".join(map(str, sorted(timestamps.frames)))
            problem = f"no cam_id belongs to the camera '{camera}' (there are {known})"
            remedy = "Name each video after its cam_id, such as cam_0.mp4, or remove the file"
            raise VideoError(timestamps.path, "cam_id", problem, remedy)
        if number in assigned.values():
            other = next(name for name, value in assigned.items() if value == number)
            problem = f"{number} could belong to '{other}' and to '{camera}'"
            raise VideoError(timestamps.path, "cam_id", problem, "Name each video after its cam_id")
        assigned[camera] = number
    return assigned


def frames_of_video(timestamps: Timestamps, cam_id: int, video: Path) -> dict[int, int]:
    """{index of a frame in the video file: sync_index}.

    `frame_index` usually counts the video's frames from 0. Where it exceeds the video's length, the video
    was cut out of a longer recording; if it then has just as many frames as there are lines for its camera,
    the lines in order of frame_index are its frames.

    Raises:
        VideoError: the lines fit the video in neither way, or name one frame twice.
    """
    listed = timestamps.frames[cam_id]
    by_frame = {index: sync for sync, index in listed.items()}
    if len(by_frame) < len(listed):
        problem = f"cam_id {cam_id} has one frame_index for two values of sync_index"
        raise VideoError(timestamps.path, "frame_index", problem, "Keep one of the lines")
    length = read_video_header(video).frames
    if not length or max(by_frame) < length:
        return by_frame
    if len(by_frame) == length:
        return {rank: by_frame[index] for rank, index in enumerate(sorted(by_frame))}
    problem = f"cam_id {cam_id} reaches frame {max(by_frame)} in {len(by_frame)} lines, but {video.name} "
    remedy = "Give the timestamps that were recorded with these videos"
    raise VideoError(timestamps.path, "frame_index", f"{problem}has {length} frames", remedy)
