"""What is written is read again: lenses and translations bit for bit, rotations to rounding."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from preface.artifacts import ArtifactError
from preface.capture.formats import FORMATS, detect, export_rig, read_rig_from
from preface.capture.rig import (
    Coverage,
    Rig,
    RigCamera,
    read_rig,
    write_rig,
)
from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid

FILE_NAMES = {
    "colmap-text": "model",
    "colmap-binary": "model",
    "nerfstudio": "transforms.json",
    "opencv": "rig.yml",
    "anipose": "calibration.toml",
    "caliscope": "camera_array.toml",
    "facescape": "params.json",
    "mrcal": "models",
    "cafca": "cameras_json",
    "nersemble": "camera_params.json",
}
WITHOUT_DISTORTION = ("cafca", "nersemble")
WITH_EVERY_COEFFICIENT = ("colmap-text", "colmap-binary", "opencv", "mrcal")
# What a rotation may lose: a conversion to a matrix and back, or to a rotation vector and back.
ROTATION_LOSS = {"colmap-text": 0, "colmap-binary": 0, "anipose": 1e-12, "mrcal": 1e-12}


def round_trip(rig, format, tmp_path):
    return read_rig_from(export_rig(rig, tmp_path / FILE_NAMES[format], format))


def assert_same(rig, again, format):
    assert list(again.cameras) == list(rig.cameras)
    for name, camera in rig.cameras.items():
        found = again.cameras[name]
        assert (found.camera.width, found.camera.height) == (camera.camera.width, camera.camera.height)
        assert found.camera.intrinsics.tolist() == camera.camera.intrinsics.tolist()
        turned = found.camera_from_rig.rotation - camera.camera_from_rig.rotation
        assert np.abs(turned).max() <= ROTATION_LOSS.get(format, 1e-15)
        if format == "nerfstudio":  # it stores the camera's centre instead of the translation
            assert found.translation == pytest.approx(camera.translation, rel=1e-15, abs=1e-15)
        else:
            assert found.translation == camera.translation


def rig_for(format, rig, full_rig, pinhole_rig):
    if format in WITHOUT_DISTORTION:
        return pinhole_rig
    return full_rig if format in WITH_EVERY_COEFFICIENT else rig


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_reads_what_it_wrote(tmp_path, format, rig, full_rig, pinhole_rig):
    original = rig_for(format, rig, full_rig, pinhole_rig)
    assert_same(original, round_trip(original, format, tmp_path), format)


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_is_recognised(tmp_path, format, rig, full_rig, pinhole_rig):
    written = export_rig(rig_for(format, rig, full_rig, pinhole_rig), tmp_path / FILE_NAMES[format], format)
    assert detect(written) == format
    assert read_rig_from(written).metadata["imported"]["format"] == format


def test_opencv_json_is_as_good_as_yaml(tmp_path, full_rig):
    written = export_rig(full_rig, tmp_path / "rig.json", "opencv")
    assert detect(written) == "opencv"
    assert_same(full_rig, read_rig_from(written), "opencv")


@pytest.mark.parametrize("format", ["colmap-text", "colmap-binary"])
def test_colmap_keeps_models_and_quaternions(tmp_path, format, full_rig):
    assert round_trip(full_rig, format, tmp_path).cameras == full_rig.cameras


@pytest.mark.parametrize("format", FORMATS)
def test_an_imported_rig_is_a_valid_artefact(tmp_path, format, rig, full_rig, pinhole_rig):
    imported = round_trip(rig_for(format, rig, full_rig, pinhole_rig), format, tmp_path)
    write_rig(tmp_path / "rig.json", imported)
    assert read_rig(tmp_path / "rig.json") == imported


number = st.floats(-1, 1)


@settings(max_examples=15, deadline=None)
@given(
    focal=st.tuples(st.floats(100, 1e5), st.floats(100, 1e5)),
    # Nearer to the image's corner than a quarter pixel, the step from (0.5, 0.5) to (0, 0) rounds.
    center=st.tuples(st.floats(0.25, 1e4), st.floats(0.25, 1e4)),
    axis=st.tuples(number, number, number).filter(lambda axis: np.linalg.norm(axis) > 1e-3),
    angle=st.floats(0, np.pi),
    translation=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
)
@pytest.mark.parametrize("format", ["colmap-text", "opencv", "caliscope", "mrcal", "anipose", "facescape"])
def test_any_numbers_survive(tmp_path_factory, format, focal, center, axis, angle, translation):
    rotation = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    lens = Camera("PINHOLE", 64, 48, np.array([*focal, *center]))
    rig = Rig("t", {"a": RigCamera.at(lens, Rigid(rotation, np.array(translation)))})
    assert_same(rig, round_trip(rig, format, tmp_path_factory.mktemp("any")), format)


def test_a_folder_stands_for_the_usual_file_in_it(tmp_path, rig):
    assert export_rig(rig, tmp_path, "nerfstudio") == tmp_path / "transforms.json"
    assert list(read_rig_from(tmp_path).cameras) == list(rig.cameras)


def test_statistics_are_left_behind(tmp_path, rig):
    seen = {name: RigCamera(c.camera, c.quaternion_wxyz, c.translation, coverage=Coverage(3, 0.5))
            for name, c in rig.cameras.items()}  # fmt: skip
    again = round_trip(Rig("t", seen), "colmap-text", tmp_path)
    assert again.cameras == rig.cameras


# -------------------------------------------------------------------- what a format cannot hold


@pytest.mark.parametrize("format", ["nerfstudio", "anipose", "caliscope", "facescape"])
def test_a_rational_lens_is_refused_where_it_does_not_fit(tmp_path, format, full_rig):
    with pytest.raises(ArtifactError, match=r"cameras\.cam\.4-FULL_OPENCV: its k4, k5, k6 cannot") as caught:
        export_rig(full_rig, tmp_path / FILE_NAMES[format], format)
    assert "Export to colmap-text" in caught.value.remedy
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", WITHOUT_DISTORTION)
def test_distortion_is_refused_where_there_is_none(tmp_path, format, rig):
    with pytest.raises(ArtifactError, match=r"cameras\.cam\.1-SIMPLE_RADIAL: its .* cannot be written"):
        export_rig(rig, tmp_path / FILE_NAMES[format], format)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", ["colmap-text", "mrcal", "cafca"])
def test_an_export_never_mixes_with_other_files(tmp_path, format, pinhole_rig):
    (tmp_path / "old.cameramodel").write_text("{}")
    with pytest.raises(ArtifactError, match="not empty"):
        export_rig(pinhole_rig, tmp_path, format)
    assert [file.name for file in tmp_path.iterdir()] == ["old.cameramodel"]


def test_an_export_without_cameras_is_refused(tmp_path):
    with pytest.raises(ArtifactError, match="the rig has none"):
        export_rig(Rig("t", {}), tmp_path / "x.toml", "anipose")


def test_an_unknown_format_is_refused_with_a_suggestion(tmp_path, rig):
    with pytest.raises(ArtifactError, match=r"'calliscope' is not a known format\. Perhaps 'caliscope'"):
        export_rig(rig, tmp_path / "x.toml", "calliscope")
