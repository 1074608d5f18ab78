"""COLMAP's binary files (colmap/scene/reconstruction_io_binary.cc), without the points.

Own code, because pycolmap reads a truncated file as garbage and names neither file nor field.
"""

import struct
from pathlib import Path

from preface.artifacts import ArtifactError
from preface.capture.formats.colmap_records import (
    CAMERA_SENSOR,
    MODELS,
    Binary,
    CameraRecord,
    FrameRecord,
    ImageRecord,
    Model,
    Pose,
    RigRecord,
)

POINT_SIZE = struct.calcsize("<ddQ")  # x, y, point3D id


def read_binary(folder: Path) -> Model:
    """Read ``*.bin`` of a folder."""
    return Model(
        folder,
        ".bin",
        _cameras(folder / "cameras.bin"),
        _images(folder / "images.bin"),
        _rigs(folder / "rigs.bin") if (folder / "rigs.bin").exists() else (),
        _frames(folder / "frames.bin") if (folder / "frames.bin").exists() else (),
    )


def _cameras(path: Path) -> tuple[CameraRecord, ...]:
    records = []
    with Binary(path) as file:
        for index in range(file.take("Q", "number of cameras")[0]):
            what = f"camera {index + 1}"
            id, model, width, height = file.take("IiQQ", what)
            if model not in MODELS:
                known = ", ".join(f"{key} ({name})" for key, (name, _) in MODELS.items())
                problem = f"its model id {model} is not one of {known}"
                raise ArtifactError(path, what, problem, "Undistort the images with COLMAP first")
            name, count = MODELS[model]
            records.append(CameraRecord(id, name, width, height, file.take(f"{count}d", what)))
        file.finish()
    return tuple(records)


def _images(path: Path) -> tuple[ImageRecord, ...]:
    records = []
    with Binary(path) as file:
        for index in range(file.take("Q", "number of images")[0]):
            what = f"image {index + 1}"
            id, *pose, camera_id = file.take("I7dI", what)
            records.append(ImageRecord(id, tuple(pose), camera_id, file.text(what)))
            file.skip(file.take("Q", what)[0] * POINT_SIZE, f"points of {what}")
        file.finish()
    return tuple(records)


def _rigs(path: Path) -> tuple[RigRecord, ...]:
    records = []
    with Binary(path) as file:
        for index in range(file.take("Q", "number of rigs")[0]):
            what = f"rig {index + 1}"
            id, count = file.take("II", what)
            reference_type, reference = file.take("iI", what) if count else (-1, 0)
            if reference_type != CAMERA_SENSOR:
                problem = "its reference sensor is not a camera"
                raise ArtifactError(path, what, problem, "Make a camera the reference of the rig")
            sensors: list[tuple[int, Pose | None]] = []
            for _ in range(count - 1):
                sensor_type, sensor, has_pose = file.take("iIB", what)
                pose = file.take("7d", what) if has_pose else None
                if sensor_type == CAMERA_SENSOR:
                    sensors.append((sensor, pose))
            records.append(RigRecord(id, reference, tuple(sensors)))
        file.finish()
    return tuple(records)


def _frames(path: Path) -> tuple[FrameRecord, ...]:
    records = []
    with Binary(path) as file:
        for index in range(file.take("Q", "number of frames")[0]):
            what = f"frame {index + 1}"
            id, rig_id, *pose, count = file.take("II7dI", what)
            data = [file.take("iIQ", what) for _ in range(count)]
            images = tuple((sensor, image) for kind, sensor, image in data if kind == CAMERA_SENSOR)
            records.append(FrameRecord(id, rig_id, tuple(pose), images))
        file.finish()
    return tuple(records)


def binary_files(model: Model) -> dict[str, bytes]:
    """The content of all files of a model with no points."""
    ids = {name: (id, count) for id, (name, count) in MODELS.items()}
    cameras = [
        struct.pack(f"<IiQQ{ids[c.model][1]}d", c.id, ids[c.model][0], c.width, c.height, *c.params)
        for c in model.cameras
    ]
    images = [
        struct.pack("<I7dI", i.id, *i.pose, i.camera_id) + i.name.encode() + b"\0" + struct.pack("<Q", 0)
        for i in model.images
    ]
    rigs = [
        struct.pack("<IIiI", r.id, 1 + len(r.sensors), CAMERA_SENSOR, r.reference)
        + b"".join(_sensor(sensor, pose) for sensor, pose in r.sensors)
        for r in model.rigs
    ]
    frames = [
        struct.pack("<II7dI", f.id, f.rig_id, *f.pose, len(f.images))
        + b"".join(struct.pack("<iIQ", CAMERA_SENSOR, sensor, image) for sensor, image in f.images)
        for f in model.frames
    ]
    lists = {"cameras": cameras, "images": images, "rigs": rigs, "frames": frames, "points3D": []}
    return {f"{kind}.bin": struct.pack("<Q", len(rows)) + b"".join(rows) for kind, rows in lists.items()}


def _sensor(sensor: int, pose: Pose | None) -> bytes:
    posed = pose is not None
    return struct.pack("<iIB", CAMERA_SENSOR, sensor, posed) + (struct.pack("<7d", *pose) if pose else b"")
