"""The layout of one shard, ``shard-00000.safetensors``.

A shard is a safetensors file whose bytes are fixed by four numbers (identities K, views V, height H, width W),
the pixel order and the length of its notes:

    bytes 0 to 4095     the header: its length (uint64), JSON, spaces up to the end of the page
    from byte 4096      `pixels`, so that they start on a page and map into memory as they are
    after them          the tables below without gaps, then `notes`, then `tables_crc32c`

| tensor | type, shape | meaning |
|---|---|---|
| pixels | uint8 [K, V, H, W, 4], permuted: [K, V, H*W, 4] | sRGB-encoded RGB, not premultiplied, and foreground |
| intrinsics | float64 [K, V, 12] | as `preface.geometry.lens`, pixels of these images |
| monotonic_radius | float64 [K, V] | of these lenses, normalised units, inf if they never fold |
| canonical_from_camera | float64 [K, V, 3, 4] | poses, metres |
| near_far | float64 [K, V, 2] | depths between which the box lies in front of the camera, metres |
| box | float64 [K, 2, 3] | corners of the box, canonical frame, metres |
| keypoints | float64 [K, 5, 3] | in the project's order, metres, NaN where missing |
| foreground_count | int64 [K, V] | pixels of A > 0 |
| foreground_box | int32 [K, V, 4] | x0 y0 x1 y1 around them, x1 and y1 exclusive; zeros if there are none |
| view_crc32c | uint32 [K, V] | CRC-32C of the view's pixels as they lie in the file |
| view_valid | uint8 [K, V] | 1 where there is a view; the rest is zeros |
| background_kind | uint8 [K, V] | index into `BACKGROUND_KINDS` |
| notes | uint8 [n] | UTF-8 JSON: names, takes, cameras, sources, recipe and free metadata |
| tables_crc32c | uint32 [1] | CRC-32C of the header and of everything between `pixels` and this number |

Because nothing but this layout is accepted, tensors can neither overlap nor reach out of the file.
"""

from __future__ import annotations

import json
import math
import re
import struct
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

PixelOrder = Literal["raster", "permuted"]
PIXEL_ORDERS: tuple[PixelOrder, ...] = ("raster", "permuted")
BACKGROUND_KINDS = ("unknown", "natural", "black", "green", "plate", "removed")
FORMAT = "preface-shard-1"
PAGE = 4096
CHANNELS = 4
MAX_FILE_BYTES = 2**62  # what sizes may multiply to before they are refused
MAX_NOTES_BYTES = 64 * 2**20
_FILE_NAME = re.compile(r"shard-(\d{5})\.safetensors")
_NUMPY = {"U8": "<u1", "U32": "<u4", "I32": "<i4", "I64": "<i8", "F64": "<f8"}


class FormatError(ValueError):
    """A shard that is not one; the message is `field: problem` for the caller to add the file to."""


