"""One shard, opened: its tables, its pixels, and whether they are what was written."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError
from preface.shards.checksums import crc32c
from preface.shards.files import ShardFile
from preface.shards.format import BACKGROUND_KINDS, CHANNELS, PAGE, FormatError, parse_header

_RESTORE = "Restore the file from a copy, or build this shard again"
_CHUNK = 16 * 2**20  # of a file that is hashed


class Shard:
    """A shard by itself, without a manifest.

    Opening reads and checks the structure and the tables, by their checksum. Pixels are checked view by view
    with `check_view`, which no reader may leave out before the first use of a view.

    Args:
        path: the file.

    Attributes:
        layout: where everything is.
        tables: name -> read-only array, see `preface.shards.format`.
        recipe: what it was made from, see `ShardWriter`.
        people: per identity `identity`, `take`, `cameras`, `sources`, `metadata`.

    Raises:
        ArtifactError: it is no shard, or a byte outside the pixels is not what was written.
    """

    def __init__(self, path: Path):
        self.path = path
        self.file = ShardFile(path)
        try:
            self._open()
        except FormatError as error:
            self.close()
            name, _, problem = str(error).partition(": ")
            raise ArtifactError(path, name, problem, _RESTORE) from error
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        page = bytes(self.file.read(0, min(PAGE, self.file.size)))
        self.layout = parse_header(page, self.file.size)
        begin = self.layout.tables_begin
        tables = bytes(self.file.read(begin, self.layout.file_bytes - begin))
        self.tables = self.layout.decode(tables)
        declared = int(self.tables["tables_crc32c"][0])
        actual = crc32c(tables[:-4], crc32c(page))
        if declared != actual:
            raise FormatError(f"tables: their checksum is {actual:08x}, and {declared:08x} was written")
        try:
            notes = json.loads(self.tables["notes"].tobytes())
            self.recipe: str = notes["recipe"]
            self.people: list[dict[str, Any]] = notes["identities"]
        except (ValueError, KeyError, TypeError) as error:
            raise FormatError(f"notes: are not those of a shard ({error})") from error
        self._check_tables()

    def _check_tables(self) -> None:
        """Refuse tables that rays cannot be formed from; the checksum says only that they were written so."""
        tables, valid = self.tables, self.tables["view_valid"]
        names = [person.get("cameras") for person in self.people]
        if len(self.people) != self.layout.identities or any(
            len(n or []) != self.layout.views for n in names
        ):
            raise FormatError("notes: do not name each identity and view")
        if valid.max() > 1 or tables["background_kind"].max() >= len(BACKGROUND_KINDS):
            raise FormatError("view_valid: holds something else than 0 and 1, or background_kind does")
        seen = valid == 1
        for name in ("intrinsics", "canonical_from_camera", "near_far"):
            if not np.isfinite(tables[name][seen]).all():
                raise FormatError(f"{name}: holds a number that is not finite")
        if not (tables["intrinsics"][seen][:, :2] > 0).all():
            raise FormatError("intrinsics: a focal length is not positive")
        if not (tables["box"][:, 0] < tables["box"][:, 1]).all():
            raise FormatError("box: a corner is not below the other")
        x0, y0, x1, y1 = np.moveaxis(tables["foreground_box"], -1, 0)
        inside = (x0 >= 0) & (x0 <= x1) & (x1 <= self.layout.width) & (y0 >= 0) & (y0 <= y1)
        if not (inside & (y1 <= self.layout.height)).all():
            raise FormatError("foreground_box: reaches out of its image")

    def __enter__(self) -> Shard:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def view_begin(self, identity: int, view: int) -> int:
        """The file's byte at which the pixels of a view begin."""
        return PAGE + (identity * self.layout.views + view) * self.layout.view_bytes

    def read_view(self, identity: int, view: int) -> np.ndarray:
        """The pixels of a view as they are stored, uint8 [H*W, 4], checked.

        Raises:
            ArtifactError: the file fails, or the pixels are not what was written.
        """
        data = self.file.read(self.view_begin(identity, view), self.layout.view_bytes)
        pixels = np.frombuffer(data, dtype=np.uint8).reshape(-1, CHANNELS)
        self.check_view(identity, view, pixels)
        return pixels

    def check_view(self, identity: int, view: int, pixels: np.ndarray) -> None:
        """Compare pixels with the view's checksum.

        Raises:
            ArtifactError: they differ.
        """
        declared, actual = int(self.tables["view_crc32c"][identity, view]), crc32c(pixels)
        if declared != actual:
            person = self.people[identity]
            problem = f"its pixels have the checksum {actual:08x}, and {declared:08x} was written"
            place = f"{person['identity']}.{person['cameras'][view] or view}"
            raise ArtifactError(self.path, place, problem, _RESTORE)

    def problems(self, sha256: str | None = None) -> list[ArtifactError]:
        """Read everything and list the views that differ, and the file if its SHA-256 is given and differs."""
        found = []
        for identity in range(self.layout.identities):
            for view in range(self.layout.views):
                try:
                    self.read_view(identity, view)
                except ArtifactError as error:
                    found.append(error)
        if sha256 is not None and not found:
            actual = self._sha256()
            if actual != sha256:
                problem = f"the SHA-256 is {actual}, and the manifest says {sha256}"
                found.append(ArtifactError(self.path, "file", problem, _RESTORE))
        return found

    def _sha256(self) -> str:
        digest = hashlib.sha256()
        for begin in range(0, self.file.size, _CHUNK):
            digest.update(self.file.read(begin, min(_CHUNK, self.file.size - begin)))
        return digest.hexdigest()
