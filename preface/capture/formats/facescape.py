"""FaceScape's ``params.json`` (zhuhao-nju/facescape, doc/doc_mview_model.md): nine keys per view.

World to camera, x right, y down, z forward: ``{view}_K`` 3x3, ``{view}_Rt`` 3x4, ``{view}_distortion``
k1 k2 p1 p2 k3, ``{view}_width``, ``{view}_height``, ``{view}_valid``, ``{view}_sn`` (serial number of the
camera), ``{view}_ori`` (original file name) and ``{view}_matches``. FaceScape counts views by the number of
keys, so exactly these are written.

Views that are not valid are left out, as the documentation asks. The serial number becomes the id; where
serial numbers are missing or repeat, the number of the view does.
"""

from pathlib import Path

from preface.capture.formats.document import Node, json_document, lacks_json_key
from preface.capture.formats.format import Cameras, Format, as_id, by_id, write_json
from preface.capture.formats.lenses import camera_at, matrix_pose, opencv_camera, opencv_numbers
from preface.capture.rig import RigCamera


def read(path: Path) -> dict[str, RigCamera]:
    """Read all valid views."""
    document = json_document(path)
    views = sorted(
        (key.removesuffix("_K") for key in document.mapping() if key.endswith("_K")),
        key=lambda view: (len(view), view),
    )
    valid = [view for view in views if document[f"{view}_valid"].value]
    serials = [as_id(str(document.mapping().get(f"{view}_sn", ""))) for view in valid]
    use_serials = all(serials) and len({serial.casefold() for serial in serials}) == len(serials)
    return by_id(
        path,
        [
            (serial if use_serials else as_id(view), _camera(document, view))
            for view, serial in zip(valid, serials, strict=True)
        ],
    )


def _camera(document: Node, view: str) -> RigCamera:
    K, distortion = document[f"{view}_K"], document[f"{view}_distortion"]
    width, height = document[f"{view}_width"].integer(), document[f"{view}_height"].integer()
    lens = opencv_camera(K, K, distortion, width, height)
    return camera_at(K, lens, matrix_pose(document[f"{view}_Rt"]))


def write(path: Path, cameras: Cameras) -> Path:
    """Write all cameras as valid views 0, 1, ... with their ids as serial numbers."""
    content: dict = {}
    for view, (name, camera) in enumerate(cameras.items()):
        K, distortion = opencv_numbers(path, name, camera.camera, 5, "colmap-text, opencv or mrcal")
        values = {
            "K": K.tolist(),
            "Rt": camera.camera_from_rig.matrix[:3].tolist(),
            "distortion": distortion.tolist(),
            "width": camera.camera.width,
            "height": camera.camera.height,
            "matches": 0,
            "valid": True,
            "sn": name,
            "ori": f"{name}.png",
        }
        content |= {f"{view}_{key}": value for key, value in values.items()}
    return write_json(path, content)


FORMAT = Format(
    "facescape",
    "params.json",
    lambda path: lacks_json_key(path, "0_K"),
    read,
    write,
    ("the centre of the top-left pixel is (0, 0), as in OpenCV, with which FaceScape undistorts",),
)
