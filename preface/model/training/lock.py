"""One run per folder: two would write one checkpoint over the other's."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from preface.artifacts import ArtifactError

LOCK_FILE = ".run.lock"


@contextlib.contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the hold ends with the process, however it ends.

    On a file system without locks nothing is held.

    Raises:
        ArtifactError: another process holds it, or the folder does not allow a file.
    """
    path = folder / LOCK_FILE
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise ArtifactError.from_os(path, "writing", error) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(descriptor, 64, 0).decode(errors="replace").strip() or "another"
            problem = f"process {holder} is training into this folder"
            raise ArtifactError(folder, "lock", problem, "Wait for it, or choose another --output") from error
        except OSError:  # no locks here
            yield
            return
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)
