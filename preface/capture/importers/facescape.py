"""FaceScape's multi-view data (zhuhao-nju/facescape, doc/doc_mview_model.md), or data that lie like it.

    PERSON/EXPRESSION/params.json       see `preface.capture.formats.facescape`
    PERSON/EXPRESSION/0.jpg ...         by number of the view, any suffix

Views that are not valid are left out, as the documentation asks. Each expression was reconstructed by itself:
its params.json has a world and a unit of its own. The toolkit's Rt_scale_dict.json has, per person and number
of the expression (the ``1`` of ``1_neutral``), a scale and a motion [3, 4] to the frame of the registered heads,
x_head = scale R x + t, which is one frame for all and taken to be in millimetres. Without it, align the frames
with ``--procrustes``, and know that a head's size is only as good as ``metres_per_unit``.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.folders import images_by_stem
from preface.capture.formats import facescape
from preface.capture.formats.document import Node, json_document
from preface.capture.importers.frames import (
    Frame,
    ImportOptions,
    add_view,
    frame_folders,
    require_inside,
    single,
)
from preface.capture.importers.placing import placed
from preface.geometry.transforms import Similarity
from preface.plain_words import shown

SHAPE = "PERSON/EXPRESSION/{params.json,0.jpg,1.jpg,…}"
ASSUMPTIONS = facescape.FORMAT.assumptions
REGISTERED = "Rt_scale_dict.json maps to millimetres: the toolkit does not document it"
_PARAMS = "params.json"
_METRES_PER_MILLIMETRE = 1e-3


def frames(source: Path, options: ImportOptions) -> Iterator[Frame]:
    """Read the frames of a dataset; see `Frame`. With registrations, cameras are in metres in the heads' frame."""
    registrations = json_document(options.registrations) if options.registrations is not None else None
    for frame, folder in frame_folders(source, options.patterns, _is_frame):
        if not frame.left_out:
            try:
                _read(source, folder, frame, registrations)
            except ArtifactError as error:
                frame.leave_out(error)
        yield frame


def _is_frame(folder: Path) -> bool:
    return (folder / _PARAMS).is_file() or bool(images_by_stem(folder))


def _read(source: Path, folder: Path, frame: Frame, registrations: Node | None) -> None:
    params = folder / _PARAMS
    require_inside(source, params)
    document = json_document(params)
    valid = _views(document)
    cameras = facescape.read(params) if any(valid.values()) else {}
    if registrations is not None:
        cameras = placed(cameras, _registration(registrations, frame))
    frame.camera_files.append(params)
    names = iter(cameras)  # of the valid views, in their order
    images = images_by_stem(folder)
    for view, is_valid in valid.items():
        try:
            if not is_valid:
                problem, remedy = "is not valid, says params.json: its camera is not reliable", "Leave it out"
                raise ArtifactError(params, f"{view}_valid", problem, remedy)
            camera = next(names)
            frame.cameras[camera] = cameras[camera]
            image = single(folder, images, view)
        except ArtifactError as error:
            frame.leave_out(error, view)
            continue
        add_view(source, frame, view, camera, image, None)
    for stem in sorted(set(images) - set(valid)):
        problem = f"'{stem}' is an image that params.json does not know"
        frame.leave_out(ArtifactError(params, "views", problem, "Restore params.json"), stem)


def _views(document: Node) -> dict[str, bool]:
    """The numbers of the views, in the order in which the format reads them, and whether they are valid."""
    names = [key.removesuffix("_K") for key in document.mapping() if key.endswith("_K")]
    for name in names:
        if not (name.isdecimal() and name.isascii()):
            raise document.error(
                f"has a view {shown(name)}, and views are whole numbers", "Restore params.json"
            )
    if not names:
        raise document.error("has no view", "Restore params.json")
    names.sort(key=lambda name: (len(name), name))
    return {name: _is_valid(document[f"{name}_valid"]) for name in names}


def _is_valid(place: Node) -> bool:
    if not isinstance(place.value, bool | int):
        raise place.error(f"is {shown(place.value)}", "Write true or false")
    return bool(place.value)


def _registration(registrations: Node, frame: Frame) -> Similarity:
    """rig_from_world of a frame, metres."""
    entry = registrations[frame.person][frame.name.partition("_")[0]]
    parts = entry.entries()
    if len(parts) != 2:
        raise entry.error(f"has {len(parts)} parts", "Give a scale and a 3 x 4 matrix")
    scale, motion = parts[0].number() * _METRES_PER_MILLIMETRE, parts[1].array(3, 4)
    with entry.geometry():
        return Similarity(np.array(scale), motion[:, :3], motion[:, 3] * _METRES_PER_MILLIMETRE)
