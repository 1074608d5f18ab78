"""Running tasks: in this process, in a pool of processes, or on a Dask cluster; the same function everywhere."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import TYPE_CHECKING

from preface.artifacts import ArtifactError
from preface.shards.dataset.finishing import Runner
from preface.shards.dataset.plan import ShardTask
from preface.shards.dataset.tasks import TaskResult, run_task, use_one_thread

if TYPE_CHECKING:
    from distributed import Client

# What numerical libraries read when a process starts: processes are as many as cores.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def run_local(tasks: Sequence[ShardTask], jobs: int) -> Iterator[TaskResult]:
    """Run tasks in up to `jobs` processes; yields results as they come.

    Raises:
        ArtifactError: as `run_task`, or a process died.
    """
    if min(jobs, len(tasks)) <= 1:
        yield from map(run_task, tasks)
        return
    # The libraries' threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with _environment(_ONE_THREAD):
        pool = ProcessPoolExecutor(min(jobs, len(tasks)), context, use_one_thread)
        try:
            for future in as_completed([pool.submit(run_task, task) for task in tasks]):
                yield future.result()
        except BrokenProcessPool as error:
            problem = "a process died, most likely for want of memory"
            remedy = "Run again with fewer --jobs; what is finished is kept"
            raise ArtifactError(tasks[0].folder, "processes", problem, remedy) from error
        finally:
            pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def dask_cluster(address: str | None, jobs: int) -> Iterator[Runner]:
    """What runs tasks on a Dask cluster, as long as the context lasts.

    Its workers must see the capture and the dataset's folder under the tasks' paths.

    Args:
        address: of the cluster's scheduler, such as ``tcp://host:8786``; None starts a cluster on this machine.
        jobs: processes of a cluster on this machine.

    Raises:
        ArtifactError: Dask is not installed, or the cluster does not answer; of tasks, as `run_task`.
    """
    try:
        from distributed import Client
    except ImportError as error:
        problem = f"Dask is not installed ({error})"
        raise ArtifactError(
            "--scheduler", "dask", problem, 'Install it: pip install "preface[dask]"'
        ) from error
    try:
        client = (
            Client(address)
            if address
            else Client(n_workers=jobs, threads_per_worker=1, processes=True, dashboard_address=None)
        )
    except (OSError, ValueError) as error:
        problem = f"{address or 'a local cluster'} does not answer ({error})"
        raise ArtifactError(
            "--scheduler", "dask", problem, "Correct the address, or start the cluster"
        ) from error
    with client:
        yield partial(_run_dask, client)


def _run_dask(client: Client, tasks: Sequence[ShardTask]) -> Iterator[TaskResult]:
    from distributed import as_completed as completed

    # Tasks are pure in Dask's sense only as long as nobody touches the files: each call is its own.
    futures = client.map(run_task, list(tasks), pure=False, retries=1)
    for future in completed(futures):
        yield future.result()


@contextlib.contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Change the environment for processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
