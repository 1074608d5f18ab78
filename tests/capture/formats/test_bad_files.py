"""Files that cannot be read: the error names the file, the place in it and a remedy."""

import contextlib
import json
import struct

import numpy as np
import pytest

from preface.artifacts import ArtifactError
from preface.capture.formats import FORMATS, export_rig, read_rig_from

EYE = np.eye(4).tolist()
K = [[1200.0, 0.0, 320.0], [0.0, 1200.0, 240.0], [0.0, 0.0, 1.0]]
POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
MIRRORED = [[-1.0, 0.0, 0.0, 0.0], *POSE[1:]]


def refused(path, format=None):
    with pytest.raises(ArtifactError) as caught:
        read_rig_from(path, format)
    error = caught.value
    assert error.remedy
    assert "  " not in str(error)
    return error


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


NERFSTUDIO = {
    "fl_x": 1200.0, "fl_y": 1200.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480,
    "frames": [{"file_path": "a.png", "transform_matrix": POSE}],
}  # fmt: skip


def frame(**changes):
    return {**NERFSTUDIO, "frames": [NERFSTUDIO["frames"][0] | changes]}


@pytest.mark.parametrize(
    ("content", "field", "problem"),
    [
        ({"frames": NERFSTUDIO["frames"]}, "fl_x", "is missing"),
        ({**NERFSTUDIO, "frames": [{"file_path": "a.png"}]}, "frames[0].transform_matrix", "is missing"),
        (frame(transform_matrix=MIRRORED), "frames[0].transform_matrix", "not a rotation matrix"),
        (frame(transform_matrix=POSE[:2]), "frames[0].transform_matrix", "does not end in"),
        (frame(transform_matrix=[1, 2]), "frames[0].transform_matrix", "has the shape (2,)"),
        (frame(transform_matrix="identity"), "frames[0].transform_matrix", "is 'identity'"),
        (frame(fl_x="1200"), "frames[0].fl_x", "is '1200'"),
        (frame(fl_x=-1200.0), "frames[0]", "params: fx of this FULL_OPENCV camera is -1200.0"),
        (frame(w=640.5), "frames[0].w", "is 640.5"),
        (frame(w=10**9), "frames[0]", "the image size 1000000000 x 480 is impossible"),
        (frame(k4=0.1), "frames[0].k4", "is not zero"),
        (frame(k1=-3.0), "frames[0]", "folds inside its 640x480 image"),
        (frame(camera_model="OPENCV_FISHEYE"), "frames[0].camera_model", "is not a perspective camera"),
        (frame(is_fisheye=True), "frames[0].is_fisheye", "is true"),
        ({**NERFSTUDIO, "frames": NERFSTUDIO["frames"] * 2}, "camera names", "two cameras are called 'a'"),
        ({**NERFSTUDIO, "frames": []}, "file", "holds no camera"),
        ({**NERFSTUDIO, "frames": {}}, "frames", "is {}"),
    ],
)
def test_nerfstudio(tmp_path, content, field, problem):
    error = refused(write(tmp_path / "transforms.json", content), "nerfstudio")
    assert error.path == tmp_path / "transforms.json"
    assert error.field == field
    assert problem in error.problem


