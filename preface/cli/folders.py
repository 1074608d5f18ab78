"""The folder a command writes to: known to be writable before anything takes time, made once there is a result."""

import errno
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from preface.artifacts import ArtifactError


def require_writable(folder: Path) -> None:
    """Refuse a folder that cannot be made or written to; leaves nothing behind.

    Only a file that is made says so for sure: permissions mean nothing to root, nor on some file systems.

    Raises:
        ArtifactError: naming what the operating system refused.
    """
    existing = folder.absolute()
    try:
        while not os.path.lexists(existing):
            existing = existing.parent
        if not existing.is_dir():
            raise OSError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise ArtifactError.from_os(folder, "writing", error) from error


def make_folder(folder: Path) -> Path:
    """Make a folder and those above it, unless they are there; returns it.

    Raises:
        ArtifactError: naming what the operating system refused.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArtifactError.from_os(error.filename or folder, "writing", error) from error
    return folder


def require_own(
    folder: Path, what: str, ours: Sequence[str], other: Callable[[Path], bool] = lambda entry: True
) -> None:
    """Refuse a folder that holds other things: what a command writes must neither get lost among them nor replace any.

    Hidden files and empty folders count as nothing.

    Args:
        folder: to write to; need not exist.
        what: a command writes, as "a prior" or "renders".
        ours: patterns of what it, or an interrupted run of it, leaves there; one of them is enough.
        other: which of the folder's entries there must not be.

    Raises:
        ArtifactError: there is such an entry and nothing of ours, or the folder cannot be read.
    """
    try:
        if not folder.is_dir() or any(any(folder.glob(pattern)) for pattern in ours):
            return
        found = [entry for entry in folder.iterdir() if not entry.name.startswith(".") and other(entry)]
        names = sorted(entry.name for entry in found if not entry.is_dir() or any(entry.iterdir()))
    except OSError as error:
        raise ArtifactError.from_os(folder, "reading", error) from error
    if names:
        some = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        problem = f"holds other things than {what} ({some})"
        raise ArtifactError(folder, "folder", problem, "Choose a new folder, or empty this one")
