"""Each format means what its own program means by it: points land on the same pixel.

The pixel is computed from the exported file without any code of this package: by pycolmap, by
`cv2.projectPoints` (whose top-left pixel has its centre at (0, 0), so that 0.5 is added), by a projection
matrix, or by OpenGL's rules written out.
"""

import ast
import json
import tomllib

import cv2
import numpy as np
import pycolmap
import pytest

from preface.capture.formats import export_rig, read_rig_from

POINT = np.array([0.0312, -0.0475, 0.0621])


def ours(rig):
    """The pixel of `POINT` in each camera."""
    pixels = {}
    for name, camera in rig.cameras.items():
        pixel, valid = camera.camera.project(camera.camera_from_rig.apply(POINT))
        assert valid
        pixels[name] = pixel.tolist()
    return pixels


def by_opencv(K, distortion, rotation, translation):
    """OpenCV's pixel of `POINT`, moved to COLMAP's convention."""
    rotation = np.array(rotation, dtype=float)
    rotation = rotation.ravel() if rotation.size == 3 else cv2.Rodrigues(rotation)[0]
    pixel, _ = cv2.projectPoints(
        POINT[None], rotation, np.array(translation, float), np.array(K), np.array(distortion, float)
    )
    return (pixel.ravel() + 0.5).tolist()


def check(found, expected):
    assert found.keys() == expected.keys()
    for name, pixel in expected.items():
        assert found[name] == pytest.approx(pixel, abs=1e-9)


@pytest.mark.parametrize("format", ["colmap-text", "colmap-binary"])
def test_pycolmap_reads_our_rigs_and_frames(tmp_path, format, full_rig):
    model = pycolmap.Reconstruction(export_rig(full_rig, tmp_path / "model", format))
    images = {image.name.removesuffix(".png"): image.project_point(POINT) for image in model.images.values()}
    check(images, ours(full_rig))
    assert (model.num_rigs(), model.num_frames(), model.num_reg_images()) == (1, 1, len(full_rig.cameras))
    assert model.rigs[1].num_sensors() == len(full_rig.cameras)


def test_nerfstudio_looks_along_minus_z(tmp_path, rig):
    document = json.loads(export_rig(rig, tmp_path / "transforms.json", "nerfstudio").read_text())
    pixels = {}
    for frame in document["frames"]:
        x, y, z, _ = np.linalg.solve(np.array(frame["transform_matrix"]), [*POINT, 1])
        assert z < 0
        right, up = x / -z, y / -z
        a, b = right, -up  # the image's y points down
        r2 = a * a + b * b
        radial = 1 + frame["k1"] * r2 + frame["k2"] * r2**2 + frame["k3"] * r2**3
        p1, p2 = frame["p1"], frame["p2"]
        u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        v = b * radial + 2 * p2 * a * b + p1 * (r2 + 2 * b * b)
        name = frame["file_path"].removeprefix("images/").removesuffix(".png")
        pixels[name] = [frame["fl_x"] * u + frame["cx"], frame["fl_y"] * v + frame["cy"]]
    check(pixels, ours(rig))


@pytest.mark.parametrize("suffix", ["yml", "json"])
def test_opencv_projects_from_its_own_file(tmp_path, suffix, full_rig):
    storage = cv2.FileStorage(
        export_rig(full_rig, tmp_path / f"rig.{suffix}", "opencv"), cv2.FILE_STORAGE_READ
    )
    cameras = storage.getNode("cameras")
    pixels = {}
    for camera in (cameras.at(index) for index in range(cameras.size())):
        matrices = [camera.getNode(key).mat() for key in "KDRT"]
        pixels[camera.getNode("id").string()] = by_opencv(*matrices)
    check(pixels, ours(full_rig))


