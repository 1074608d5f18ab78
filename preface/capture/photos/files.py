"""The photographs themselves: which files, which share a camera, and copies that pycolmap can read.

Every photograph is decoded by `preface.capture.images`, whose rules hold here too: a truncated file or one
that EXIF wants rotated is refused. pycolmap then sees 8-bit grey copies in a temporary folder, so that
16-bit files and EXR work like any other.
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.images import IMAGE_SUFFIXES, ImageHeader, display_tones, read_header, read_image

Sharing = Literal["one", "folder", "each"]

# Exhaustive matching of 300 photographs is 45,000 pairs: hours on a few cores, with nothing gained.
MAX_PHOTOGRAPHS = 300


class PhotoError(ArtifactError):
    """Photographs from which no calibration follows: which, why, and what to do."""


@dataclass(frozen=True)
class Photograph:
    """One photograph.

    Attributes:
        id: its name in the rig, made from the file's.
        path: the file.
        width, height: pixels.
        camera: index of the camera that took it; photographs with one index share a lens.
        exif_focal: focal length in pixels according to EXIF, None where it says nothing usable.
    """

    id: str
    path: Path
    width: int
    height: int
    camera: int
    exif_focal: float | None


def find_photographs(
    images: str | os.PathLike[str] | Sequence[Path],
    sharing: Sharing | None,
    header_of: Callable[[Path], ImageHeader] = read_header,
) -> list[Photograph]:
    """List photographs, read their headers, and group them by camera.

    Args:
        images: a folder (its image files; with ``sharing="folder"`` those of its subfolders), or files.
        sharing: ``one`` camera took all, one per ``folder``, or ``each`` photograph has its own; None is ``one`` where
            the user has no choice.
        header_of: reads the header of a file; `preface.capture.upright.read_upright_header` where photographs are
            turned as EXIF says.

    Returns:
        At least two photographs, in the order of their names or as given.

    Raises:
        PhotoError: fewer than two or too many, names that clash, or sizes that differ within one camera.
        ImageError: a file that cannot be read or that EXIF wants rotated.
    """
    paths = (
        [Path(p) for p in images] if not isinstance(images, str | os.PathLike) else _listed(images, sharing)
    )
    place = _place(images, paths)
    if len(paths) < 2:
        found = f"holds {len(paths)} photograph{'s' * (len(paths) != 1)}"
        raise PhotoError(place, "photographs", found, "Give at least two, better ten or more, of one scene")
    if len(paths) > MAX_PHOTOGRAPHS:
        remedy = f"Choose up to {MAX_PHOTOGRAPHS} sharp ones from all around; 100 are plenty"
        raise PhotoError(place, "photographs", f"are {len(paths)}, all to be compared in pairs", remedy)
    headers = [header_of(path) for path in paths]
    cameras = _cameras(paths, sharing or "one")
    remedy = "Give photographs of one size and orientation"
    if sharing is not None:
        remedy += ", or say --cameras folder or --cameras each where several cameras took them"
    _check_sizes(paths, headers, cameras, remedy)
    return [
        Photograph(name, path, header.width, header.height, camera, _exif_focal(path, header))
        for name, path, header, camera in zip(_ids(paths), paths, headers, cameras, strict=True)
    ]


def stage(photographs: Sequence[Photograph], masks: Path | None, folder: Path, threads: int) -> list[str]:
    """Write 8-bit grey copies of photographs to ``folder/images`` and masks to ``folder/masks``.

    Args:
        photographs: what to copy.
        masks: folder of masks, ``<photograph's stem>.png``, zero where features are not wanted; or None.
        folder: where to.
        threads: how many files to decode at a time.

    Returns:
        The copies' names within ``folder/images``; a mask has its image's name followed by ``.png``.

    Raises:
        ImageError: a file that does not decode.
        PhotoError: a mask that is missing or of another size.
    """
    import cv2

    names = [f"{index:05d}.png" for index in range(len(photographs))]
    for kind in ("images", "masks"):
        (folder / kind).mkdir()

    def write(path: Path, pixels: np.ndarray) -> None:
        if not cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
            raise PhotoError(path, "writing", "a temporary copy cannot be written", "Free space for it")

    def copy(photograph: Photograph, name: str) -> None:
        write(folder / "images" / name, _grey(read_image(photograph.path)))
        if masks is not None:
            write(folder / "masks" / f"{name}.png", _mask(masks, photograph))

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(copy, photographs, names))
    return names


def _listed(images: str | os.PathLike[str], sharing: Sharing | None) -> list[Path]:
    folder = Path(images)
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise PhotoError(folder, "photographs", problem, "Give the folder that holds the photographs")
    files = sorted(folder.glob("*/*" if sharing == "folder" else "*"))
    return [p for p in files if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()]


def _place(images: str | os.PathLike[str] | Sequence[Path], paths: list[Path]) -> Path:
    """What an error about all photographs is an error of."""
    if isinstance(images, str | os.PathLike):
        return Path(images)
    return paths[0].parent if paths else Path()


def _cameras(paths: list[Path], sharing: Sharing) -> list[int]:
    keys: list[Path | None] = [{"one": None, "folder": path.parent, "each": path}[sharing] for path in paths]
    order = list(dict.fromkeys(keys))
    return [order.index(key) for key in keys]


def _check_sizes(paths: list[Path], headers: list[ImageHeader], cameras: list[int], remedy: str) -> None:
    groups: dict[int, list[tuple[tuple[int, int], Path]]] = defaultdict(list)
    for path, header, camera in zip(paths, headers, cameras, strict=True):
        groups[camera].append(((header.width, header.height), path))
    for group in groups.values():
        usual = Counter(size for size, _ in group).most_common(1)[0][0]
        others = [(size, path) for size, path in group if size != usual]
        if others:
            (width, height), path = others[0]
            more = f" (and {len(others) - 1} more)" if len(others) > 1 else ""
            problem = (
                f"is {width}x{height}{more}, but most photographs of its camera are {usual[0]}x{usual[1]}"
            )
            raise PhotoError(path, "size", problem, remedy)


def _ids(paths: list[Path]) -> list[str]:
    """Names for the rig: the stem, with its folder's name in front where stems clash."""
    stems = Counter(path.stem.casefold() for path in paths)
    names = [
        path.stem if stems[path.stem.casefold()] == 1 else f"{path.parent.name}-{path.stem}" for path in paths
    ]
    names = [camera_name(name) for name in names]
    taken: dict[str, Path] = {}
    for name, path in zip(names, paths, strict=True):
        if other := taken.get(name.casefold()):
            raise PhotoError(path, "name", f"becomes '{name}', as {other} does", "Rename or remove one")
        taken[name.casefold()] = path
    return names


