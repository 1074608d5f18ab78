"""Worker processes: single-threaded each, told to stop between images, with errors that name the image."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.sharedctypes import SynchronizedArray
from multiprocessing.synchronize import Event

import cv2

from preface.artifacts import ArtifactError
from preface.cli.output import say
from preface.plain_words import counted, duration
from preface.progress import Progress
from synthetic_studio.config import StudioConfig, StudioError
from synthetic_studio.estimate import START
from synthetic_studio.tasks import Studio, Task

# One thread per worker: the workers fill the cores, and sums come out the same whatever their number.
SINGLE_THREADED = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
POLL_SECONDS = 0.2


@dataclass
class _Worker:
    """What a worker process keeps."""

    studio: Studio
    stop: Event
    finished: SynchronizedArray[float]  # images of all workers, and seconds that the cost model gives them


_worker: _Worker | None = None


def run_tasks(config: StudioConfig, subject_module: str, tasks: Sequence[Task]) -> None:
    """Run the tasks on `config.workers` processes, and tell how far they are.

    Raises:
        StudioError: a task failed, or a worker was killed; the other workers have then stopped.
        KeyboardInterrupt: after the workers have finished the images at hand.
    """
    if not tasks:
        return
    context = multiprocessing.get_context("spawn")
    stop, finished = context.Event(), context.Array("d", 2)
    workers = min(config.workers, len(tasks))
    images, seconds = sum(task.images for task in tasks), sum(task.seconds(config) for task in tasks)
    say(
        f"{counted(images, 'image', 'images')} to make with {counted(workers, 'worker', 'workers')}, "
        f"about {duration(START + seconds / workers)} by the studio's cost model"
    )
    with (
        _environment(SINGLE_THREADED),
        Progress(images, "images", seconds) as progress,
        ProcessPoolExecutor(workers, context, _start, (config, subject_module, stop, finished)) as pool,
    ):
        try:
            with _interrupts_deferred():  # the children inherit it: Ctrl-C is for the parent to handle
                futures = [pool.submit(_run, task) for task in tasks]
            _watch(futures, progress, finished)
        except BaseException:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _watch(futures: list[Future[None]], progress: Progress, finished: SynchronizedArray[float]) -> None:
    waiting = set(futures)
    images, seconds = 0, 0.0
    while waiting:
        done, waiting = wait(waiting, timeout=POLL_SECONDS)
        now_images, now_seconds = finished[:]
        progress.add(int(now_images) - images, now_seconds - seconds)
        images, seconds = int(now_images), now_seconds
        for future in done:
            try:
                future.result()
            except BrokenProcessPool as error:
                raise StudioError(
                    "a worker process was killed, most likely for want of memory; "
                    "use fewer --jobs and run the same command again to resume"
                ) from error


def _start(
    config: StudioConfig, subject_module: str, stop: Event, finished: SynchronizedArray[float]
) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _worker = _Worker(Studio(config, subject_module), stop, finished)


def _end_with_parent() -> None:
    """Leave when the main process is gone: killed outright, it cannot stop its workers. Files are atomic."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run(task: Task) -> None:
    assert _worker is not None
    for step in task.steps(_worker.studio):
        if _worker.stop.is_set():
            return
        try:
            step.work()
        except (ArtifactError, OSError, StudioError) as error:
            raise StudioError(f"{step.what}: {error}") from error
        except Exception as error:
            raise StudioError(f"{step.what}: {error}\n{traceback.format_exc()}") from error
        with _worker.finished.get_lock():
            _worker.finished[0] += step.images
            _worker.finished[1] += step.seconds


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupts_deferred() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)  # one that came meanwhile arrives now