CALISCOPE = {"size": [640, 480], "matrix": K, "distortions": [0.0] * 5, "rotation": [0.0] * 3,
             "translation": [0.0, 0.0, 1.0]}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "field", "problem"),
    [
        ({"rotation": None}, "cameras.0", "has no rotation: caliscope has not calibrated its pose yet"),
        ({"rotation": "null"}, "cameras.0", "has no rotation"),
        ({"matrix": None}, "cameras.0", "has not calibrated its lens yet"),
        ({"size": [640]}, "cameras.0.size", "has 1 numbers"),
        ({"size": None}, "cameras.0.size", "is missing"),
        ({"rotation": [[2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]}, "cameras.0.rotation",
         "not a rotation matrix: determinant 2"),
        ({"rotation": [1.0, 2.0]}, "cameras.0.rotation", "has 2 numbers"),
        ({"rotation": [1e200, 1e200, 0.0]}, "cameras.0.rotation", "is not finite"),
        ({"translation": [1.0]}, "cameras.0.translation", "has 1 numbers"),
        ({"matrix": [[1200.0, 0.0], [0.0, 1200.0]]}, "cameras.0.matrix", "has the shape (2, 2)"),
        ({"matrix": [[1200.0, 0.5, 1.0], K[1], K[2]]}, "cameras.0", "its skew 0.5 is not zero"),
        ({"distortions": [0.0] * 8 + [0.1] * 4}, "cameras.0", "has more than k1 k2 p1 p2 k3 k4 k5 k6"),
        ({"distortions": [True]}, "cameras.0.distortions", "is no regular list of numbers"),
        ({"fisheye": True}, "cameras.0.fisheye", "is true"),
    ],
)  # fmt: skip
def test_caliscope(tmp_path, changes, field, problem):
    values = {key: value for key, value in (CALISCOPE | changes).items() if value is not None}
    lines = [f"{key} = {json.dumps(value)}" for key, value in values.items()]
    error = refused(write(tmp_path / "camera_array.toml", "[cameras.0]\n" + "\n".join(lines)), "caliscope")
    assert error.field == field
    assert problem in error.problem


def test_anipose_without_a_name(tmp_path):
    lines = [f"{key} = {json.dumps(value)}" for key, value in CALISCOPE.items()]
    error = refused(write(tmp_path / "c.toml", "[cam_0]\n" + "\n".join(lines)), "anipose")
    assert error.field == "cam_0.name"


@pytest.mark.parametrize("text", ["[cameras", "a = 1\na = 2", "x = " + "[" * 5000, "\xff"])
def test_broken_toml(tmp_path, text):
    (tmp_path / "c.toml").write_bytes(text.encode("latin-1"))
    error = refused(tmp_path / "c.toml", "anipose")
    assert "TOML" in error.problem or "UTF-8" in error.problem


@pytest.mark.parametrize(
    ("text", "field", "problem"),
    [
        ("{", "file", "is no dictionary of plain values"),
        ("__import__('os').abort()", "file", "is no dictionary of plain values"),
        ("(" * 100_000, "file", "is no dictionary of plain values"),
        ("[1, 2]", "file", "is [1, 2]"),
        ("{'lensmodel': {(1, 2): b'x'}}", "lensmodel", "is of type dict"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [1" + "0" * 400 + ", 1, 2, 3]}", "intrinsics",
         "is no regular list of numbers"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': " + "[" * 90 + "]" * 90 + "}", "intrinsics",
         "is no regular list of numbers"),
        ("{}", "lensmodel", "is missing"),
        ("{'lensmodel': 'LENSMODEL_CAHVOR'}", "lensmodel", "is not one of LENSMODEL_PINHOLE"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE'}", "intrinsics", "is missing"),
        ("{'lensmodel': 'LENSMODEL_OPENCV4', 'intrinsics': [1, 2, 3, 4]}", "intrinsics", "has the shape (4,)"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [9e3, 9e3, 3, 4], 'imagersize': [64, 48]}",
         "extrinsics", "is missing"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [9e3, 9e3, 3, 4], 'imagersize': [64, 48], "
         "'extrinsics': [0, 0, 0, 0, 0]}", "extrinsics", "has the shape (5,)"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [9e999, 9e3, 3, 4], 'imagersize': [64, 48]}",
         "intrinsics", "is no regular list of numbers"),
    ],
)  # fmt: skip
def test_mrcal(tmp_path, text, field, problem):
    error = refused(write(tmp_path / "a.cameramodel", text))
    assert error.path == tmp_path / "a.cameramodel"
    assert error.field == field
    assert problem in error.problem


