"""Detecting a board in all images of a take, on all cores.

Videos are decoded by this process, a few frames ahead of the workers; images are decoded by the workers.
What goes wrong with single files is collected and reported; only what makes the result useless is an error.
"""

import hashlib
import multiprocessing
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.boards import board_in_words, board_points
from preface.capture.calibration_files import CalibrationTake, is_video
from preface.capture.corners import Corners, Unseen
from preface.capture.explain import explain
from preface.capture.finding import SEARCH_SIDE, Sighting, find_board, looks_the_same_upside_down
from preface.capture.images import read_header, read_image
from preface.capture.manifest import Board
from preface.capture.observations import Observations
from preface.capture.video import (
    Timestamps,
    assign_cameras,
    frames_of_video,
    read_frames,
    read_timestamps,
    read_video_header,
)
from preface.progress import Progress

LISTED = 5  # names in a sentence before "and N more"
AHEAD = 3  # tasks per worker that wait for it; bounds the frames in memory
FEW = 8  # images; starting processes for them would take longer
EXPLAINED = 3  # images that are looked at again to say why a camera sees no board


class DetectionError(ArtifactError):
    """A take whose images give no usable corners."""


@dataclass(frozen=True)
class DetectionOptions:
    """How to detect."""

    search_side: int = SEARCH_SIDE
    """Boards are searched for in images reduced to this longer side; corners are refined in the full ones."""

    every: int = 1
    """Take every n-th frame of a video without timestamps."""

    jobs: int = 0
    """Worker processes; 0 uses every core."""


@dataclass(frozen=True)
class _Task:
    camera: str
    frame: str
    source: Path
    index: int | None = None  # of a frame in a video
    image: np.ndarray | None = None  # that frame; images are decoded by the worker


@dataclass(frozen=True)
class _Result:
    camera: str
    frame: str
    source: Path
    index: int | None
    size: tuple[int, int] = (0, 0)
    digest: bytes = b""
    sighting: Sighting = field(default_factory=Sighting)
    problem: ArtifactError | None = None


def detect_corners(take: CalibrationTake, board: Board, options: DetectionOptions | None = None) -> Corners:
    """Detect a board in every image of a take.

    Args:
        take: the cameras' files.
        board: its description.
        options: how.

    Returns:
        The corners, with warnings about files that cannot be read, duplicates, mirrored footage and cameras
        that never see the board. Such a camera is kept, without observations.

    Raises:
        DetectionError: nothing can be read, the images of a camera differ in size, or no camera sees the board.
        ArtifactError: timestamps that do not fit the videos.
    """
    options = options or DetectionOptions()
    _check_sizes(take)
    plan = _Plan.of(take, options)
    results = sorted(
        _run(plan.tasks(), plan.count, board, options), key=lambda r: (r.camera, _natural(r.frame))
    )
    return _assemble(take, board, results, plan.warnings)


# ------------------------------------------------------------------------------------------- tasks


@dataclass(frozen=True)
class _Plan:
    """The work to do: images of cameras, frames of videos."""

    images: tuple[tuple[str, Path], ...]
    videos: tuple[tuple[str, Path, dict[int, str] | None], ...]
    count: int
    every: int
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, take: CalibrationTake, options: DetectionOptions) -> "_Plan":
        images = [(c, f) for c, files in take.cameras.items() if not is_video(files) for f in files]
        videos = {camera: files[0] for camera, files in take.cameras.items() if is_video(files)}
        frames: dict[str, dict[int, str] | None] = dict.fromkeys(videos)
        warnings: list[str] = []
        if take.timestamps is not None and videos:
            times = read_timestamps(take.timestamps)
            numbers = assign_cameras(times, list(videos))
            warnings += _leftover(times, set(numbers.values()))
            for camera, number in numbers.items():
                synced = frames_of_video(times, number, videos[camera])
                frames[camera] = {index: f"{sync:06d}" for index, sync in synced.items()}
        elif len(videos) > 1:
            warnings.append(
                "There is no timestamps.csv: frames of the same number are taken to be of one instant, which "
                "holds for cameras that were triggered together only."
            )
        count = len(images)
        for camera, video in videos.items():
            listed = frames[camera]
            length = read_video_header(video).frames
            count += len(listed) if listed is not None else -(-length // options.every)
        chosen = tuple((camera, video, frames[camera]) for camera, video in videos.items())
        return cls(tuple(images), chosen, count, options.every, tuple(warnings))

    def tasks(self) -> Iterator[_Task]:
        for camera, path in self.images:
            yield _Task(camera, path.stem, path)
        for camera, video, frames in self.videos:
            for index, image in read_frames(video, None if frames is None else list(frames), self.every):
                yield _Task(camera, f"{index:06d}" if frames is None else frames[index], video, index, image)


def _leftover(times: Timestamps, used: set[int]) -> list[str]:
    unused = sorted(set(times.frames) - used)
    return (
        [f"{times.path} lists cam_id {_names(map(str, unused))}, but there is no such video."]
        if unused
        else []
    )


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts frame9 before frame10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name) if part]


