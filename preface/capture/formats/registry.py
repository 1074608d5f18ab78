"""All formats by name, and which of them a file is."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from preface.artifacts import ArtifactError
from preface.capture.formats import (
    anipose,
    cafca,
    caliscope,
    colmap,
    facescape,
    mrcal,
    nerfstudio,
    nersemble,
    opencv,
)
from preface.capture.formats.format import Format
from preface.capture.rig import Rig
from preface.plain_words import suggestion

FORMATS: dict[str, Format] = {
    format.name: format
    for format in (
        colmap.TEXT,
        colmap.BINARY,
        nerfstudio.FORMAT,
        opencv.FORMAT,
        anipose.FORMAT,
        caliscope.FORMAT,
        facescape.FORMAT,
        mrcal.FORMAT,
        cafca.FORMAT,
        nersemble.FORMAT,
    )
}
# The take of an imported rig: what a capture without a manifest calls its only one.
TAKE = "default"


def read_rig_from(source: str | os.PathLike[str], format: str | None = None) -> Rig:
    """Read a rig that another program wrote.

    Args:
        source: a file or folder.
        format: a name in `FORMATS`; None to find out.

    Returns:
        A rig of take ``default`` without statistics. Its metadata say the format, and what was assumed
        where the format's conventions are not documented. Lengths are taken as metres: no format here
        says its unit.

    Raises:
        ArtifactError: no such file, not of the format or of none that is known, or impossible cameras.
    """
    path = Path(source)
    with _os_errors(path):
        if not path.exists():
            raise ArtifactError(path, "file", "does not exist", "Correct the path")
        chosen = _detected(path) if format is None else _named(path, format)
        cameras = chosen.read(chosen.locate(path))
    imported = {"format": chosen.name, "assumptions": list(chosen.assumptions)}
    return Rig(take=TAKE, cameras=cameras, metadata={"imported": imported})


def export_rig(rig: Rig, destination: str | os.PathLike[str], format: str) -> Path:
    """Write lenses and poses of a rig for another program.

    Lenses and translations read back bit for bit, rotations to 1e-15 (1e-12 where the format has rotation
    vectors); lenses may come back under the simplest model that holds them, and cameras in the order of
    their names from formats that are folders of files. Statistics are not written: no format here has a
    place for them.

    Args:
        rig: with at least one camera.
        destination: a file; for colmap-text, colmap-binary, mrcal and cafca a folder that is empty or does
            not exist. A folder stands for the file of the format's usual name in it.
        format: a name in `FORMATS`.

    Returns:
        The file or folder that was written.

    Raises:
        ArtifactError: the format cannot hold a camera as it is, or the disk refuses.
    """
    path = Path(destination)
    chosen = _named(path, format)
    if not rig.cameras:
        raise ArtifactError(path, "cameras", "the rig has none", "Give a rig with cameras")
    with _os_errors(path):
        if chosen.file_name and path.is_dir():
            path = path / chosen.file_name
        return chosen.write(path, rig.cameras)


def detect(source: str | os.PathLike[str]) -> str:
    """The name of the format of a file or folder.

    Raises:
        ArtifactError: it is of none, or of several; the message says what was tried.
    """
    with _os_errors(Path(source)):
        return _detected(Path(source)).name


@contextlib.contextmanager
def _os_errors(path: Path) -> Iterator[None]:
    """Name the path in what the operating system refuses, such as looking into a folder."""
    try:
        yield
    except OSError as error:
        raise ArtifactError.from_os(path, "file", error) from error


def _detected(path: Path) -> Format:
    found: list[Format] = []
    tried: dict[str, list[str]] = {}  # by reason
    for format in FORMATS.values():
        try:
            reason = format.mismatch(format.locate(path))
        except ArtifactError as error:
            reason = f"{error.field}: {error.problem}"
        if reason is None:
            found.append(format)
        else:
            tried.setdefault(reason, []).append(format.name)
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(format.name for format in found)
        raise ArtifactError(path, "format", f"it can be read as {names}", "Say which of them it is")
    reasons = "; ".join(f"{', '.join(names)}: {reason}" for reason, names in tried.items())
    problem = f"is of no known format ({reasons})"
    raise ArtifactError(path, "format", problem, "Check that this is the right file, or name its format")


def _named(path: Path, name: str) -> Format:
    if name not in FORMATS:
        raise ArtifactError(path, "format", f"'{name}' is not a known format", suggestion(name, FORMATS))
    return FORMATS[name]
