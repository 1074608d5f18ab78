"""Files as shards need them: read without being surprised, written as a whole or not at all.

What is guaranteed about a file that somebody shortens while it is open:

- `ShardFile.read` uses pread: it raises, whatever happens and whenever.
- `ShardFile.map` maps the file, and touching a page that the file no longer has ends the process with SIGBUS.
  `check_size` compares the size with that at opening and is called before each use of the mapping, so that a
  shortened file raises, unless it is shortened within the microseconds between the check and the use. Where
  not even that may happen, read everything into memory (placement "ram" or "device").
"""

from __future__ import annotations

import contextlib
import mmap
import os
import secrets
from pathlib import Path
from types import TracebackType

import numpy as np

from preface.artifacts import ArtifactError, sync_directory

_CHANGED = "Build the shards again, or restore the file from a copy"


class ShardFile:
    """A file opened for reading, of a size that must not change.

    Args:
        path: the file.

    Raises:
        ArtifactError: it cannot be opened.
    """

    def __init__(self, path: Path):
        self.path = path
        self._mapping: mmap.mmap | None = None
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            self.size = os.fstat(self._descriptor).st_size
        except OSError as error:
            raise ArtifactError.from_os(path, "file", error) from error

    def check_size(self) -> None:
        """Raise ArtifactError if the file no longer has the size that it had."""
        size = os.fstat(self._descriptor).st_size
        if size != self.size:
            problem = f"had {self.size} bytes when it was opened and now has {size}"
            raise ArtifactError(self.path, "file", problem, _CHANGED)

    def read(self, begin: int, count: int) -> bytearray:
        """Read `count` bytes from byte `begin`.

        Raises:
            ArtifactError: the file ends before, or the disk fails.
        """
        data = bytearray(count)
        self.read_into(begin, memoryview(data))
        return data

    def read_into(self, begin: int, buffer: memoryview) -> None:
        """Fill a buffer of bytes from byte `begin`; raises as `read`."""
        done = 0
        try:
            while done < len(buffer):
                received = os.preadv(self._descriptor, [buffer[done:]], begin + done)
                if received == 0:
                    problem = f"ends at byte {begin + done}, and {begin + len(buffer)} are needed"
                    raise ArtifactError(self.path, "file", problem, _CHANGED)
                done += received
        except OSError as error:
            raise ArtifactError.from_os(self.path, "reading", error) from error

    def map(self, begin: int, count: int) -> np.ndarray:
        """Map bytes of the file, uint8 [count], read-only; see the header about files that shrink."""
        try:
            if self._mapping is None:
                self._mapping = mmap.mmap(self._descriptor, self.size, prot=mmap.PROT_READ)
        except (OSError, ValueError) as error:
            problem = f"cannot be mapped into memory ({error})"
            raise ArtifactError(self.path, "file", problem, 'Use placement "ram"') from error
        return np.frombuffer(self._mapping, dtype=np.uint8, count=count, offset=begin)

    def close(self) -> None:
        """Close the file. Arrays that map it stay readable and keep the mapping, without the check."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


class AtomicFile:
    """A file that appears under its name as a whole, on the disk, or not at all.

    Used as a context: leaving it normally forces the content to the disk, gives it the name, and forces that
    to the disk; an error removes what was written. A killed process leaves ``.<name>.<random>.tmp`` behind.

    Args:
        path: the file to write; its folder must exist.

    Raises:
        ArtifactError: on entering, in each method and on leaving, naming what the system refused.
    """

    def __init__(self, path: Path):
        self.path = path
        self._temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
        self._descriptor = -1

    def __enter__(self) -> AtomicFile:
        try:
            self._descriptor = os.open(
                self._temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666
            )
        except OSError as error:
            raise ArtifactError.from_os(self.path, "writing", error) from error
        return self

    def write(self, begin: int, data: bytes | np.ndarray) -> None:
        """Write bytes or a contiguous array at byte `begin`."""
        view = memoryview(data).cast("B")  # type: ignore[arg-type]
        done = 0
        try:
            while done < len(view):
                done += os.pwrite(self._descriptor, view[done:], begin + done)
        except OSError as error:
            raise ArtifactError.from_os(self.path, "writing", error) from error

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        named = False
        try:
            try:
                if kind is None:
                    os.fsync(self._descriptor)
            finally:
                os.close(self._descriptor)
            if kind is None:
                os.replace(self._temporary, self.path)  # noqa: PTH105 - one name for faults to be injected at
                named = True
                sync_directory(self.path.parent)
        except OSError as failure:
            raise ArtifactError.from_os(self.path, "writing", failure) from failure
        finally:
            if not named:
                with contextlib.suppress(OSError):  # a disk that fails may refuse this too
                    self._temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove what killed writers of a file left behind; the caller knows that no writer lives."""
    for leftover in path.parent.glob(f".{path.name}.*.tmp"):
        leftover.unlink(missing_ok=True)
