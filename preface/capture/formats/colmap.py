"""COLMAP models, text and binary: COLMAP 4 with rigs and frames, and older ones without.

Conventions: world to camera (``cam_from_world``), x right, y down, z forward; quaternions scalar first;
the centre of the top-left pixel is (0.5, 0.5). They are ours, so nothing is converted.

Reading. A model of one rig with several cameras and several instants describes that rig: its cameras are
read with ``sensor_from_rig``. In every other model each image is a camera, with ``cam_from_world``: that
is a rig at one instant, or photographs of someone who keeps still. Names of images become ids.

Writing. One rig whose reference is the first camera, one frame, one image ``<id>.png`` per camera, no
points. The poses in ``images`` repeat, bit for bit, those of the rig; COLMAP itself goes by ``rigs`` and
``frames``, which say the same up to rounding. Reading checks that they agree.
"""

from pathlib import Path

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.formats.colmap_binary import binary_files, read_binary
from preface.capture.formats.colmap_records import (
    CameraRecord,
    FrameRecord,
    ImageRecord,
    Model,
    Pose,
    RigRecord,
)
from preface.capture.formats.colmap_text import read_text_model, text_files
from preface.capture.formats.document import Node
from preface.capture.formats.format import Cameras, Format, as_id, by_id, ids_of_images, write_folder
from preface.capture.formats.lenses import check_size
from preface.capture.rig import RigCamera
from preface.geometry.cameras import Camera
from preface.geometry.conventions import camera_from_colmap
from preface.geometry.transforms import Rigid

# Between a pose in images and the same one composed of rigs and frames: rotation matrix entries, and
# translations relative to the largest of 1 and their entries. Rounding stays under 1e-14.
POSE_AGREEMENT = 1e-6


# --------------------------------------------------------------------------------------- reading


def read_model(model: Model) -> dict[str, RigCamera]:
    """The cameras of a model, as the module describes them."""
    lenses = {record.id: _lens(model, record) for record in model.cameras}
    for image in model.images:
        if image.camera_id not in lenses:
            problem = f"its camera {image.camera_id} is not in {model.file('cameras').name}"
            raise ArtifactError(model.file("images"), _title(image), problem, "Write the model again")
    if model.rigs or model.frames:
        _check_agreement(model)
    moving = [rig for rig in model.rigs if rig.sensors]
    if len(model.rigs) == 1 and moving and len(model.frames) > 1:
        return _cameras_of_rig(model, moving[0], lenses)
    ids = ids_of_images([image.name for image in model.images])
    cameras = [
        (name, _camera(model.file("images"), _title(image), lenses[image.camera_id], image.pose))
        for name, image in zip(ids, model.images, strict=True)
    ]
    return by_id(model.file("images"), cameras)


def _cameras_of_rig(model: Model, rig: RigRecord, lenses: dict[int, Camera]) -> dict[str, RigCamera]:
    path, identity = model.file("rigs"), (1.0, *[0.0] * 6)
    cameras = []
    for sensor, pose in ((rig.reference, identity), *rig.sensors):
        what = f"rig {rig.id}, camera {sensor}"
        if pose is None:
            raise ArtifactError(path, what, "has no pose in the rig", "Adjust the rig in COLMAP first")
        if sensor not in lenses:
            problem = f"is not in {model.file('cameras').name}"
            raise ArtifactError(path, what, problem, "Write the model again")
        cameras.append((_name_of_sensor(model, sensor), _camera(path, what, lenses[sensor], pose)))
    return by_id(path, cameras)


def _name_of_sensor(model: Model, sensor: int) -> str:
    """The folder that all images of a camera, and no others, lie in; ``camera<number>`` otherwise."""
    folders = {image.name.rpartition("/")[0] for image in model.images if image.camera_id == sensor}
    others = {image.name.rpartition("/")[0] for image in model.images if image.camera_id != sensor}
    folder = as_id(folders.pop()) if len(folders) == 1 and not folders & others else ""
    return folder or f"camera{sensor}"