def test_anipose_has_rotation_vectors_and_opencv_pixels(tmp_path, rig):
    document = tomllib.loads(export_rig(rig, tmp_path / "c.toml", "anipose").read_text())
    tables = [table for key, table in document.items() if key != "metadata"]
    pixels = {
        t["name"]: by_opencv(t["matrix"], t["distortions"], t["rotation"], t["translation"]) for t in tables
    }
    assert all(len(table["rotation"]) == 3 and table["size"] == [640, 480] for table in tables)
    check(pixels, ours(rig))


def test_caliscope_has_numbered_cameras_and_opencv_pixels(tmp_path, rig):
    tables = tomllib.loads(export_rig(rig, tmp_path / "c.toml", "caliscope").read_text())["cameras"]
    pixels = {
        t["name"]: by_opencv(t["matrix"], t["distortions"], t["rotation"], t["translation"])
        for t in tables.values()
    }
    assert [int(number) for number in tables] == [t["cam_id"] for t in tables.values()] == list(range(5))
    check(pixels, ours(rig))


def test_facescape_has_nine_keys_per_view_and_opencv_pixels(tmp_path, rig):
    params = json.loads(export_rig(rig, tmp_path / "params.json", "facescape").read_text())
    views = len(params) // 9  # how FaceScape's own code counts them
    assert views == len(rig.cameras)
    pixels = {}
    for view in range(views):
        Rt = np.array(params[f"{view}_Rt"])
        pixels[params[f"{view}_sn"]] = by_opencv(
            params[f"{view}_K"], params[f"{view}_distortion"], Rt[:, :3], Rt[:, 3]
        )
    check(pixels, ours(rig))


def test_mrcal_has_rotation_vectors_and_opencv_pixels(tmp_path, full_rig):
    folder = export_rig(full_rig, tmp_path / "models", "mrcal")
    pixels, models = {}, {}
    for file in folder.iterdir():
        model = ast.literal_eval(file.read_text())
        fx, fy, cx, cy, *distortion = model["intrinsics"]
        K, rt = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], model["extrinsics"]
        name = file.name.removesuffix(".cameramodel")
        pixels[name] = by_opencv(K, distortion or [0.0] * 4, rt[:3], rt[3:])
        models[name] = (model["lensmodel"], len(distortion))
    check(pixels, ours(full_rig))
    assert set(models.values()) == {
        ("LENSMODEL_PINHOLE", 0), ("LENSMODEL_OPENCV4", 4), ("LENSMODEL_OPENCV8", 8)
    }  # fmt: skip


def test_cafca_projects_with_its_projection_matrix(tmp_path, pinhole_rig):
    folder = export_rig(pinhole_rig, tmp_path / "cameras_json", "cafca")
    pixels = {}
    for file in folder.iterdir():
        camera = json.loads(file.read_text())
        u, v, w = np.array(camera["P"]) @ [*POINT, 1]
        pixels[file.stem] = [u / w, v / w]
        assert np.array(camera["cam2world"])[:3, 3] == pytest.approx(camera["position"])
        axis = np.array(camera["orientation"])[2]  # its rows are the camera's axes in the world
        assert axis @ (POINT - camera["position"]) == pytest.approx(w)
    check(pixels, ours(pinhole_rig))


def test_nersemble_takes_points_from_world_to_camera(tmp_path, pinhole_rig):
    document = json.loads(export_rig(pinhole_rig, tmp_path / "camera_params.json", "nersemble").read_text())
    pixels = {}
    for serial, matrix in document["world_2_cam"].items():
        matrix = np.array(matrix)
        pixels[serial] = by_opencv(document["intrinsics"][serial], [0.0] * 4, matrix[:3, :3], matrix[:3, 3])
    check(pixels, ours(pinhole_rig))


def test_reading_undoes_writing_to_the_pixel(tmp_path, rig):
    for format, name in {"nerfstudio": "t.json", "mrcal": "m", "anipose": "a.toml"}.items():
        check(ours(read_rig_from(export_rig(rig, tmp_path / name, format))), ours(rig))
