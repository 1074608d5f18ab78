"""What the files of a COLMAP model say, whether as text or binary."""

import struct
from dataclasses import dataclass
from pathlib import Path

from preface.artifacts import ArtifactError

# colmap/sensor/models.h: model id -> name and number of parameters.
MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
CAMERA_SENSOR = 0  # colmap/sensor/rig.h: SensorType::CAMERA; others, such as IMU, see nothing

Pose = tuple[float, ...]  # QW QX QY QZ TX TY TZ, as the files order it


@dataclass(frozen=True)
class CameraRecord:
    """A lens."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ImageRecord:
    """An image: cam_from_world, and the lens that took it."""

    id: int
    pose: Pose
    camera_id: int
    name: str


@dataclass(frozen=True)
class RigRecord:
    """Cameras that move together: the reference, and sensor_from_rig of the others where it is known."""

    id: int
    reference: int
    sensors: tuple[tuple[int, Pose | None], ...]


@dataclass(frozen=True)
class FrameRecord:
    """An instant of a rig: rig_from_world, and (camera id, image id) of its images."""

    id: int
    rig_id: int
    pose: Pose
    images: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Model:
    """A model without its points, and where it lies. Older models have neither rigs nor frames."""

    folder: Path
    suffix: str
    cameras: tuple[CameraRecord, ...]
    images: tuple[ImageRecord, ...]
    rigs: tuple[RigRecord, ...] = ()
    frames: tuple[FrameRecord, ...] = ()

    def file(self, kind: str) -> Path:
        """The path of the cameras, images, rigs or frames."""
        return self.folder / f"{kind}{self.suffix}"


class Binary:
    """A little-endian file that is read from front to back, and never beyond its end."""

    def __init__(self, path: Path):
        self.path = path
        try:
            self._file = path.open("rb")
            self._left = path.stat().st_size
        except OSError as error:
            raise ArtifactError.from_os(path, "file", error) from error

    def __enter__(self) -> "Binary":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def take(self, layout: str, what: str) -> tuple:
        """Read the values of a `struct` layout."""
        size = struct.calcsize(f"<{layout}")
        self._claim(size, what)
        return struct.unpack(f"<{layout}", self._file.read(size))

    def skip(self, size: int, what: str) -> None:
        """Pass over bytes."""
        self._claim(size, what)
        self._file.seek(size, 1)

    def text(self, what: str) -> str:
        """Read UTF-8 up to a zero byte."""
        data = bytearray()
        while (byte := self.take("c", what)[0]) != b"\0":
            data += byte
        try:
            return data.decode()
        except UnicodeDecodeError as error:
            raise ArtifactError(self.path, what, "the name is not UTF-8", "Write the model again") from error

    def finish(self) -> None:
        """Refuse bytes that nothing accounts for."""
        if self._left:
            problem = f"{self._left} bytes follow after the last entry"
            raise ArtifactError(self.path, "file", problem, "Copy the file again, or write the model again")

    def _claim(self, size: int, what: str) -> None:
        if size > self._left:
            problem = f"the file ends in the middle of it ({size - self._left} bytes too early)"
            raise ArtifactError(self.path, what, problem, "Copy the file again, or write the model again")
        self._left -= size
