"""Files as other programs write them, in the variants that exist, give the cameras they describe."""

import json

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from preface.artifacts import ArtifactError
from preface.capture.formats import export_rig, read_rig_from
from preface.capture.formats.format import as_id, ids_of_images
from preface.capture.images import write_png

POINT = np.array([0.03, -0.05, 0.06])
K = [[1200.5, 0.0, 319.5], [0.0, 1201.5, 239.5], [0.0, 0.0, 1.0]]
DISTORTION = [-0.1, 0.02, 1e-3, -5e-4, 0.003]
ROTVEC = np.array([0.1, -0.2, 0.05])
ROTATION = Rotation.from_rotvec(ROTVEC).as_matrix()
TRANSLATION = np.array([0.01, -0.02, 1.1])
POSE = np.block([[ROTATION, TRANSLATION[:, None]], [np.zeros(3), 1.0]])


def expected(distortion=DISTORTION):
    """OpenCV's pixel of `POINT` for the camera above, with the top-left pixel's centre at (0, 0)."""
    pixel, _ = cv2.projectPoints(POINT[None], ROTVEC, TRANSLATION, np.array(K), np.array(distortion, float))
    return pixel.ravel()


def pixel(rig, name):
    camera = rig.cameras[name]
    return camera.camera.project(camera.camera_from_rig.apply(POINT))[0]


@pytest.mark.parametrize("rotation", [ROTVEC.tolist(), ROTATION.tolist()])
@pytest.mark.parametrize("number", ["port", "cam_id"])
def test_caliscope_of_all_ages(tmp_path, rotation, number):
    (tmp_path / "camera_array.toml").write_text(
        f"[cameras.3]\n{number} = 3\nrotation_count = 0\nerror = 0.5\nexposure = -8\ngrid_count = 39\n"
        f"ignore = false\nsize = [640, 480]\nmatrix = {K}\ndistortions = {DISTORTION}\n"
        f"translation = {TRANSLATION.tolist()}\nrotation = {rotation}\n\n"
        f"[cameras.4]\n{number} = 4\nignore = true\nsize = [640, 480]\nrotation = 'null'\n"
    )
    rig = read_rig_from(tmp_path)
    assert list(rig.cameras) == ["3"]
    assert pixel(rig, "3") == pytest.approx(expected() + 0.5, abs=1e-9)


def test_anipose_with_metadata(tmp_path):
    (tmp_path / "calibration.toml").write_text(
        f'[cam_0]\nname = "cam A"\nsize = [ 640, 480,]\nmatrix = {K}\ndistortions = {DISTORTION}\n'
        f"rotation = {ROTVEC.tolist()}\ntranslation = {TRANSLATION.tolist()}\n\n"
        "[metadata]\nadjusted = true\nerror = 1.67\n"
    )
    rig = read_rig_from(tmp_path / "calibration.toml")
    assert pixel(rig, "cam-A") == pytest.approx(expected() + 0.5, abs=1e-9)


@pytest.mark.parametrize(
    ("model", "pose"),
    [("lens_model", "extrinsics"), ("lensmodel", "extrinsics"), ("lensmodel", "rt_cam_ref")],
)
def test_mrcal_of_all_ages(tmp_path, model, pose):
    (tmp_path / "front.cameramodel").write_text(
        f"# a note\n{{\n    '{model}':  'LENSMODEL_OPENCV5',\n\n    # fx,fy,cx,cy,...\n"
        f"    'intrinsics': [ 1200.5, 1201.5, 319.5, 239.5, {', '.join(map(str, DISTORTION))},],\n"
        f"    '{pose}': [ {', '.join(map(str, [*ROTVEC, *TRANSLATION]))},],\n    'imagersize': [ 640, 480,],\n"
        "    'optimization_inputs': b'P)h>@6aWAK',\n}\n"
    )
    for source in (tmp_path, tmp_path / "front.cameramodel"):
        assert pixel(read_rig_from(source), "front") == pytest.approx(expected() + 0.5, abs=1e-9)


