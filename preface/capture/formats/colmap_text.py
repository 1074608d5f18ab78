"""COLMAP's text files (colmap/scene/reconstruction_io_text.cc), without the points."""

from collections.abc import Iterator
from pathlib import Path

from preface.artifacts import ArtifactError
from preface.capture.formats.colmap_records import (
    CameraRecord,
    FrameRecord,
    ImageRecord,
    Model,
    Pose,
    RigRecord,
)

POSE = "QW QX QY QZ TX TY TZ"


class Line:
    """The words of one line, taken from front to back."""

    def __init__(self, path: Path, place: int, text: str):
        self.path, self.place, self._rest = path, place, text

    def word(self, what: str) -> str:
        """The next word."""
        word, _, self._rest = self._rest.partition(" ")
        if not word:
            raise self.error(what, "the line ends before it")
        return word

    def integer(self, what: str) -> int:
        """The next word as a whole number."""
        word = self.word(what)
        if not word.isascii() or not word.isdigit() or len(word) > 20:
            raise self.error(what, f"'{word[:40]}' is not a whole number")
        return int(word)

    def number(self, what: str) -> float:
        """The next word as a number."""
        word = self.word(what)
        try:
            return float(word)
        except ValueError as error:
            raise self.error(what, f"'{word[:40]}' is not a number") from error

    def pose(self, what: str) -> Pose:
        """The next seven words as a quaternion, scalar first, and a translation."""
        return tuple(self.number(f"{what} {name}") for name in POSE.split())

    def rest(self) -> str:
        """All that is left."""
        return self._rest.strip()

    def error(self, what: str, problem: str) -> ArtifactError:
        """An error in this line."""
        remedy = "Correct the line, or write the model again"
        return ArtifactError(self.path, f"line {self.place}, {what}", problem, remedy)


def read_text_model(folder: Path) -> Model:
    """Read ``*.txt`` of a folder."""
    rigs, frames = folder / "rigs.txt", folder / "frames.txt"
    return Model(
        folder,
        ".txt",
        tuple(_camera(line) for line in _lines(folder / "cameras.txt")),
        tuple(_image(line) for line in _lines(folder / "images.txt", in_pairs=True)),
        tuple(_rig(line) for line in _lines(rigs)) if rigs.exists() else (),
        tuple(_frame(line) for line in _lines(frames)) if frames.exists() else (),
    )


def _lines(path: Path, in_pairs: bool = False) -> Iterator[Line]:
    """Yield the lines that are not empty or comments; in pairs, the second line is passed over."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            numbered = enumerate(file, start=1)
            for number, text in numbered:
                if text.strip() and not text.lstrip().startswith("#"):
                    yield Line(path, number, " ".join(text.split()) if not in_pairs else text.strip())
                    if in_pairs:
                        next(numbered, None)  # the points of an image: often empty, and not needed
    except OSError as error:
        raise ArtifactError.from_os(path, "file", error) from error
    except UnicodeDecodeError as error:
        raise ArtifactError(path, "file", "the text is not UTF-8", "Write the model again") from error


def _camera(line: Line) -> CameraRecord:
    id, model = line.integer("CAMERA_ID"), line.word("MODEL")
    width, height = line.integer("WIDTH"), line.integer("HEIGHT")
    params: list[float] = []
    while line.rest():
        params.append(line.number(f"PARAMS[{len(params)}]"))
    return CameraRecord(id, model, width, height, tuple(params))


def _image(line: Line) -> ImageRecord:
    id, pose, camera_id = line.integer("IMAGE_ID"), line.pose("cam_from_world"), line.integer("CAMERA_ID")
    if not line.rest():
        raise line.error("NAME", "the line ends before it")
    return ImageRecord(id, pose, camera_id, line.rest())


def _rig(line: Line) -> RigRecord:
    id, count = line.integer("RIG_ID"), line.integer("NUM_SENSORS")
    if line.word("REF_SENSOR_TYPE") != "CAMERA":
        raise line.error("REF_SENSOR_TYPE", "is not CAMERA; a rig is measured from one of its cameras")
    reference = line.integer("REF_SENSOR_ID")
    sensors: list[tuple[int, Pose | None]] = []
    for index in range(count - 1):
        what = f"SENSORS[{index}]"
        kind, sensor, has_pose = line.word(what), line.integer(what), line.integer(f"{what} HAS_POSE")
        pose = line.pose(what) if has_pose else None
        if kind == "CAMERA":
            sensors.append((sensor, pose))
    return RigRecord(id, reference, tuple(sensors))


def _frame(line: Line) -> FrameRecord:
    id, rig_id, pose = line.integer("FRAME_ID"), line.integer("RIG_ID"), line.pose("rig_from_world")
    images = []
    for index in range(line.integer("NUM_DATA_IDS")):
        what = f"DATA_IDS[{index}]"
        kind, sensor, data = line.word(what), line.integer(what), line.integer(what)
        if kind == "CAMERA":
            images.append((sensor, data))
    return FrameRecord(id, rig_id, pose, tuple(images))


def text_files(model: Model) -> dict[str, bytes]:
    """The content of all files of a model with no points; `repr` of a float64 reads back bit for bit."""
    cameras = [(c.id, c.model, c.width, c.height, *c.params) for c in model.cameras]
    images: list[tuple] = []
    for image in model.images:
        images += [(image.id, *image.pose, image.camera_id, image.name), ()]
    rigs = [(r.id, 1 + len(r.sensors), "CAMERA", r.reference, *_sensors(r)) for r in model.rigs]
    frames = [(f.id, f.rig_id, *f.pose, len(f.images), *_data(f)) for f in model.frames]
    return {
        "cameras.txt": _text("Cameras: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", cameras),
        "images.txt": _text(
            f"Images, two lines each: IMAGE_ID, {POSE.replace(' ', ', ')} (cam_from_world), CAMERA_ID, NAME\n"
            "#   POINTS2D[] as (X, Y, POINT3D_ID)",
            images,
        ),
        "rigs.txt": _text(
            "Rigs: RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (SENSOR_TYPE, SENSOR_ID, "
            f"HAS_POSE, [{POSE.replace(' ', ', ')}]) (sensor_from_rig)",
            rigs,
        ),
        "frames.txt": _text(
            f"Frames: FRAME_ID, RIG_ID, {POSE.replace(' ', ', ')} (rig_from_world), NUM_DATA_IDS, DATA_IDS[] as "
            "(SENSOR_TYPE, SENSOR_ID, DATA_ID)",
            frames,
        ),
        "points3D.txt": _text("Points: none", []),
    }


def _sensors(rig: RigRecord) -> list:
    words: list = []
    for sensor, pose in rig.sensors:
        words += ["CAMERA", sensor, int(pose is not None), *(pose or ())]
    return words


def _data(frame: FrameRecord) -> list:
    return [word for sensor, image in frame.images for word in ("CAMERA", sensor, image)]


def _text(title: str, rows: list[tuple]) -> bytes:
    lines = [f"# {title}", *(" ".join(map(str, row)) for row in rows)]
    return "".join(f"{line}\n" for line in lines).encode()
