"""Writing one shard: pixels as they come, tables and header at the end, and only then its name.

    with ShardWriter(folder, number, size, "raster", recipe) as shard:
        for head in heads:
            shard.add(head)

What a shard holds is a function of what is added, byte for byte. `preface.shards.building` has the rest of a
dataset: who writes which shard, what is finished, and the manifest.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError
from preface.geometry import GeometryError, Views, lens, validate_rotation
from preface.shards.checksums import crc32c
from preface.shards.files import AtomicFile
from preface.shards.format import BACKGROUND_KINDS, PAGE, PIXEL_ORDERS, Layout, PixelOrder, shard_name
from preface.shards.manifest import check_name
from preface.shards.streams import permutation


@dataclass(frozen=True, eq=False)
class Head:
    """One identity as it goes into a shard.

    Attributes:
        identity, take: names.
        cameras: of the V views, None for a view that this identity has not.
        views: the cameras [V] with their poses in the canonical frame, metres; of missing views, any.
        pixels: uint8 [V, H, W, 4], sRGB-encoded RGB, not premultiplied, and foreground share; of missing views,
            ignored.
        box: float64 [2, 3], canonical frame, metres.
        keypoints: float64 [5, 3], canonical frame, metres, NaN where missing.
        backgrounds: of the V views, from `BACKGROUND_KINDS`.
        sources: per view the source's name and SHA-256 as `{"file": ..., "sha256": ...}`, None if missing.
        metadata: of the capture, JSON types.
    """

    identity: str
    take: str
    cameras: Sequence[str | None]
    views: Views
    pixels: np.ndarray
    box: np.ndarray
    keypoints: np.ndarray
    backgrounds: Sequence[str]
    sources: Sequence[Mapping[str, str] | None]
    metadata: Mapping[str, Any] = field(default_factory=dict)


class ShardWriter:
    """Writes one shard; see the header of this file.

    Args:
        folder: that of the dataset; it must exist.
        number: of the shard.
        size: width and height of all views, pixels.
        pixel_order: how to store the pixels of a view.
        recipe: any text that tells shards made from other inputs or otherwise apart, such as a digest.

    Raises:
        ArtifactError: a head is malformed, or the disk refuses; nothing is left behind.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        number: int,
        size: tuple[int, int],
        pixel_order: PixelOrder,
        recipe: str,
    ):
        self.path = Path(folder) / shard_name(number)
        self._width, self._height = size
        self._order: PixelOrder = pixel_order
        self._recipe = recipe
        self._file = AtomicFile(self.path)
        self._end = PAGE
        self._tables: dict[str, list[np.ndarray]] = {}
        self._people: list[dict[str, Any]] = []
        if pixel_order not in PIXEL_ORDERS:
            raise ValueError(f"pixel_order: {pixel_order!r} is not one of {', '.join(PIXEL_ORDERS)}")

    def __enter__(self) -> ShardWriter:
        self._file.__enter__()
        return self

    def add(self, head: Head) -> None:
        """Write the pixels of an identity and keep its tables for the end."""
        self._check(head)
        valid = np.array([camera is not None for camera in head.cameras])
        tables = _tables(head, valid, self._width, self._height)
        tables["view_crc32c"] = np.zeros(len(valid), np.uint32)
        for view in range(len(valid)):
            stored = (
                self._stored(head.pixels[view])
                if valid[view]
                else self._stored(np.zeros_like(head.pixels[0]))
            )
            self._file.write(self._end, stored)
            tables["view_crc32c"][view] = crc32c(stored)
            self._end += stored.nbytes
        for name, table in tables.items():
            self._tables.setdefault(name, []).append(table)
        self._people.append(
            {
                "identity": head.identity,
                "take": head.take,
                "cameras": list(head.cameras),
                "sources": [dict(source) if source else None for source in head.sources],
                "metadata": dict(head.metadata),
            }
        )

    def _stored(self, pixels: np.ndarray) -> np.ndarray:
        """A view's pixels in the order of the file, uint8 [H*W, 4]."""
        raster = np.ascontiguousarray(pixels).reshape(-1, 4)
        if self._order == "raster":
            return raster
        return raster.view(np.uint32)[permutation(len(raster))[0]].view(np.uint8)

    def _check(self, head: Head) -> None:
        """Refuse what would make a shard that cannot be read."""

        def refuse(what: str, problem: str) -> ArtifactError:
            return ArtifactError(self.path, f"{head.identity}.{what}", problem, "Correct the input")

        check_name(self.path, head.identity)
        views = len(head.cameras)
        expected = (len(self._people[0]["cameras"]) if self._people else views, self._height, self._width, 4)
        if head.pixels.dtype != np.uint8 or head.pixels.shape != expected:
            raise refuse("pixels", f"are {head.pixels.dtype} {head.pixels.shape} and not uint8 {expected}")
        if any(person["identity"].casefold() == head.identity.casefold() for person in self._people):
            raise refuse("identity", "is in this shard already, upper and lower case being the same")
        if len(head.backgrounds) != views or len(head.sources) != views:
            raise refuse("backgrounds", f"backgrounds and sources must have {views} entries, as the cameras")
        unknown = [kind for kind in head.backgrounds if kind not in BACKGROUND_KINDS]
        if unknown:
            raise refuse("backgrounds", f"{unknown[0]!r} is not one of {', '.join(BACKGROUND_KINDS)}")
        box = np.asarray(head.box)
        if box.shape != (2, 3) or not (np.isfinite(box).all() and (box[0] < box[1]).all()):
            raise refuse("box", f"{box.tolist()} has no two corners with the smaller one first")
        for view, camera in enumerate(head.cameras):
            if camera is not None:
                problem = _camera_problem(head.views[view], self._width, self._height)
                if problem:
                    raise refuse(f"views.{camera}", problem)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._finish()
        except BaseException as failure:
            self._file.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._file.__exit__(kind, error, traceback)

    def _finish(self) -> None:
        """Write the tables and the header."""
        if not self._people:
            raise ArtifactError(self.path, "identities", "there is nobody in it", "Leave this shard out")
        notes = {"recipe": self._recipe, "identities": self._people}
        text = json.dumps(notes, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
        layout = Layout(
            identities=len(self._people),
            views=len(self._people[0]["cameras"]),
            height=self._height,
            width=self._width,
            pixel_order=self._order,
            notes_bytes=len(text),
        )
        arrays = {name: np.stack(tables) for name, tables in self._tables.items()}
        arrays["notes"] = np.frombuffer(text, np.uint8)
        names = [name for name in layout.tensors if name not in ("pixels", "tables_crc32c")]
        tables = b"".join(arrays[name].tobytes() for name in names)
        header = layout.header()
        checksum = np.array([crc32c(tables, crc32c(header))], "<u4").tobytes()
        self._file.write(self._end, tables + checksum)
        self._file.write(0, header)


def _camera_problem(view: Views, width: int, height: int) -> str:
    """What is wrong with a camera, empty if nothing."""
    if not (np.isfinite(view.intrinsics).all() and np.isfinite(view.world_from_camera).all()):
        return "a number is not finite"
    try:
        validate_rotation(view.world_from_camera[:, :3])
    except GeometryError as error:
        return str(error)
    if not (view.intrinsics[:2] > 0).all():
        return "a focal length is not positive"
    edge = np.concatenate([np.stack([np.linspace(0, width, 65), np.full(65, y)], -1) for y in (0, height)])
    side = np.concatenate([np.stack([np.full(65, x), np.linspace(0, height, 65)], -1) for x in (0, width)])
    _, _, valid = lens.unproject(view.intrinsics, view.monotonic_radius, np.concatenate([edge, side]))
    return "" if valid.all() else "the distortion folds inside the image; undistort it, or mask the view"


def _tables(head: Head, valid: np.ndarray, width: int, height: int) -> dict[str, np.ndarray]:
    """The tables of an identity but for checksums, without the leading K; zeros where a view is missing."""
    views = len(valid)
    count, around = np.zeros(views, "<i8"), np.zeros((views, 4), "<i4")
    near_far = np.zeros((views, 2), "<f8")
    for view in np.flatnonzero(valid):
        foreground = head.pixels[view, :, :, 3] > 0
        across, down = np.flatnonzero(foreground.any(0)), np.flatnonzero(foreground.any(1))
        count[view] = np.count_nonzero(foreground)
        if len(across):
            around[view] = across[0], down[0], across[-1] + 1, down[-1] + 1
        near_far[view] = box_depths(np.asarray(head.box), head.views.world_from_camera[view])
    seen = valid.astype("<f8")
    kinds = [BACKGROUND_KINDS.index(kind) for kind in head.backgrounds]
    return {
        "intrinsics": np.where(valid[:, None], head.views.intrinsics, 0.0).astype("<f8"),
        "monotonic_radius": np.where(valid, head.views.monotonic_radius, 0.0).astype("<f8"),
        "canonical_from_camera": np.where(valid[:, None, None], head.views.world_from_camera, 0.0).astype(
            "<f8"
        ),
        "near_far": near_far * seen[:, None],
        "box": np.asarray(head.box, "<f8"),
        "keypoints": np.asarray(head.keypoints, "<f8").reshape(5, 3),
        "foreground_count": count,
        "foreground_box": around,
        "view_valid": valid.astype(np.uint8),
        "background_kind": np.where(valid, kinds, 0).astype(np.uint8),
    }


def box_depths(box: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """The depths between which a box [2, 3] lies in front of a camera [3, 4], [2], metres.

    A box that reaches behind the camera begins at 0, and one that lies behind it entirely is [0, 1].
    """
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(-1, 3)
    depths = (corners - world_from_camera[:, 3]) @ world_from_camera[:, 2]
    return np.array([max(depths.min(), 0.0), depths.max()]) if depths.max() > 0 else np.array([0.0, 1.0])
