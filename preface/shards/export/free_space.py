"""Whether a disk has room for what is about to be written, before the first byte of it is."""

from __future__ import annotations

import shutil
from pathlib import Path

from preface.artifacts import ArtifactError

_UNITS = ("bytes", "KB", "MB", "GB", "TB", "PB")


def human(count: int) -> str:
    """A number of bytes in decimal units, as disks are sold: 1234567 is 1.23 MB."""
    size, unit = float(count), 0
    while size >= 1000 and unit < len(_UNITS) - 1:
        size, unit = size / 1000, unit + 1
    return f"{count} bytes" if unit == 0 else f"{size:.3g} {_UNITS[unit]}"


def require_space(folder: Path, count: int) -> None:
    """Refuse to write more than the disk of a folder has room for.

    Args:
        folder: where it will be written; it need not exist yet.
        count: bytes.

    Raises:
        ArtifactError: the disk has less, or cannot be asked.
    """
    existing = folder.absolute()
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:
        free = shutil.disk_usage(existing).free
    except OSError as error:
        raise ArtifactError.from_os(folder, "free space", error) from error
    if count > free:
        problem = f"{human(count)} ({count} bytes) are to be written, and the disk has {human(free)} left"
        raise ArtifactError(
            folder, "free space", problem, "Choose fewer identities or views, or another disk"
        )
