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
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event

import cv2
from tqdm import tqdm

from preface.artifacts import ArtifactError
from synthetic_studio.config import StudioConfig, StudioError
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
    finished_images: Synchronized[int]


_worker: _Worker | None = None


def run_tasks(config: StudioConfig, subject_module: str, tasks: Sequence[Task]) -> None:
    """Run the tasks on `config.workers` processes, with a progress bar when there is a terminal.

    Raises:
        StudioError: a task failed, or a worker was killed; the other workers have then stopped.
        KeyboardInterrupt: after the workers have finished the images at hand.
    """
    total = sum(task.images for task in tasks)
    if not tasks:
        return
    context = multiprocessing.get_context("spawn")
    stop, finished = context.Event(), context.Value("q", 0)
    workers = min(config.workers, len(tasks))
    with (
        _environment(SINGLE_THREADED),
        tqdm(total=total, unit="image", disable=None, smoothing=0.05) as bar,
        ProcessPoolExecutor(workers, context, _start, (config, subject_module, stop, finished)) as pool,
    ):
        try:
            with _interrupts_deferred():  # the children inherit it: Ctrl-C is for the parent to handle
                futures = [pool.submit(_run, task) for task in tasks]
            _watch(futures, bar, finished)
        except BaseException:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _watch(futures: list[Future[None]], bar: tqdm, finished: Synchronized[int]) -> None:
    waiting = set(futures)
    while waiting:
        done, waiting = wait(waiting, timeout=POLL_SECONDS)
        bar.update(finished.value - bar.n)
        for future in done:
            try:
                future.result()
            except BrokenProcessPool as error:
                raise StudioError(
                    "a worker process was killed, most likely for want of memory; "
                    "use fewer --jobs and run the same command again to resume"
                ) from error


def _start(config: StudioConfig, subject_module: str, stop: Event, finished: Synchronized[int]) -> None:
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
        with _worker.finished_images.get_lock():
            _worker.finished_images.value += step.images


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
