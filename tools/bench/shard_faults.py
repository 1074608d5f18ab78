"""Faults in a dataset of shards, in full: flips, truncations, kills, failing calls and full disks.

    python tools/bench/shard_faults.py [--flips 1000] [--kills 1000] [--folder DIR]

Builds a small dataset with both pixel orders, breaks it in every way, and prints a table: how often each fault
was made, how often it was found, and whether the build that followed gave the same bytes. Exits with 1 if a
single one was not. A few minutes to half an hour.
"""

from __future__ import annotations

import argparse
import errno
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from preface.artifacts import ArtifactError
from preface.cli.usage import Parser
from preface.shards import verify
from preface.shards.format import PAGE

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "shards"))
import small_heads  # type: ignore[import-not-found]

CALLS = ("pwrite", "fsync", "replace", "open")


def main() -> int:
    """Run everything and print the table."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flips", type=int, default=1000, help="flipped bits per pixel order")
    parser.add_argument("--kills", type=int, default=1000, help="builders that are killed")
    parser.add_argument("--points", type=int, default=50, help="points at which the disk is full")
    parser.add_argument("--folder", type=Path, help="where to work; a temporary folder by default")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    failed = 0
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        print(f"{'fault':<52}{'made':>8}{'as it should be':>18}")
        for order in ("raster", "permuted"):
            folder = Path(name) / order
            folder.mkdir()
            small_heads.write_dataset(folder, order)
            reference = contents(folder)
            runs: list[tuple[str, Iterator[bool]]] = [
                ("flipped bits, found by verify", flips(folder, arguments.flips, rng)),
                ("truncations at pages, found by verify", truncations(folder)),
            ]
            for call in CALLS:
                runs.append(
                    (f"n-th {call} fails, then finished", failing_calls(Path(name), order, call, reference))
                )
            runs.append(
                ("disk full, then finished", full_disks(Path(name), order, arguments.points, reference))
            )
            runs.append(
                ("kill -9, then finished", kills(Path(name), order, arguments.kills // 2, rng, reference))
            )
            for title, results in runs:
                outcomes = list(results)
                print(f"{order + ': ' + title:<52}{len(outcomes):>8}{sum(outcomes):>18}", flush=True)
                failed += len(outcomes) - sum(outcomes)
    print("all as they should be" if not failed else f"{failed} FAILED")
    return 1 if failed else 0


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def whole(folder: Path, reference: dict[str, bytes]) -> bool:
    """Whether every file that has its final name is whole."""
    return all(name.startswith(".") or data == reference[name] for name, data in contents(folder).items())


def flips(folder: Path, count: int, rng: np.random.Generator) -> Iterator[bool]:
    """Flip one bit after the other: a third each in the manifest, the headers, and anywhere in the shards."""
    shards = sorted(folder.glob("shard-*"))
    for number in range(count):
        path = folder / "manifest.json" if number % 3 == 0 else shards[rng.integers(len(shards))]
        original = path.read_bytes()
        data = bytearray(original)
        data[rng.integers(PAGE if number % 3 == 1 else len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        yield verify(folder) != []
        path.write_bytes(original)
    yield verify(folder) == []


def truncations(folder: Path) -> Iterator[bool]:
    """Cut each shard at each page, and the manifest at each of 50 places."""
    for path in sorted(folder.iterdir()):
        original = path.read_bytes()
        step = PAGE if path.name.startswith("shard") else max(1, len(original) // 50)
        for length in range(0, len(original), step):
            os.truncate(path, length)
            yield verify(folder) != []
            path.write_bytes(original)


def failing_calls(root: Path, order: str, call: str, reference: dict[str, bytes]) -> Iterator[bool]:
    """Let the first, second, ... call of a kind fail during a build, until none is left to fail."""
    real: Callable = getattr(os, call)
    nth, happened = 0, True
    while happened:
        nth += 1
        count, happened = 0, False

        def failing(*arguments: object, **options: object) -> object:
            nonlocal count, happened
            count += 1
            if count == nth:  # noqa: B023 - used within this turn only
                happened = True
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return real(*arguments, **options)

        with empty(root) as folder:
            setattr(os, call, failing)
            try:
                small_heads.write_dataset(folder, order)
                refused = False
            except ArtifactError:
                refused = True
            finally:
                setattr(os, call, real)
            yield refused == happened and finished(folder, order, reference)


def full_disks(root: Path, order: str, points: int, reference: dict[str, bytes]) -> Iterator[bool]:
    """Limit the size of files to many lengths, which refuses the write that goes beyond."""
    largest = max(len(data) for data in reference.values())
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    for limit in np.linspace(1, largest - 1, points).astype(int).tolist():
        with empty(root) as folder:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            try:
                small_heads.write_dataset(folder, order)
                refused = False
            except ArtifactError:
                refused = True
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            yield refused and finished(folder, order, reference)


def kills(
    root: Path, order: str, count: int, rng: np.random.Generator, reference: dict[str, bytes]
) -> Iterator[bool]:
    """Kill builders at random moments; every tenth time look whether the next one finishes to the byte.

    Builders are forked, so that a moment of a build and not of Python's start is hit.
    """
    with empty(root) as folder:
        start = time.perf_counter()
        small_heads.write_dataset(folder, order)
        duration = time.perf_counter() - start
    done = 0
    while done < count:
        with empty(root) as folder:
            for _ in range(min(10, count - done)):
                builder = os.fork()
                if builder == 0:
                    try:
                        small_heads.write_dataset(folder, order)
                    finally:
                        os._exit(0)
                time.sleep(rng.uniform(0, duration))
                os.kill(builder, signal.SIGKILL)
                os.waitpid(builder, 0)
                done += 1
                yield whole(folder, reference)
            yield finished(folder, order, reference)


def finished(folder: Path, order: str, reference: dict[str, bytes]) -> bool:
    """Whether everything is whole and a second run completes it to the byte."""
    if not whole(folder, reference):
        return False
    small_heads.write_dataset(folder, order)
    return contents(folder) == reference


@contextmanager
def empty(root: Path) -> Iterator[Path]:
    """An empty folder that is removed."""
    with tempfile.TemporaryDirectory(dir=root) as name:
        yield Path(name)


if __name__ == "__main__":
    sys.exit(main())