# ----------------------------------------------------------------------------------------- workers


def _run(tasks: Iterable[_Task], count: int, board: Board, options: DetectionOptions) -> Iterator[_Result]:
    workers = min(options.jobs or len(os.sched_getaffinity(0)), max(count, 1))
    with Progress(count, "images searched for the board") as progress:
        if workers == 1 or (count <= FEW and not options.jobs):
            for task in tasks:
                yield _detect(task, board, options.search_side)
                progress.add(1)
            return
        # Forking a process that runs OpenCV's threads can deadlock.
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, context, _start_worker)
        try:
            waiting: set[Future[_Result]] = set()
            for task in tasks:
                waiting.add(pool.submit(_detect, task, board, options.search_side))
                if len(waiting) >= AHEAD * workers:
                    done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    for future in done:
                        yield future.result()
                        progress.add(1)
            while waiting:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
                    progress.add(1)
        except BrokenProcessPool as error:
            problem = "a worker process died, most likely for want of memory"
            raise DetectionError("workers", "process", problem, "Run with fewer --jobs") from error
        finally:
            pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    import cv2

    cv2.setNumThreads(1)  # the processes are as many as the cores


def _detect(task: _Task, board: Board, search_side: int) -> _Result:
    import cv2

    image = task.image
    try:
        if image is None:
            image = read_image(task.source)
    except ArtifactError as error:
        return _Result(task.camera, task.frame, task.source, task.index, problem=error)
    cv2.setRNGSeed(0)  # the result depends on the image alone
    size = (image.shape[1], image.shape[0])
    digest = hashlib.blake2b(np.ascontiguousarray(image).data, digest_size=16).digest()
    sighting = find_board(board, image, search_side)
    return _Result(task.camera, task.frame, task.source, task.index, size, digest, sighting)


# ---------------------------------------------------------------------------------------- assembly


def _assemble(
    take: CalibrationTake,
    board: Board,
    results: list[_Result],
    warnings: tuple[str, ...],
) -> Corners:
    said = [*warnings, *_unreadable(take, results), *_symmetric(board)]
    sizes = {r.camera: r.size for r in results if r.problem is None}
    duplicates, sentences = _duplicates(results)
    said += sentences
    seen = [r for r in results if len(r.sighting.points) and r not in duplicates]
    said += _views_in_words(take, board, results, bool(seen))
    unseen = [
        Unseen(r.camera, r.frame, "shows the same as another image" if r in duplicates else _reason(r))
        for r in results
        if r in duplicates or not len(r.sighting.points)
    ]
    frames = sorted({r.frame for r in results}, key=_natural)
    cameras = [camera for camera in take.cameras if camera in sizes]
    said += _unshared(cameras, seen)
    counts = [len(r.sighting.points) for r in seen]
    observations = Observations(
        camera_ids=tuple(cameras),
        image_sizes=tuple(sizes[camera] for camera in cameras),
        frame_ids=tuple(frames),
        board_points=board_points(board),
        camera=np.repeat(np.array([cameras.index(r.camera) for r in seen], np.int32), counts),
        frame=np.repeat(np.array([frames.index(r.frame) for r in seen], np.int32), counts),
        point=np.concatenate([*(r.sighting.points for r in seen), np.empty(0, np.int32)]),
        pixels=np.concatenate([*(r.sighting.pixels for r in seen), np.empty((0, 2))]),
    )
    files = {(r.camera, r.frame): _relative(r.source, take.folder) for r in seen}
    return Corners(take.id, observations, board, files, tuple(unseen), tuple(said))


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def _reason(result: _Result) -> str:
    if result.problem is not None:
        return f"{result.problem.field}: {result.problem.problem}"
    sighting = result.sighting
    if sighting.mirrored:
        return "the board is seen in a mirror"
    if sighting.contradictory:
        return "the markers do not lie where the description has them"
    if sighting.rejected:
        return f"none of {sighting.rejected} corners is sharp enough"
    return f"{sighting.markers} markers, too few for a corner" if sighting.markers else "no board found"


def _names(names: Iterable[str]) -> str:
    listed = list(names)
    more = f" and {len(listed) - LISTED} more" if len(listed) > LISTED else ""
    return ", ".join(listed[:LISTED]) + more


def _unreadable(take: CalibrationTake, results: list[_Result]) -> list[str]:
    problems = [r.problem for r in results if r.problem is not None]
    if not results or len(problems) == len(results):
        if problems:
            raise problems[0]
        raise DetectionError(take.folder, "files", "no camera has a picture", "Add pictures of the board")
    return [f"Left out: {problem}" for problem in problems]