def opencv_file(path, **values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()


@pytest.mark.parametrize("suffix", ["yml", "yaml", "json"])
@pytest.mark.parametrize("rotation", [ROTVEC[:, None], ROTATION])
def test_opencv_files_of_one_camera_each(tmp_path, suffix, rotation):
    names = {"camera_matrix": np.array(K), "distortion_coefficients": np.array(DISTORTION)[:, None]}
    size = {"image_width": 640, "image_height": 480}
    opencv_file(tmp_path / f"left.{suffix}", **size, **names, R=rotation, T=TRANSLATION)
    opencv_file(tmp_path / f"right.{suffix}", **size, K=np.array(K), D=np.zeros(5), R=rotation, T=TRANSLATION)
    rig = read_rig_from(tmp_path)
    assert pixel(rig, "left") == pytest.approx(expected() + 0.5, abs=1e-9)
    assert pixel(rig, "right") == pytest.approx(expected([0.0] * 5) + 0.5, abs=1e-9)
    assert list(read_rig_from(tmp_path / f"right.{suffix}").cameras) == ["right"]


def facescape(**changes):
    view = {"K": K, "Rt": POSE[:3].tolist(), "distortion": DISTORTION, "width": 640, "height": 480,
            "matches": 9, "valid": True, "sn": "0815", "ori": "a.jpg"} | changes  # fmt: skip
    return view


def test_facescape_without_its_invalid_views(tmp_path):
    views = {
        0: facescape(),
        1: facescape(valid=False, K=None),
        10: facescape(sn="4711"),
        2: facescape(sn="7"),
    }
    params = {f"{view}_{key}": value for view, values in views.items() for key, value in values.items()}
    (tmp_path / "params.json").write_text(json.dumps(params))
    rig = read_rig_from(tmp_path)
    assert list(rig.cameras) == ["0815", "7", "4711"]
    assert pixel(rig, "4711") == pytest.approx(expected() + 0.5, abs=1e-9)
    assert "(0, 0)" in rig.metadata["imported"]["assumptions"][0]


def test_facescape_views_go_by_number_where_serial_numbers_repeat(tmp_path):
    params = {f"{view}_{key}": value for view in (0, 1) for key, value in facescape().items()}
    (tmp_path / "params.json").write_text(json.dumps(params))
    assert list(read_rig_from(tmp_path).cameras) == ["0", "1"]


@pytest.mark.parametrize("scale", [1, 0.5, 0.25])
def test_nersemble_sizes_follow_from_the_principal_point(tmp_path, scale):
    intrinsics = [[8200 * scale, 0, 1105 * scale], [0, 8200 * scale, 1590 * scale], [0, 0, 1]]
    content = {"world_2_cam": {"220700191": POSE.tolist()}, "intrinsics": intrinsics}
    (tmp_path / "camera_params.json").write_text(json.dumps(content))
    camera = read_rig_from(tmp_path).cameras["220700191"].camera
    assert (camera.width, camera.height) == (2200 * scale, 3208 * scale)


def test_nersemble_shares_intrinsics_where_cameras_do(tmp_path, pinhole_rig):
    first = next(iter(pinhole_rig.cameras.values()))
    shared = type(pinhole_rig)("t", {"a": first, "b": first})
    content = json.loads(export_rig(shared, tmp_path / "camera_params.json", "nersemble").read_text())
    assert np.shape(content["intrinsics"]) == (3, 3)
    assert read_rig_from(tmp_path).cameras["b"].camera == first.camera


def test_cafca_takes_the_size_from_the_image(tmp_path):
    (tmp_path / "cameras_json").mkdir()
    (tmp_path / "color_image").mkdir()
    camera = {"K": K, "world2cam": POSE.tolist(), "cam2world": np.linalg.inv(POSE).tolist()}
    (tmp_path / "cameras_json/C07.json").write_text(json.dumps(camera))
    write_png(tmp_path / "color_image/C07.png", np.zeros((480, 640, 3), np.uint8))
    rig = read_rig_from(tmp_path / "cameras_json")
    assert (rig.cameras["C07"].camera.width, rig.cameras["C07"].camera.height) == (640, 480)
    assert pixel(rig, "C07") == pytest.approx(expected([0.0] * 5), abs=1e-9)  # (0.5, 0.5): K is ours


def nerfstudio(tmp_path, frames, **shared):
    (tmp_path / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    return read_rig_from(tmp_path)


def test_nerfstudio_intrinsics_once_or_per_frame(tmp_path):
    opengl = (np.linalg.inv(POSE) @ np.diag([1.0, -1, -1, 1])).tolist()
    intrinsics = {"fl_x": 1200.5, "fl_y": 1201.5, "cx": 319.5, "cy": 239.5, "w": 640, "h": 480}
    own = {"k1": -0.1, "k2": 0.02, "p1": 1e-3, "p2": -5e-4, "k3": 0.003}
    frames = [
        {"file_path": "./images/a.jpg", "transform_matrix": opengl, **own},
        {"file_path": "./images/b.jpg", "transform_matrix": opengl[:3]},
    ]
    rig = nerfstudio(tmp_path, frames, **intrinsics, camera_model="OPENCV", k1=0.0)
    assert pixel(rig, "a") == pytest.approx(expected(), abs=1e-9)
    assert pixel(rig, "b") == pytest.approx(expected([0.0] * 5), abs=1e-9)


# ---------------------------------------------------------------------------------------- COLMAP


@pytest.mark.parametrize("format", ["colmap-text", "colmap-binary"])
def test_colmap_models_from_before_rigs(tmp_path, format, full_rig):
    folder = export_rig(full_rig, tmp_path / "model", format)
    for file in [*folder.glob("rigs.*"), *folder.glob("frames.*")]:
        file.unlink()
    assert read_rig_from(folder).cameras == full_rig.cameras


def moving_rig(images=("left/{}.png", "right/{}.png"), frames=3):
    """pycolmap's model of two cameras that see a point from several places."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for number in (1, 2):
        model.add_camera(pycolmap.Camera(camera_id=number, model="OPENCV", width=640, height=480,
                                         params=[1200.5, 1201.5, 320, 240, -0.1, 0.02, 1e-3, -5e-4]))  # fmt: skip
    left, right = (pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number) for number in (1, 2))
    rig.add_ref_sensor(left)
    rig.add_sensor(right, pycolmap.Rigid3d(POSE[:3]))
    model.add_rig(rig)
    for number in range(1, frames + 1):
        turn = Rotation.from_rotvec([0.1 * number, 0, 0]).as_matrix()
        frame = pycolmap.Frame(frame_id=number, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(np.column_stack([turn, [0, 0, 1.0]]))
        ids = (2 * number - 1, 2 * number)
        for sensor, image in zip((left, right), ids, strict=True):
            frame.add_data_id(pycolmap.data_t(sensor, image))
        model.add_frame(frame)
        for camera, image in enumerate(ids, start=1):
            name = images[camera - 1].format(number)
            model.add_image(pycolmap.Image(image_id=image, camera_id=camera, frame_id=number, name=name))
        model.register_frame(number)
    return model


@pytest.mark.parametrize("binary", [True, False])
def test_a_colmap_rig_at_several_instants_is_one_rig(tmp_path, binary):
    model = moving_rig()
    model.write_binary(tmp_path) if binary else model.write_text(tmp_path)
    rig = read_rig_from(tmp_path)
    assert list(rig.cameras) == ["left", "right"]
    assert rig.cameras["left"].camera_from_rig.matrix.tolist() == np.eye(4).tolist()
    theirs = model.cameras[2].img_from_cam(ROTATION @ POINT + TRANSLATION)
    assert pixel(rig, "right") == pytest.approx(theirs, abs=1e-9)


def test_cameras_of_a_colmap_rig_without_folders_go_by_number(tmp_path):
    moving_rig(images=("l{}.png", "r{}.png")).write_binary(tmp_path)
    assert list(read_rig_from(tmp_path).cameras) == ["camera1", "camera2"]


@pytest.mark.parametrize("binary", [True, False])
def test_a_colmap_rig_at_one_instant_has_its_images_as_cameras(tmp_path, binary):
    model = moving_rig(frames=1)
    model.write_binary(tmp_path) if binary else model.write_text(tmp_path)
    rig = read_rig_from(tmp_path)
    assert list(rig.cameras) == ["left-1", "right-1"]
    for image in model.images.values():
        name = image.name.replace("/", "-").removesuffix(".png")
        assert pixel(rig, name) == pytest.approx(image.project_point(POINT), abs=1e-9)


def test_two_colmap_layouts_in_one_folder_must_be_told_apart(tmp_path):
    model = moving_rig()
    model.write_binary(tmp_path)
    model.write_text(tmp_path)
    with pytest.raises(ArtifactError, match="it can be read as colmap-text, colmap-binary"):
        read_rig_from(tmp_path)
    assert list(read_rig_from(tmp_path, "colmap-text").cameras) == ["left", "right"]


# ----------------------------------------------------------------------------------------- names


def test_image_names_become_ids():
    assert ids_of_images(["./images/front.JPG", "images/side.v2.png"]) == ["front", "side.v2"]
    assert ids_of_images(["left/0001.png", "right/0001.png"]) == ["left-0001", "right-0001"]
    assert ids_of_images(["frame 7 (copy).png"]) == ["frame-7-copy-"]
    assert as_id("../Kamera Ü") == "Kamera-"
