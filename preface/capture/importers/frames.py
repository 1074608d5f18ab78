"""A frame of a foreign dataset: one instant of one person, what of it can be used, and why the rest cannot."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal

from preface.artifacts import ArtifactError
from preface.capture.folders import folders
from preface.capture.images import read_header
from preface.capture.rig import RigCamera
from preface.plain_words import shown

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_MAX_NAME = 100  # of a subject, as data_specs/capture.schema.json has it


@dataclass(frozen=True)
class ImportOptions:
    """How a dataset is imported.

    Attributes:
        link: "hard" to link the images, "copy" to copy them.
        patterns: of PERSON/FRAME, as a shell has them; a frame is imported that matches one.
        metres_per_unit: length of the dataset's unit, where `registrations` does not say it.
        registrations: FaceScape's Rt_scale_dict.json, if there is one.
        strict: whether the first view that cannot be used ends the import.
    """

    link: Literal["hard", "copy"] = "hard"
    patterns: tuple[str, ...] = ("*",)
    metres_per_unit: float = 1.0
    registrations: Path | None = None
    strict: bool = False


@dataclass(frozen=True)
class LeftOut:
    """A frame or view that is not imported: PERSON/FRAME or PERSON/FRAME/CAMERA, and why."""

    place: str
    error: ArtifactError

    def __str__(self) -> str:
        return f"{self.place}: {self.error.problem}. {self.error.remedy}"


@dataclass
class Frame:
    """One instant of one person.

    Attributes:
        person, name: the folders' names.
        cameras: id to lens and pose, of all cameras that can be read, in the dataset's world and unit.
        images: camera id to the photograph, of views that can be used: with a camera of the same size.
        masks: camera id to the foreground mask, of those.
        camera_files: what the cameras were read from.
        left_out: what cannot be used.
    """

    person: str
    name: str
    cameras: dict[str, RigCamera] = field(default_factory=dict)
    images: dict[str, Path] = field(default_factory=dict)
    masks: dict[str, Path] = field(default_factory=dict)
    camera_files: list[Path] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)

    @property
    def place(self) -> str:
        """PERSON/FRAME."""
        return f"{self.person}/{self.name}"

    @property
    def identity(self) -> str:
        """The subject's name in the capture."""
        return f"{self.person}-{self.name}"

    def leave_out(self, error: ArtifactError, view: str | None = None) -> None:
        """Note why the frame or one of its views cannot be used."""
        self.left_out.append(LeftOut(self.place if view is None else f"{self.place}/{view}", error))


def frame_folders(
    source: Path, patterns: Sequence[str], is_frame: Callable[[Path], bool]
) -> Iterator[tuple[Frame, Path]]:
    """Find the frames of SOURCE/PERSON/FRAME, in the order of their names.

    Folders like ``00000-00099``, which hold people by the hundred, are looked into.

    Args:
        source: folder of the dataset.
        patterns: of PERSON/FRAME.
        is_frame: whether a folder is one; others are not looked at.

    Yields:
        An empty frame and its folder. A frame whose name cannot be a subject's is left out there.
    """
    for person in _people(source):
        for name in sorted(folders(person), key=_natural):
            frame, folder = Frame(person.name, name), person / name
            if not any(fnmatchcase(frame.place, pattern) for pattern in patterns) or not is_frame(folder):
                continue
            if not (_NAME.fullmatch(frame.identity) and len(frame.identity) <= _MAX_NAME):
                problem = f"{shown(frame.place)} cannot become a name of letters, digits, '.', '_' and '-'"
                frame.leave_out(ArtifactError(folder, "name", problem, "Rename the folder"))
            yield frame, folder


def _people(source: Path) -> Iterator[Path]:
    for name in sorted(folders(source), key=_natural):
        if re.fullmatch(r"\d+-\d+", name):
            yield from (source / name / person for person in sorted(folders(source / name), key=_natural))
        else:
            yield source / name


def _natural(name: str) -> list[tuple[int, int | str]]:
    """Sorts 2 before 10."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.findall(r"\d+|\D+", name)]


def require_inside(source: Path, file: Path) -> None:
    """Refuse a file that is not there, or that symbolic links lead to outside the dataset.

    Raises:
        ArtifactError: saying which.
    """
    if not file.is_file():
        raise ArtifactError(file, "file", "does not exist", "Download it again, or unpack the whole archive")
    if not file.resolve().is_relative_to(source.resolve()):
        problem = "is a symbolic link that leads out of the dataset"
        raise ArtifactError(file, "file", problem, "Name the folder that holds the files themselves")


def add_view(source: Path, frame: Frame, view: str, camera: str, image: Path, mask: Path | None) -> None:
    """Add a view whose camera is known, or note why it cannot be used.

    Args:
        source: the dataset.
        frame: to add it to.
        view: what the dataset calls it.
        camera: its camera's id.
        image, mask: its files; no mask if there is none.
    """
    lens = frame.cameras[camera].camera
    try:
        for file in (image,) if mask is None else (image, mask):
            require_inside(source, file)
            header = read_header(file)
            if (header.width, header.height) != (lens.width, lens.height):
                problem = (
                    f"{file.parent.name}/{file.name} is {header.width}x{header.height}, and its camera is "
                    f"{lens.width}x{lens.height}"
                )
                raise ArtifactError(file, "size", problem, "Restore the file, or correct the camera's size")
    except ArtifactError as error:
        frame.leave_out(error, view)
        return
    frame.images[camera] = image
    if mask is not None:
        frame.masks[camera] = mask


def single(folder: Path, names: Mapping[str, Sequence[str]], stem: str) -> Path:
    """The one image of a name in a folder, given the folder's images by stem.

    Raises:
        ArtifactError: there is none, or several.
    """
    found = names.get(stem, ())
    if len(found) != 1:
        problem = f"has {len(found)} images of '{stem}'{': ' if found else ''}{', '.join(found)}"
        remedy = "Keep one of them" if found else "Download the frame again, or unpack the whole archive"
        raise ArtifactError(folder, "images", problem, remedy)
    return folder / found[0]