def _symmetric(board: Board) -> list[str]:
    if not looks_the_same_upside_down(board):
        return []
    return [
        f"A {board_in_words(board)} looks the same upside down: it must stand upright in all images, "
        "and a board with one odd and one even number would not need to."
    ]


def _check_sizes(take: CalibrationTake) -> None:
    """Refuse a camera whose images differ in size, before the work begins."""
    for camera, files in take.cameras.items():
        first: tuple[Path, int, int] | None = None
        for file in () if is_video(files) else files:
            try:
                header = read_header(file)
            except ArtifactError:  # reported when the image is decoded
                continue
            path, width, height = first = first or (file, header.width, header.height)
            if (header.width, header.height) != (width, height):
                problem = f"{path} is {width}x{height}, but {file} is {header.width}x{header.height}"
                remedy = "A camera has one resolution: move the images of another one to a camera of its own"
                raise DetectionError(take.folder / camera, "resolution", problem, remedy)


def _duplicates(results: list[_Result]) -> tuple[list[_Result], list[str]]:
    """Results whose image is the same as an earlier one's, and sentences that name them."""
    groups: dict[bytes, list[_Result]] = defaultdict(list)
    for result in results:
        if len(result.sighting.points):
            groups[result.digest].append(result)
    repeated = [group for group in groups.values() if len(group) > 1]
    sentences = [
        f"{len(group)} images are identical, and all but the first are left out: "
        f"{_names(f'{r.camera}/{r.frame}' for r in group)}."
        for group in repeated[:LISTED]
    ]
    if len(repeated) > LISTED:
        sentences.append(f"{len(repeated) - LISTED} more groups of identical images; see 'unseen'.")
    return [result for group in repeated for result in group[1:]], sentences


def _unshared(cameras: list[str], seen: list[_Result]) -> list[str]:
    """A warning when the cameras' images have no name in common."""
    frames = defaultdict(set)
    for result in seen:
        frames[result.frame].add(result.camera)
    if len({r.camera for r in seen}) < 2 or any(len(group) > 1 for group in frames.values()):
        return []
    example = ", ".join(f"{c}/{next(r.frame for r in seen if r.camera == c)}" for c in cameras[:2])
    return [f"No frame is seen by two cameras ({example}): images of one instant need the same file name."]


def _views_in_words(take: CalibrationTake, board: Board, results: list[_Result], any_seen: bool) -> list[str]:
    """Sentences about cameras that do not see the board; an error when none does."""
    sentences: list[str] = []
    reasons: list[str] = []
    for camera in take.cameras:
        ours = [r for r in results if r.camera == camera and r.problem is None]
        mirrored = sum(r.sighting.mirrored for r in ours)
        contradictory = sum(r.sighting.contradictory for r in ours)
        if mirrored:
            sentences.append(
                f"Camera '{camera}': {mirrored} of {len(ours)} images show the board mirrored, and are left out. "
                "Flip them, and the photographs of this camera alike (ffmpeg -vf hflip, or mogrify -flop)."
            )
        elif not any(len(r.sighting.points) for r in ours):
            # To explain takes seconds; the first cameras tell enough.
            reason = explain(board, _examples(ours)) if ours and len(reasons) < EXPLAINED else "not examined"
            reasons.append(reason)
            sentences.append(f"Camera '{camera}' never sees the board in {len(ours)} images: {reason}.")
        elif contradictory > len(ours) / 4:
            sentences.append(
                f"Camera '{camera}': in {contradictory} of {len(ours)} images the markers do not lie where the "
                "description has them."
            )
    if not any_seen:
        why = "; ".join(dict.fromkeys(r for r in reasons if r != "not examined"))
        problem = f"no camera sees the board: {why or 'the footage is mirrored'}"
        remedy = "Correct the description of the board, or the pictures" if why else " ".join(sentences)
        raise DetectionError(take.folder, "board", problem, remedy.rstrip("."))
    return sentences


def _examples(results: list[_Result]) -> list[np.ndarray]:
    """The images that are most likely to show a board: with most markers, else spread over the take."""
    spread = [results[i] for i in np.unique(np.linspace(0, len(results) - 1, EXPLAINED).astype(int))]
    by_markers = sorted(results, key=lambda r: -r.sighting.markers)[:EXPLAINED]
    chosen = by_markers if by_markers[0].sighting.markers else spread
    return [image for result in chosen if (image := _again(result)) is not None]


def _again(result: _Result) -> np.ndarray | None:
    """The image of a result, decoded once more."""
    if result.index is None:
        return read_image(result.source)
    return next((image for _, image in read_frames(result.source, [result.index])), None)
