"""Landmarks in all views of a capture, on all cores."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path

import numpy as np

from preface.align.face_search import find_landmarks
from preface.align.facemesh import FaceModels
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.artifacts import ArtifactError
from preface.capture.images import displayable, read_image
from preface.progress import Progress

View = tuple[str, str]  # subject, camera
Found = ViewLandmarks | NoFace
Read = Callable[[Path], np.ndarray]

AHEAD = 3  # tasks per worker that wait for it
FEW = 8  # images; starting processes for them would take longer


class LandmarkDetectionError(ArtifactError):
    """Landmarks that cannot be looked for."""


@dataclass(frozen=True)
class DetectionOptions:
    """How faces and their landmarks are found."""

    scale: int = 512
    """Faces are searched for in images reduced to this longer side; landmarks are placed in the full ones."""

    jitters: int = 8
    """Crops, each placed a little differently, whose mean is the result and whose spread its standard deviation."""

    rotations: tuple[float, ...] = (0.0, 180.0, 90.0, 270.0, 45.0, 315.0, 135.0, 225.0)
    """Degrees by which the image is turned, in this order, until a face is found."""

    landmark_model: Path | None = None
    """A face_landmarker.task file; by default the model shipped with mediapipe."""

    jobs: int = 0
    """Worker processes; 0 uses every core."""

    def __post_init__(self) -> None:
        if self.scale < 64 or self.jitters < 1 or not self.rotations or self.jobs < 0:
            raise ValueError(
                "scale must be at least 64, jitters 1, rotations not empty and jobs not negative"
            )


def detect_views(
    images: Mapping[View, Path],
    options: DetectionOptions | None = None,
    done: Callable[[View, Found], None] | None = None,
    read: Read = read_image,
) -> dict[View, Found]:
    """Find the subject's landmarks in every view.

    A photograph that cannot be read is a view without a face, and its reason says why.

    Args:
        images: (subject, camera) to the photograph.
        options: how.
        done: called in this process with each view as soon as it is done, in any order.
        read: gives the pixels of a photograph, a function of a module, as it goes to other processes.

    Returns:
        (subject, camera) to the landmarks, or to why there are none, in the order of ``images``; the result does
        not depend on the number of processes.

    Raises:
        FaceModelError: mediapipe or the landmark model cannot be used.
        LandmarkDetectionError: a worker process died.
    """
    options = options or DetectionOptions()
    found: dict[View, Found] = {}
    with Progress(len(images), "images searched for faces") as progress:
        for view, result in _run(images, options, read):
            found[view] = result
            progress.add(1)
            if done is not None:
                done(view, result)
    return {view: found[view] for view in images}


def _run(images: Mapping[View, Path], options: DetectionOptions, read: Read) -> Iterator[tuple[View, Found]]:
    workers = min(options.jobs or len(os.sched_getaffinity(0)), max(len(images), 1))
    if workers == 1 or (len(images) <= FEW and not options.jobs):
        detector = _Detector(options, read)
        yield from starmap(detector, images.items())
        return
    # MediaPipe's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _start_worker)
    try:
        waiting: set[Future[tuple[View, Found]]] = set()
        for view, path in images.items():
            waiting.add(pool.submit(_detect, options, read, view, path))
            if len(waiting) >= AHEAD * workers:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
    except BrokenProcessPool as error:
        problem = "a worker process died, most likely for want of memory"
        raise LandmarkDetectionError("workers", "process", problem, "Run with fewer --jobs") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    import cv2

    cv2.setNumThreads(1)  # the processes are as many as the cores


class _Detector:
    """The models of one process, and how to use them."""

    def __init__(self, options: DetectionOptions, read: Read):
        self.options = options
        self.read = read
        self.models = FaceModels(options.landmark_model)

    def __call__(self, view: View, path: Path) -> tuple[View, Found]:
        try:
            image = displayable(self.read(path))
        except ArtifactError as error:
            return view, NoFace(f"{error.field}: {error.problem}. {error.remedy}")
        chosen = self.options
        return view, find_landmarks(image, self.models, chosen.scale, chosen.rotations, chosen.jitters)


_detector: _Detector | None = None  # of this worker process, made with its first task


def _detect(options: DetectionOptions, read: Read, view: View, path: Path) -> tuple[View, Found]:
    global _detector
    if _detector is None or (_detector.options, _detector.read) != (options, read):
        _detector = _Detector(options, read)
    return _detector(view, path)
