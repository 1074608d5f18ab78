"""Rigs: bit-exact round trips, and poses that mean what the format says."""

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError, provenance, read_artifact
from preface.capture.rig import (
    Coverage,
    HeldOutError,
    ReprojectionError,
    Rig,
    RigCamera,
    StandardDeviations,
    read_rig,
    write_rig,
)
from preface.geometry.cameras import CAMERA_MODELS, Camera
from preface.geometry.errors import GeometryError
from preface.geometry.transforms import Rigid

finite = st.floats(allow_nan=False, allow_infinity=False)


def lens(model="OPENCV"):
    values = {"f": 1300.1, "fx": 1300.1, "fy": 1299.7, "cx": 511.3, "cy": 770.9, "k1": -0.0812345, "k": 0.01}
    return Camera(model, 1024, 1536, np.array([values.get(name, 1e-5) for name in CAMERA_MODELS[model]]))


def pose(seed=0):
    random = np.random.default_rng(seed)
    return Rigid(Rotation.random(random_state=seed).as_matrix(), random.normal(size=3))


def full_camera():
    count = len(lens().params) + 6
    return RigCamera.at(
        lens(),
        pose(),
        reprojection_error=ReprojectionError(0.21, 1 / 3, 2210),
        standard_deviations=StandardDeviations((0.1,) * 8, (1e-5, 2e-5, 3e-5), (1e-4, 2e-4, 3e-4)),
        covariance=tuple(tuple(row) for row in np.eye(count).tolist()),
        coverage=Coverage(38, 0.91),
    )


def test_everything_that_was_written_is_read(tmp_path):
    rig = Rig(
        "monday",
        {"front": full_camera(), "a": RigCamera.at(lens("PINHOLE"), pose(1))},
        HeldOutError(0.24, 480),
        provenance({"model": "OPENCV"}, {}, seed=0),
        {"note": "x"},
        "arbitrary",
    )
    write_rig(tmp_path / "rig.json", rig)
    again = read_rig(tmp_path / "rig.json")
    assert again == rig
    assert list(again.cameras) == ["front", "a"]


def test_a_rig_is_found_in_its_folder(tmp_path):
    rig = Rig("t", {"front": RigCamera.at(lens(), pose())})
    write_rig(tmp_path / "rig.json", rig)
    assert read_rig(tmp_path) == rig


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_every_camera_model_survives(tmp_path, model):
    rig = Rig("t", {"c": RigCamera.at(lens(model), pose())})
    write_rig(tmp_path / "rig.json", rig)
    assert read_rig(tmp_path / "rig.json").cameras["c"].camera == lens(model)


@given(st.tuples(finite, finite, finite), st.integers(0, 2**32 - 1))
def test_poses_survive_bit_for_bit(tmp_path_factory, translation, seed):
    path = tmp_path_factory.mktemp("rig") / "rig.json"
    before = RigCamera.at(
        lens(), Rigid(Rotation.random(random_state=seed).as_matrix(), np.array(translation))
    )
    write_rig(path, Rig("t", {"c": before}))
    after = read_rig(path).cameras["c"]
    for name in ("quaternion_wxyz", "translation"):
        old, new = getattr(before, name), getattr(after, name)
        assert struct.pack(f"{len(old)}d", *old) == struct.pack(f"{len(new)}d", *new)
    assert before.camera_from_rig.rotation.tobytes() == after.camera_from_rig.rotation.tobytes()


def test_writing_what_was_read_changes_no_bit(tmp_path):
    example = SCHEMA_DIRECTORY / "rig.example.json"
    write_rig(tmp_path / "rig.json", read_rig(example))
    assert read_artifact(tmp_path / "rig.json", "preface/rig") == json.loads(example.read_text())


def test_camera_from_rig_takes_rig_points_to_the_camera():
    camera = read_rig(SCHEMA_DIRECTORY / "rig.example.json").cameras["front"]
    # The example looks from 1.02 m in front of the face, with y up in the rig and down in the camera.
    np.testing.assert_allclose(
        camera.camera_from_rig.apply(np.array([0.0, 0.1, 0.0])), [0, -0.1, 1.02], atol=1e-15
    )


def test_a_pose_given_as_a_rigid_is_kept():
    np.testing.assert_allclose(RigCamera.at(lens(), pose()).camera_from_rig.matrix, pose().matrix, atol=1e-15)


def test_a_folding_lens_is_no_rig_camera():
    with pytest.raises(GeometryError, match="folds inside"):
        RigCamera.at(Camera("SIMPLE_RADIAL", 1000, 1000, np.array([500.0, 500, 500, -0.5])), pose())


def test_statistics_of_the_wrong_size_are_refused():
    with pytest.raises(GeometryError, match="one per param"):
        RigCamera.at(lens(), pose(), standard_deviations=StandardDeviations((0.1,) * 4, (0, 0, 0), (0, 0, 0)))
    with pytest.raises(GeometryError, match="square with 14 rows"):
        RigCamera.at(lens(), pose(), covariance=((1.0,) * 14,) * 13)


def test_names_that_differ_in_case_only_are_not_written(tmp_path):
    camera = RigCamera.at(lens(), pose())
    with pytest.raises(ArtifactError, match=r"cameras\[1\]\.id"):
        write_rig(tmp_path / "rig.json", Rig("t", {"a": camera, "A": camera}))
    assert list(tmp_path.iterdir()) == []


def test_nan_is_not_written(tmp_path):
    camera = RigCamera.at(lens(), pose(), reprojection_error=ReprojectionError(float("nan"), 0.1, 3))
    with pytest.raises(ArtifactError, match=r"cameras\[0\]\.reprojection_error\.rms: is nan"):
        write_rig(tmp_path / "rig.json", Rig("t", {"a": camera}))
    assert list(tmp_path.iterdir()) == []