@pytest.mark.parametrize(
    ("text", "field", "problem"),
    [
        ("K: 1", "file", "OpenCV cannot parse it"),
        ("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1., 2. ]\n",
         "file", "OpenCV cannot parse it"),
        ("%YAML:1.0\n---\nimage_width: 640\nR: [0., 0., 0.]\n", "K", "is missing"),
        ("%YAML:1.0\n---\nK: [1., 2.]\nD: [0.]\nR: [0., 0., 0.]\nT: [0., 0., 1.]\nimage_width: 640\n"
         "image_height: 480\n", "K", "has the shape (2,)"),
        ("%YAML:1.0\n---\nK: [[9e3,0,320],[0,9e3,240],[0,0,1]]\nD: [0.]\nR: [0., 0., 0.]\nT: [0., 0., 1.]\n"
         "image_width: 640\n", "image_height", "is missing"),
        ("", "file", "OpenCV cannot parse it"),
    ],
)  # fmt: skip
def test_opencv(tmp_path, text, field, problem):
    error = refused(write(tmp_path / "a.yml", text), "opencv")
    assert error.field == field
    assert problem in error.problem


@pytest.mark.parametrize(
    ("format", "content", "field", "problem"),
    [
        ("facescape", {"0_K": K, "0_valid": True}, "0_distortion", "is missing"),
        ("facescape", {"0_K": K, "0_valid": False}, "file", "holds no camera"),
        ("nersemble", {"world_2_cam": {"a": POSE}}, "intrinsics", "is missing"),
        ("nersemble", {"world_2_cam": {"a": POSE}, "intrinsics": {"b": K}}, "intrinsics.a", "is missing"),
        ("nersemble", {"world_2_cam": {"a": POSE}, "intrinsics": [[9e3, 0, 900], [0, 9e3, 100], [0, 0, 1]]},
         "intrinsics", "is not near the centre"),
        ("nersemble", {"world_2_cam": {"a": MIRRORED}, "intrinsics": K, "image_size": [640, 480]},
         "world_2_cam.a", "not a rotation matrix"),
        ("cafca", {"world2cam": POSE, "K": K}, "file", "the image size is not in the file"),
        ("cafca", {"world2cam": POSE, "cam2world": POSE, "K": K}, "cam2world", "is not the inverse of world2cam"),
        ("cafca", {"world2cam": POSE, "K": K, "radial_distortion": [0.1, 0, 0]}, "radial_distortion", "is not zero"),
    ],
)  # fmt: skip
def test_datasets(tmp_path, format, content, field, problem):
    error = refused(write(tmp_path / "file.json", content), format)
    assert error.field == field
    assert problem in error.problem


# ---------------------------------------------------------------------------------------- COLMAP


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "rigs.bin", "frames.bin"])
def test_colmap_binaries_truncated_anywhere(tmp_path, name, pinhole_rig):
    folder = export_rig(pinhole_rig, tmp_path / "model", "colmap-binary")
    data = (folder / name).read_bytes()
    for size in range(len(data)):
        (folder / name).write_bytes(data[:size])
        error = refused(folder, "colmap-binary")
        assert error.path == folder / name
        assert "the file ends in the middle of it" in error.problem
    (folder / name).write_bytes(data + b"\0")
    assert "1 bytes follow" in refused(folder, "colmap-binary").problem


def test_colmap_binary_with_an_absurd_count(tmp_path, rig):
    folder = export_rig(rig, tmp_path / "model", "colmap-binary")
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2**63))
    assert refused(folder).field == "image 1"


def test_colmap_binary_with_an_unknown_model(tmp_path, rig):
    folder = export_rig(rig, tmp_path / "model", "colmap-binary")
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ", 1, 1, 99, 640, 480) + bytes(64))
    assert "model id 99 is not one of 0 (SIMPLE_PINHOLE)" in refused(folder).problem