def _check_agreement(model: Model) -> None:
    """Refuse a model whose images contradict its rigs and frames: one of them is out of date."""
    path, remedy = model.file("frames"), "Write the model again with COLMAP"
    rigs = {rig.id: {rig.reference: (1.0, *[0.0] * 6), **dict(rig.sensors)} for rig in model.rigs}
    frame_of = {image: (frame, sensor) for frame in model.frames for sensor, image in frame.images}
    for image in model.images:
        if image.id not in frame_of:
            raise ArtifactError(path, _title(image), "belongs to no frame", remedy)
        frame, sensor = frame_of[image.id]
        sensors = rigs.get(frame.rig_id, {})
        if sensor != image.camera_id or sensor not in sensors:
            problem = f"frame {frame.id} of rig {frame.rig_id} does not have its camera {image.camera_id}"
            raise ArtifactError(path, _title(image), problem, remedy)
        in_rig = sensors[sensor]
        if in_rig is None:
            continue
        of_rig, of_frame = (
            _pose(model.file("rigs"), f"rig {frame.rig_id}", in_rig),
            _pose(path, "", frame.pose),
        )
        composed, own = of_rig @ of_frame, _pose(model.file("images"), _title(image), image.pose)
        turned = np.abs(composed.rotation - own.rotation).max()
        moved = float(np.linalg.norm(composed.translation - own.translation))
        if turned > POSE_AGREEMENT or moved > POSE_AGREEMENT * max(1.0, *np.abs(own.translation)):
            problem = f"its pose differs from that of its frame, by {turned:.2g} in rotation and {moved:.2g}"
            remedy = f"Remove {path.name} and {model.file('rigs').name} if this file is the right one"
            raise ArtifactError(model.file("images"), _title(image), problem, remedy)


def _lens(model: Model, record: CameraRecord) -> Camera:
    place = Node(model.file("cameras"), f"camera {record.id}", None)
    check_size(place, record.width, record.height)
    with place.geometry():
        return camera_from_colmap(record.model, record.width, record.height, np.array(record.params))


def _pose(path: Path, what: str, pose: Pose) -> Rigid:
    with Node(path, what, None).geometry():
        return Rigid.from_quaternion(np.array(pose[:4]), np.array(pose[4:]))


def _camera(path: Path, what: str, lens: Camera, pose: Pose) -> RigCamera:
    with Node(path, what, None).geometry():
        return RigCamera(lens, tuple(pose[:4]), tuple(pose[4:]))  # the quaternion as it stands in the file


def _title(image: ImageRecord) -> str:
    return f"image {image.id} ({image.name})"


# --------------------------------------------------------------------------------------- writing


def model_of(folder: Path, suffix: str, cameras: Cameras) -> Model:
    """The model of a rig, as the module describes it."""
    numbered = list(enumerate(cameras.items(), start=1))
    reference = next(iter(cameras.values())).camera_from_rig
    sensors = tuple(
        (number, _numbers(camera.camera_from_rig @ reference.inverse)) for number, (_, camera) in numbered[1:]
    )
    images = tuple(
        ImageRecord(number, (*camera.quaternion_wxyz, *camera.translation), number, f"{name}.png")
        for number, (name, camera) in numbered
    )
    return Model(
        folder,
        suffix,
        cameras=tuple(_record(number, camera.camera) for number, (_, camera) in numbered),
        images=images,
        rigs=(RigRecord(1, 1, sensors),),
        frames=(FrameRecord(1, 1, images[0].pose, tuple((image.id, image.id) for image in images)),),
    )


def _record(number: int, lens: Camera) -> CameraRecord:
    return CameraRecord(number, lens.model, lens.width, lens.height, tuple(lens.params.tolist()))


def _numbers(pose: Rigid) -> Pose:
    return (*pose.quaternion_wxyz.tolist(), *pose.translation.tolist())


# --------------------------------------------------------------------------------------- formats


def _needs(suffix: str, path: Path) -> str | None:
    missing = [kind for kind in ("cameras", "images") if not (path / f"{kind}{suffix}").is_file()]
    return f"is no folder with {' and '.join(f'{kind}{suffix}' for kind in missing)}" if missing else None


TEXT = Format(
    name="colmap-text",
    file_name="",
    mismatch=lambda path: _needs(".txt", path),
    read=lambda path: read_model(read_text_model(path)),
    write=lambda path, cameras: write_folder(path, text_files(model_of(path, ".txt", cameras))),
)
BINARY = Format(
    name="colmap-binary",
    file_name="",
    mismatch=lambda path: _needs(".bin", path),
    read=lambda path: read_model(read_binary(path)),
    write=lambda path, cameras: write_folder(path, binary_files(model_of(path, ".bin", cameras))),
)
