"""The images behind detected corners, for reports that show them."""

import re
from collections.abc import Callable

import numpy as np

from preface.capture.calibration_files import CalibrationTake, is_video
from preface.capture.corners import Corners
from preface.capture.images import displayable, read_image
from preface.capture.video import assign_cameras, frames_of_video, read_frames, read_timestamps


def image_loader(take: CalibrationTake, corners: Corners) -> Callable[[str, str], np.ndarray | None]:
    """A function from (camera id, frame id) to the image in which `corners` has them.

    It returns uint8 [height, width, 3] as one looks at it, or None where the corners do not name a file, or one
    that is no more. It raises ArtifactError for a file that cannot be read.
    """

    def load(camera: str, frame: str) -> np.ndarray | None:
        name = corners.files.get((camera, frame))
        path = take.folder / name if name else None
        if path is None or not path.is_file():
            return None
        if is_video((path,)):
            index = _frame_index(take, camera, frame)
            return None if index is None else next((image for _, image in read_frames(path, [index])), None)
        return displayable(read_image(path))

    return load


def _frame_index(take: CalibrationTake, camera: str, frame: str) -> int | None:
    """Which frame of a camera's video is called so; `detection` names them by instant, or else by number."""
    if not re.fullmatch(r"\d+", frame):
        return None
    if take.timestamps is None:
        return int(frame)
    times = read_timestamps(take.timestamps)
    videos = {name: files[0] for name, files in take.cameras.items() if is_video(files)}
    numbers = assign_cameras(times, list(videos))
    by_index = frames_of_video(times, numbers[camera], videos[camera])
    return next((index for index, sync in by_index.items() if sync == int(frame)), None)