@pytest.mark.parametrize(
    ("name", "old", "new", "field", "problem"),
    [
        ("cameras.txt", "PINHOLE 640", "OPENCV_FISHEYE 640", "camera 1", "'OPENCV_FISHEYE' is not one of"),
        ("cameras.txt", "PINHOLE 640", "PINHOLE 64x", "line 2, WIDTH", "'64x' is not a whole number"),
        ("cameras.txt", "1250.25", "x", "line 2, PARAMS[0]", "'x' is not a number"),
        ("cameras.txt", "1250.25", "nan", "camera 1", "fx of this PINHOLE camera is nan"),
        ("cameras.txt", "1250.25 ", "", "camera 1", "PINHOLE takes 4 numbers"),
        ("cameras.txt", "640", "0", "camera 1", "the image size 0 x 480 is impossible"),
        ("images.txt", " 1 cam.0-PINHOLE.png", "", "line 3, CAMERA_ID", "the line ends before it"),
        ("images.txt", " cam.0-PINHOLE.png", "", "line 3, NAME", "the line ends before it"),
        ("images.txt", " 1 cam.0-PINHOLE", " 77 cam.0-PINHOLE", "image 1 (cam.0-PINHOLE.png)",
         "its camera 77 is not in cameras.txt"),
        ("images.txt", "cam.1-SIMPLE_RADIAL", "CAM.0-pinhole", "camera names", "two cameras are called"),
        ("rigs.txt", "CAMERA 1 ", "IMU 1 ", "line 2, REF_SENSOR_TYPE", "is not CAMERA"),
        ("frames.txt", "CAMERA 2 2", "CAMERA 2 9", "image 2 (cam.1-SIMPLE_RADIAL.png)", "belongs to no frame"),
        ("frames.txt", "CAMERA 2 2", "CAMERA 3 2", "image 2 (cam.1-SIMPLE_RADIAL.png)", "does not have its camera"),
        ("images.txt", " -0.02 ", " 0.02 ", "image 1 (cam.0-PINHOLE.png)", "differs from that of its frame"),
    ],
)  # fmt: skip
def test_colmap_text(tmp_path, name, old, new, field, problem, rig):
    folder = export_rig(rig, tmp_path / "model", "colmap-text")
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))
    error = refused(folder)
    assert error.path in (folder / name, folder / "frames.txt")
    assert error.field == field
    assert problem in error.problem


# -------------------------------------------------------------------------------------- any damage


@pytest.mark.parametrize("format", FORMATS)
def test_damage_is_refused_or_harmless(tmp_path, format, rig, pinhole_rig):
    random = np.random.default_rng(0)
    original = pinhole_rig if format in ("cafca", "nersemble") else rig
    written = export_rig(original, tmp_path / ("rig.yml" if format == "opencv" else "rig.json"), format)
    files = sorted(written.iterdir()) if written.is_dir() else [written]
    for _ in range(30):
        file = files[random.integers(len(files))]
        data = file.read_bytes()
        damaged = bytearray(data)
        for place in random.integers(len(data), size=random.integers(1, 4)):
            damaged[place] = random.choice([*b"0-.[]{}'e, \n\"", random.integers(256)])
        file.write_bytes(damaged)
        with contextlib.suppress(ArtifactError):
            assert read_rig_from(written, format).cameras
        file.write_bytes(data)


# ------------------------------------------------------------------------------------- detection


def test_what_is_of_no_format_says_what_was_tried(tmp_path):
    error = refused(write(tmp_path / "notes.json", {"a": 1}))
    for name in (
        "colmap-text",
        "nerfstudio",
        "opencv",
        "anipose",
        "facescape",
        "mrcal",
        "cafca",
        "nersemble",
    ):
        assert name in error.problem
    assert "has no 'frames'" in error.problem


def test_broken_json_is_said_once(tmp_path):
    problem = refused(write(tmp_path / "transforms.json", '{"frames": [')).problem
    assert problem.count("not valid JSON") == 1


def test_what_does_not_exist(tmp_path):
    assert refused(tmp_path / "nothing").problem == "does not exist"


def test_an_empty_folder(tmp_path):
    assert "is of no known format" in refused(tmp_path).problem
    for format in ("mrcal", "cafca", "opencv", "colmap-text"):
        refused(tmp_path, format)
