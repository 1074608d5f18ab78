"""TensorBoard's event files, written without TensorBoard.

What TensorBoard reads is a sequence of records, each a length, its masked CRC-32C, a protocol-buffer message and
its masked CRC-32C (TensorFlow, `core/lib/io/record_writer.cc`). The few messages that numbers and pictures need
(`core/util/event.proto`, `core/framework/summary.proto`) are spelt out here, which is less than the forty packages
that `tensorboard` brings along. Look at a run with ``tensorboard --logdir prior/`` wherever TensorBoard is installed.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import google_crc32c

from preface.artifacts import ArtifactError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types of protocol buffers
_START_OF_SESSION = 1  # SessionLog.START: readers drop what a killed run wrote from this step on
_RGB = 3
_LARGEST = (2 - 2**-23) * 2.0**127  # float32


class EventFile:
    """One run's events; a resumed run begins another file beside the first.

    Args:
        folder: where TensorBoard looks; it must exist.
        step: that the run begins with.

    Raises:
        ArtifactError: the file cannot be written, now or later.
    """

    def __init__(self, folder: Path, step: int):
        self.path = folder / f"events.out.tfevents.{time.time_ns() / 1e9:.6f}.preface"
        try:
            self._file = self.path.open("xb")
        except OSError as error:
            raise ArtifactError.from_os(self.path, "writing", error) from error
        self._write(0, _text(3, "brain.Event:2"))
        self._write(step, _message(7, _varint_field(1, _START_OF_SESSION)))

    def __enter__(self) -> EventFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()

    def numbers(self, step: int, values: Mapping[str, float]) -> None:
        """Write numbers of a step by name, as float32: finite ones beyond its range, as its largest."""
        entries = [_text(1, name) + _field(2, _FIXED32, _float32(value)) for name, value in values.items()]
        self._write(step, _message(5, b"".join(_message(1, entry) for entry in entries)))

    def picture(self, step: int, name: str, png: bytes, size: tuple[int, int]) -> None:
        """Write a picture of (width, height) that is encoded already."""
        width, height = size
        sizes = _varint_field(1, height) + _varint_field(2, width) + _varint_field(3, _RGB)
        image = _message(4, sizes + _message(4, png))
        self._write(step, _message(5, _message(1, _text(1, name) + image)))

    def _write(self, step: int, content: bytes) -> None:
        event = _field(1, _FIXED64, struct.pack("<d", time.time())) + _varint_field(2, step) + content
        length = struct.pack("<Q", len(event))
        try:
            self._file.write(length + _masked_crc(length) + event + _masked_crc(event))
            self._file.flush()
        except OSError as error:
            raise ArtifactError.from_os(self.path, "writing", error) from error


def _float32(value: float) -> bytes:
    finite = math.isfinite(value)
    return struct.pack("<f", min(max(value, -_LARGEST), _LARGEST) if finite else value)


def _masked_crc(data: bytes) -> bytes:
    crc = google_crc32c.value(data)
    return struct.pack("<I", (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF)


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def _field(number: int, wire: int, content: bytes) -> bytes:
    return _varint(number << 3 | wire) + content


def _varint_field(number: int, value: int) -> bytes:
    return _field(number, _VARINT, _varint(value))


def _message(number: int, content: bytes) -> bytes:
    return _field(number, _BYTES, _varint(len(content)) + content)


def _text(number: int, text: str) -> bytes:
    return _message(number, text.encode())
