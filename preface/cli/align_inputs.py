"""What an alignment starts from: the rig of every take, and the photographs that fit it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from preface.align.alignment_files import TEMPLATE_FILE
from preface.artifacts import ArtifactError
from preface.capture.images import read_header
from preface.capture.manifest import FILE_NAME, Capture, Subject
from preface.capture.rig import Rig, read_rig
from preface.cli.rig_files import rig_files
from preface.plain_words import suggestion

View = tuple[str, str]  # identity, camera


@dataclass(frozen=True)
class TakeRig:
    """A take's rig and where it was read."""

    path: Path
    rig: Rig


def rigs_of_takes(paths: Sequence[Path], takes: Sequence[str]) -> tuple[dict[str, TakeRig], list[str]]:
    """Read the rigs and give each take its own.

    Args:
        paths: rig files, or folders that hold them.
        takes: ids of the takes that need a rig.

    Returns:
        The rig of each of the takes, and notes for the user.

    Raises:
        ArtifactError: a path without a rig, two rigs of one take, or a take without a rig.
    """
    found: dict[str, TakeRig] = {}
    for path in (file for named in paths for file in rig_files(named)):
        rig = read_rig(path)
        if rig.take in found and found[rig.take].path.resolve() != path.resolve():
            problem = f"is a second rig of take '{rig.take}', beside {found[rig.take].path}"
            raise ArtifactError(path, "take", problem, "Name one rig per take")
        found[rig.take] = TakeRig(path, rig)
    if len(found) == len(takes) == 1 and takes[0] not in found:
        ((take, only),) = found.items()
        return {takes[0]: only}, [
            f"the rig of take '{take}' is used for the capture's only take, '{takes[0]}'"
        ]
    for take in takes:
        if take not in found:
            problem = f"none of the rigs is of take '{take}' (there are {', '.join(found)})"
            remedy = "Calibrate that take and name its rig too, or correct 'take' in the rig"
            raise ArtifactError(paths[0], "take", problem, remedy)
    return {take: found[take] for take in takes}, []


def chosen_subjects(capture: Capture, only: Sequence[str] | None) -> list[Subject]:
    """The people to align, in the manifest's order.

    Raises:
        ArtifactError: somebody that the capture does not know, or nobody at all.
    """
    subjects = list(capture.manifest.subjects)
    known = [subject.id for subject in subjects]
    manifest = capture.directory / FILE_NAME
    if not known:
        raise ArtifactError(
            manifest, "subjects", "there is nobody to align", "Add the people to the manifest"
        )
    for name in only or ():
        if name not in known:
            raise ArtifactError(manifest, "subjects", f"there is no '{name}'", suggestion(name, known))
    return [subject for subject in subjects if not only or subject.id in only]


def template_file(path: Path) -> Path:
    """The template that a path means: the file, or that of an alignment's or a prior's folder."""
    return path / TEMPLATE_FILE if path.is_dir() else path


def usable_photographs(
    capture: Capture, subjects: Sequence[Subject], rigs: Mapping[str, TakeRig]
) -> tuple[dict[View, Path], dict[View, str]]:
    """The photographs that can be used, and why the other views cannot.

    A view is left out when it is missing, unreadable, to be turned according to EXIF, of a camera that the
    rig lacks, or of another size than that camera's.

    Raises:
        ArtifactError: not one camera of a take is in its rig, or all photographs of a camera have another
            size than in the rig: then the rig is not of these photographs.
    """
    usable: dict[View, Path] = {}
    reasons: dict[View, str] = {}
    for subject in subjects:
        for camera in (camera.id for camera in capture.manifest.cameras):
            view, file = (subject.id, camera), capture.images.get((subject.id, camera))
            reason = _unusable(file, camera, rigs[subject.take])
            if reason is not None:
                reasons[view] = reason
            elif file is not None:
                usable[view] = file
    for take in dict.fromkeys(subject.take for subject in subjects):
        of_take = {subject.id for subject in subjects if subject.take == take}
        _check_take(capture, take, rigs[take], of_take, usable)
    return usable, reasons


def _unusable(file: Path | None, camera: str, rig: TakeRig) -> str | None:
    if file is None:
        return "there is no photograph"
    if camera not in rig.rig.cameras:
        return f"{rig.path.name} has no camera '{camera}'"
    try:
        header = read_header(file)
    except ArtifactError as error:
        return f"{error.problem}. {error.remedy}"
    lens = rig.rig.cameras[camera].camera
    if (header.width, header.height) != (lens.width, lens.height):
        return f"is {header.width}x{header.height}, but {rig.path.name} has {lens.width}x{lens.height}"
    return None


def _check_take(
    capture: Capture, take: str, rig: TakeRig, identities: set[str], usable: Mapping[View, Path]
) -> None:
    """Refuse a rig that is not of these photographs."""
    cameras = [camera.id for camera in capture.manifest.cameras]
    if not any(camera in rig.rig.cameras for camera in cameras):
        problem = (
            f"has none of the capture's cameras ({', '.join(cameras)}), but {', '.join(rig.rig.cameras)}"
        )
        raise ArtifactError(
            rig.path, "cameras", problem, "Name the rig of this capture, or rename its cameras"
        )
    for camera in cameras:
        if camera not in rig.rig.cameras or any((identity, camera) in usable for identity in identities):
            continue
        files = [file for (who, of), file in capture.images.items() if of == camera and who in identities]
        lens = rig.rig.cameras[camera].camera
        sizes = {size for file in files if (size := _readable_size(file)) is not None}
        if sizes and (lens.width, lens.height) not in sizes:
            found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
            problem = f"'{camera}' is {lens.width}x{lens.height} there, but its photographs are {found}"
            remedy = "Calibrate with images of the photographs' size, and export both alike"
            raise ArtifactError(rig.path, "cameras", problem, remedy)


def _readable_size(file: Path) -> tuple[int, int] | None:
    try:
        header = read_header(file)
    except ArtifactError:  # reported with the view
        return None
    return header.width, header.height
