"""Explicit rays: what a `preface.shards.Batch` holds, of every pixel, as one safetensors file per identity.

    DIR/<identity>.safetensors      float32 [V, H, W, C], V chosen views in the order of `cameras`

| tensor | columns | |
|---|---|---|
| origins, directions, viewdirs | 3 | canonical frame; directions have depth 1, viewdirs length 1 |
| radii, near, far | 1 | of the cone at depth 1; depths, of rays that miss the box those of the box's corners |
| rgba | 4 | sRGB-encoded, not premultiplied, and foreground share, in [0, 1] |
| hit | 1 | 1 where the ray meets the identity's box, 0 elsewhere |

The metadata of the file are texts: `format`, `identity`, `cameras` (JSON list), `units` (metre or scene),
`scale` (what metres were multiplied with) and `box` (JSON [2, 3], in those units). The rays are the loader's
own, every view checked against its checksum first; at 68 bytes per ray they take 17 times what the shards do.
"""

from __future__ import annotations

import json
import os
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from preface.artifacts import ArtifactError
from preface.shards.batches import Batch
from preface.shards.export.selection import Person, Selection
from preface.shards.files import AtomicFile
from preface.shards.loader import Loader
from preface.shards.reader import Dataset
from preface.shards.samplers import Pick, ViewIndex

FORMAT = "preface-rays-1"
FIELDS = {
    "origins": 3,
    "directions": 3,
    "viewdirs": 3,
    "radii": 1,
    "near": 1,
    "far": 1,
    "rgba": 4,
    "hit": 1,
}
_FLOAT = 4
BYTES_PER_RAY = _FLOAT * sum(FIELDS.values())
_CHUNK = 2**16  # rays formed at a time
_METADATA_BYTES = 4096  # what a file's header takes, at most, in the size that is stated beforehand


def rays_bytes(selection: Selection) -> int:
    """Bytes that the rays of a selection take, headers included (rounded up)."""
    return BYTES_PER_RAY * selection.rays + _METADATA_BYTES * len(selection.people)


def export_rays(
    dataset: Dataset, selection: Selection, output: str | os.PathLike[str], units: str, scale: float
) -> list[Path]:
    """Write the rays of a selection, one file per identity, each of them whole or not at all.

    Args:
        dataset: opened.
        selection: see `select`.
        output: folder to write, new or empty.
        units: name of the unit of length, for the metadata.
        scale: what metres are multiplied with.

    Returns:
        The files.

    Raises:
        ArtifactError: the folder is not empty, a view is damaged, a lens folds, or the disk refuses.
    """
    folder = make_empty(Path(output))
    index = dataset.index()
    views = np.array([(person.number, view) for person in selection.people for view in person.views])
    scan = _Scan(index, views)
    loader = Loader(dataset, scan, placement="mmap", scale=scale)
    written, first = [], 0
    for person in selection.people:
        path = folder / f"{person.name}.safetensors"
        shape = (len(person.views), index.height, index.width)
        header, begins = _header(shape, person, units, scale, dataset.tables["box"][person.number] * scale)
        written.append(_export_person(loader, scan, first, path, header, begins, len(person.views)))
        first += len(person.views)
    return written


def make_empty(folder: Path) -> Path:
    """Create a folder, or accept an empty one.

    Raises:
        ArtifactError: it holds something, or the disk refuses.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = any(folder.iterdir())
    except OSError as error:
        raise ArtifactError.from_os(error.filename or folder, "writing", error) from error
    if occupied:
        problem = "this folder is not empty, and its files would mix with the exported ones"
        raise ArtifactError(folder, "writing", problem, "Name a new folder, or empty this one")
    return folder


@dataclass(frozen=True, eq=False)
class _Scan:
    """A sampler that goes through all pixels of views in order, one stretch of a view per step.

    Attributes:
        index: of the dataset.
        views: identity and view of each, int64 [n, 2].
    """

    index: ViewIndex
    views: np.ndarray

    @property
    def groups(self) -> int:
        """Stretches of a step."""
        return 1

    @property
    def view_pixels(self) -> int:
        """Pixels of a view."""
        return self.index.width * self.index.height

    @property
    def steps_per_view(self) -> int:
        """Stretches of a view."""
        return -(-self.view_pixels // _CHUNK)

    def stretch(self, step: int) -> tuple[int, int]:
        """The first pixel of a step's stretch, and the one after its last."""
        part = step % self.steps_per_view
        return part * _CHUNK, min((part + 1) * _CHUNK, self.view_pixels)

    def pick(self, step: int, rank: int, world: int) -> Pick:
        """The stretch of a step; there is one rank."""
        view = step // self.steps_per_view
        identity, number = self.views[view : view + 1].T
        return self.index.pick(identity, number, np.arange(*self.stretch(step))[None])


def _export_person(
    loader: Loader,
    scan: _Scan,
    first_view: int,
    path: Path,
    header: bytes,
    begins: dict[str, int],
    views: int,
) -> Path:
    """Write the views of `scan` from number `first_view` on."""
    with AtomicFile(path) as file:
        file.write(0, header)
        for step in range(views * scan.steps_per_view):
            pixel = step // scan.steps_per_view * scan.view_pixels + scan.stretch(step)[0]
            for name, values in _columns(loader.batch(first_view * scan.steps_per_view + step)).items():
                file.write(begins[name] + pixel * values.shape[1] * _FLOAT, values)
    return path


def _columns(batch: Batch) -> dict[str, np.ndarray]:
    """The tensors of a batch as the file has them, float32 [n, C]."""
    return {
        name: np.ascontiguousarray(getattr(batch, name).numpy().reshape(-1, columns), dtype="<f4")
        for name, columns in FIELDS.items()
    }


def _header(
    shape: tuple[int, int, int], person: Person, units: str, scale: float, box: np.ndarray
) -> tuple[bytes, dict[str, int]]:
    """The first bytes of the file, and the byte at which each tensor begins (safetensors' format, 8-aligned)."""
    entries: dict[str, object] = {
        "__metadata__": {
            "format": FORMAT,
            "identity": person.name,
            "cameras": json.dumps(person.cameras),
            "units": units,
            "scale": repr(scale),
            "box": json.dumps(box.tolist()),
        }
    }
    begins, end = {}, 0
    for name, columns in FIELDS.items():
        begins[name], end = end, end + _FLOAT * columns * int(np.prod(shape))
        entries[name] = {
            "dtype": "F32",
            "shape": [*shape, columns],
            "data_offsets": [begins[name], end],
        }
    text = json.dumps(entries, separators=(",", ":")).encode()
    text = text.ljust(-(-len(text) // 8) * 8, b" ")
    first = 8 + len(text)
    return struct.pack("<Q", len(text)) + text, {name: first + begin for name, begin in begins.items()}