def camera_name(name: str) -> str:
    """What a rig calls the camera of a photograph of this name."""
    allowed = re.sub(r"[^A-Za-z0-9._-]", "_", name)[:100]
    return allowed if allowed[0].isalnum() else f"photo{allowed}"[:100]


def _exif_focal(path: Path, header: ImageHeader) -> float | None:
    """Focal length in pixels by EXIF's 35 mm equivalent or pycolmap's table of sensors."""
    import pycolmap

    if header.format == "EXR":
        return None
    camera = pycolmap.infer_camera_from_image(path)
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else None


def _grey(pixels: np.ndarray) -> np.ndarray:
    """8-bit grey [height, width] of an image as `read_image` returns it."""
    import cv2

    pixels = display_tones(pixels[..., :3])
    if pixels.shape[2] == 1:
        return pixels[..., 0]
    return cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY)


def _mask(masks: Path, photograph: Photograph) -> np.ndarray:
    path = masks / f"{photograph.path.stem}.png"
    if not path.is_file():
        problem = f"there is none for {photograph.path.name}"
        raise PhotoError(path, "mask", problem, "Give a mask for every photograph, or no masks at all")
    mask = read_image(path)[..., 0]
    if mask.shape != (photograph.height, photograph.width):
        problem = f"is {mask.shape[1]}x{mask.shape[0]}, its photograph {photograph.width}x{photograph.height}"
        raise PhotoError(path, "mask", problem, "Give a mask of the photograph's size")
    return np.where(mask > 0, 255, 0).astype(np.uint8)
