"""Cafca's synthetic dataset (syntec-research/Cafca, Dataset.md), or one that lies like it.

    SUBJECT/EXP_ENV/cameras_json/C00.json ...       OpenCV axes, see `preface.capture.formats.cafca`
    SUBJECT/EXP_ENV/color_image/C00.png ...
    SUBJECT/EXP_ENV/foreground_mask/C00.png ...     8 bits; a frame without the folder has no masks
    SUBJECT/EXP_ENV/segmentation/C00.png ...        not imported: a capture has no regions

The dataset has 30 views per frame; a frame may have any number here, but a camera without an image, an image
without a camera, and a mask that is missing among others are reported, each with its view.
"""

from collections.abc import Iterator
from pathlib import Path

from preface.artifacts import ArtifactError
from preface.capture.folders import files, images_by_stem
from preface.capture.formats import cafca
from preface.capture.importers.frames import (
    Frame,
    ImportOptions,
    add_view,
    frame_folders,
    require_inside,
    single,
)

SHAPE = "SUBJECT/EXP_ENV/{cameras_json,color_image,foreground_mask}/C00.{json,png}"
ASSUMPTIONS = (*cafca.FORMAT.assumptions, "the unit of length is the metre: Cafca does not document it")
_CAMERAS, _IMAGES, _MASKS = "cameras_json", "color_image", "foreground_mask"


def frames(source: Path, options: ImportOptions) -> Iterator[Frame]:
    """Read the frames of a dataset; see `Frame`."""
    for frame, folder in frame_folders(source, options.patterns, _is_frame):
        if not frame.left_out:
            _read(source, folder, frame)
        yield frame


def _is_frame(folder: Path) -> bool:
    return (folder / _CAMERAS).is_dir() or (folder / _IMAGES).is_dir()


def _read(source: Path, folder: Path, frame: Frame) -> None:
    images, masks = images_by_stem(folder / _IMAGES), images_by_stem(folder / _MASKS)
    documents = {
        Path(entry.name).stem: folder / _CAMERAS / entry.name
        for entry in files(folder / _CAMERAS)
        if entry.name.endswith(".json")
    }
    for name in sorted({*documents, *images}):
        try:
            _read_camera(source, frame, documents.get(name, folder / _CAMERAS / f"{name}.json"))
            image = single(folder / _IMAGES, images, name)
            mask = single(folder / _MASKS, masks, name) if (folder / _MASKS).is_dir() else None
        except ArtifactError as error:
            frame.leave_out(error, name)
            continue
        add_view(source, frame, name, name, image, mask)


def _read_camera(source: Path, frame: Frame, document: Path) -> None:
    require_inside(source, document)
    ((camera, placed),) = cafca.read(document).items()
    if camera != document.stem or any(camera.casefold() == other.casefold() for other in frame.cameras):
        problem = f"'{document.stem}' is no camera's name, or differs from another's in case only"
        raise ArtifactError(document, "name", problem, "Rename the camera's files")
    frame.cameras[camera] = placed
    frame.camera_files.append(document)