@dataclass(frozen=True)
class Layout:
    """Where everything is in a shard.

    Attributes:
        identities, views, height, width: K, V, H, W, all positive.
        pixel_order: how the pixels of a view are stored (see `permutation`).
        notes_bytes: length of the notes.
    """

    identities: int
    views: int
    height: int
    width: int
    pixel_order: PixelOrder
    notes_bytes: int

    @cached_property
    def tensors(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Name -> safetensors dtype and shape, in the order of the file."""
        k, v = self.identities, self.views
        grid = (self.height, self.width) if self.pixel_order == "raster" else (self.height * self.width,)
        return {
            "pixels": ("U8", (k, v, *grid, CHANNELS)),
            "intrinsics": ("F64", (k, v, 12)),
            "monotonic_radius": ("F64", (k, v)),
            "canonical_from_camera": ("F64", (k, v, 3, 4)),
            "near_far": ("F64", (k, v, 2)),
            "box": ("F64", (k, 2, 3)),
            "keypoints": ("F64", (k, 5, 3)),
            "foreground_count": ("I64", (k, v)),
            "foreground_box": ("I32", (k, v, 4)),
            "view_crc32c": ("U32", (k, v)),
            "view_valid": ("U8", (k, v)),
            "background_kind": ("U8", (k, v)),
            "notes": ("U8", (self.notes_bytes,)),
            "tables_crc32c": ("U32", (1,)),
        }

    @cached_property
    def offsets(self) -> dict[str, tuple[int, int]]:
        """Name -> first byte and the byte after the last, from the end of the header."""
        offsets, end = {}, 0
        for name, (dtype, shape) in self.tensors.items():
            begin, end = end, end + np.dtype(_NUMPY[dtype]).itemsize * math.prod(shape)
            offsets[name] = (begin, end)
        return offsets

    @property
    def view_pixels(self) -> int:
        """Pixels of a view."""
        return self.height * self.width

    @property
    def view_bytes(self) -> int:
        """Bytes of a view's pixels."""
        return self.view_pixels * CHANNELS

    @property
    def tables_begin(self) -> int:
        """The file's first byte after the pixels."""
        return PAGE + self.offsets["pixels"][1]

    @property
    def file_bytes(self) -> int:
        """Bytes of the whole file."""
        return PAGE + self.offsets["tables_crc32c"][1]

    def header(self) -> bytes:
        """The first page of the file."""
        entries: dict[str, Any] = {
            "__metadata__": {
                "format": FORMAT,
                "pixel_order": self.pixel_order,
                "height": str(self.height),
                "width": str(self.width),
            }
        }
        for name, (dtype, shape) in self.tensors.items():
            entries[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": list(self.offsets[name])}
        text = json.dumps(entries, separators=(",", ":")).encode()
        return struct.pack("<Q", PAGE - 8) + text.ljust(PAGE - 8, b" ")

    def decode(self, tables: bytes) -> dict[str, np.ndarray]:
        """Split the bytes after the pixels into read-only arrays, by name."""
        first = self.offsets["pixels"][1]
        arrays = {}
        for name, (dtype, shape) in self.tensors.items():
            if name != "pixels":
                begin, end = (offset - first for offset in self.offsets[name])
                arrays[name] = np.frombuffer(tables[begin:end], dtype=_NUMPY[dtype]).reshape(shape)
        return arrays


def parse_header(page: bytes, file_bytes: int) -> Layout:
    """Read the layout from the first page of a file of `file_bytes` bytes.

    Raises:
        FormatError: it is not exactly the header that `Layout.header` writes, or the size is another.
    """
    if len(page) < PAGE:
        raise FormatError(f"header: the file ends after {len(page)} bytes, within the header")
    (length,) = struct.unpack("<Q", page[:8])
    if length != PAGE - 8:
        raise FormatError(f"header: says that it is {length} bytes long, and in a shard it is {PAGE - 8}")
    try:
        entries = json.loads(page[8:PAGE])
        described = entries["__metadata__"]
        k, v = (int(n) for n in entries["pixels"]["shape"][:2])
        layout = Layout(
            identities=k,
            views=v,
            height=int(described["height"]),
            width=int(described["width"]),
            pixel_order=described["pixel_order"],
            notes_bytes=int(entries["notes"]["shape"][0]),
        )
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise FormatError(f"header: is not that of a shard ({type(error).__name__}: {error})") from error
    _check_sizes(layout)
    if page[:PAGE] != layout.header():
        raise FormatError("header: its tensors are not laid out as a shard's are")
    if layout.file_bytes != file_bytes:
        raise FormatError(f"file: has {file_bytes} bytes, and its header describes {layout.file_bytes}")
    return layout


def _check_sizes(layout: Layout) -> None:
    """Refuse sizes that are not positive or whose product no file can have."""
    for name in ("identities", "views", "height", "width", "notes_bytes"):
        if not 0 < getattr(layout, name) < MAX_FILE_BYTES:
            raise FormatError(f"header: {name} is {getattr(layout, name)}")
    if layout.pixel_order not in PIXEL_ORDERS:
        raise FormatError(f"header: the pixel order {layout.pixel_order!r} is unknown")
    if layout.notes_bytes > MAX_NOTES_BYTES or layout.file_bytes > MAX_FILE_BYTES:
        raise FormatError(f"header: describes a file of {layout.file_bytes} bytes")


def shard_name(number: int) -> str:
    """The file name of the shard of a number, 0 to 99,999."""
    if not 0 <= number <= 99_999:
        raise ValueError(f"number: {number} is not between 0 and 99999")
    return f"shard-{number:05d}.safetensors"


def shard_number(name: str) -> int | None:
    """The number in a shard's file name, None for other names."""
    match = _FILE_NAME.fullmatch(name)
    return int(match[1]) if match else None
