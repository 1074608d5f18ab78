"""Capture manifests: what is read, inferred and written, and which files belong to which view."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError
from preface.capture.images import write_png
from preface.capture.manifest import (
    DICTIONARY_SIZES,
    Board,
    CaptureCamera,
    Layout,
    Manifest,
    Subject,
    Take,
    read_capture,
    write_capture,
)

CHARUCO = Board("board", "charuco", (11, 8), 0.02203, 0.0165, "DICT_5X5_100", legacy=True)
MANIFEST = Manifest(
    cameras=(CaptureCamera("front", 4, 6), CaptureCamera("left")),
    takes=(Take("monday", "board", "black"), Take("tuesday", None, "green", "cal/2", "plates/2")),
    subjects=(Subject("b", "monday"), Subject("a", "tuesday")),
    boards=(CHARUCO, Board("old", "chessboard", (11, 8), 0.022)),
    metadata={"lens": "85 mm"},
)


def image(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_png(path, np.zeros((6, 4, 3), np.uint8))


@pytest.fixture
def capture(tmp_path):
    """A complete capture in the standard layout, with the manifest above."""
    for name in (
        "subjects/a/front",
        "subjects/a/left",
        "subjects/b/front",
        "subjects/b/left",
        "plates/2/front",
    ):
        image(tmp_path / f"{name}.png")
    write_capture(tmp_path, MANIFEST)
    return tmp_path


def test_what_was_written_is_read(capture):
    found = read_capture(capture)
    assert found.manifest == MANIFEST
    assert not found.inferred
    assert found.images["a", "left"] == capture / "subjects/a/left.png"
    assert found.plates == {("tuesday", "front"): capture / "plates/2/front.png"}
    assert found.missing_views == []


def test_the_manifest_itself_can_be_named(capture):
    assert read_capture(capture / "capture.json") == read_capture(capture)


def test_the_order_of_subjects_is_the_manifests(capture):
    assert [subject.id for subject in read_capture(capture).manifest.subjects] == ["b", "a"]


def test_writing_what_was_read_changes_no_byte(capture):
    before = (capture / "capture.json").read_bytes()
    write_capture(capture, read_capture(capture).manifest)
    assert (capture / "capture.json").read_bytes() == before


def test_a_handwritten_minimal_manifest_is_enough(capture):
    minimal = {
        "schema": "preface/capture",
        "schema_version": 1,
        "cameras": [{"id": "front"}, {"id": "left"}],
        "takes": [{"id": "monday"}],
        "subjects": [{"id": "a", "take": "monday"}],
    }
    (capture / "capture.json").write_text(json.dumps(minimal))
    found = read_capture(capture)
    assert found.manifest.takes[0].calibration_folder == "calibration/monday"
    assert sorted(found.images) == [("a", "front"), ("a", "left")]


def test_a_manifest_may_precede_its_subjects(tmp_path):
    write_capture(tmp_path, replace(MANIFEST, subjects=(), takes=MANIFEST.takes[:1]))
    assert read_capture(tmp_path).manifest.subjects == ()


# ------------------------------------------------------------------------------------------ files


def test_a_missing_view_is_recorded(capture):
    (capture / "subjects/b/left.png").unlink()
    found = read_capture(capture)
    assert found.missing_views == [("b", "left")]
    assert ("b", "left") not in found.images


@pytest.mark.parametrize("suffix", [".PNG", ".jpg", ".JPEG", ".tif", ".tiff", ".exr"])
def test_every_supported_suffix_in_any_case_is_found(capture, suffix):
    (capture / "subjects/b/left.png").rename(capture / f"subjects/b/left{suffix}")
    assert read_capture(capture).images["b", "left"].suffix == suffix


def test_hidden_files_folders_and_other_formats_are_no_images(capture):
    (capture / "subjects/b/.left.png").write_bytes(b"")
    (capture / "subjects/b/left.txt").write_bytes(b"")
    (capture / "subjects/b/left.jpg").mkdir()
    assert read_capture(capture).images["b", "left"].name == "left.png"


def test_camera_names_with_dots_are_not_confused(capture):
    cameras = (CaptureCamera("cam.1"), CaptureCamera("cam.10"))
    image(capture / "subjects/b/cam.1.png")
    image(capture / "subjects/b/cam.10.png")
    write_capture(capture, Manifest(cameras, (Take("t"),), (Subject("b", "t"),)))
    assert {view: file.name for view, file in read_capture(capture).images.items()} == {
        ("b", "cam.1"): "cam.1.png",
        ("b", "cam.10"): "cam.10.png",
    }


def test_masks_are_found_where_there_are_any(capture):
    image(capture / "masks/a/front.png")
    assert read_capture(capture).masks == {("a", "front"): capture / "masks/a/front.png"}


def test_another_layout_is_followed(tmp_path):
    image(tmp_path / "raw/front/img_a.png")
    layout = Layout(images="raw/{camera}/img_{identity}.png")
    write_capture(
        tmp_path, Manifest((CaptureCamera("front"),), (Take("t"),), (Subject("a", "t"),), layout=layout)
    )
    assert read_capture(tmp_path).images == {("a", "front"): tmp_path / "raw/front/img_a.png"}


def test_images_may_lie_beside_the_manifest(tmp_path):
    image(tmp_path / "a-front.png")
    layout = Layout(images="{identity}-{camera}.*")
    write_capture(
        tmp_path, Manifest((CaptureCamera("front"),), (Take("t"),), (Subject("a", "t"),), layout=layout)
    )
    assert read_capture(tmp_path).images == {("a", "front"): tmp_path / "a-front.png"}


def test_calibration_files_come_by_name_without_hidden_ones(capture):
    for name in ("10.png", "02.png", ".DS_Store", "01.mp4"):
        (capture / "calibration/monday/front").mkdir(parents=True, exist_ok=True)
        (capture / "calibration/monday/front" / name).write_bytes(b"")
    found = read_capture(capture)
    names = [file.name for file in found.calibration_files(found.manifest.takes[0], "front")]
    assert names == ["01.mp4", "02.png", "10.png"]
    assert found.calibration_files(found.manifest.takes[0], "left") == []


# --------------------------------------------------------------------------------------- inference


def test_the_standard_layout_needs_no_manifest(capture):
    (capture / "capture.json").unlink()
    (capture / "calibration/monday/front").mkdir(parents=True)
    found = read_capture(capture)
    assert found.inferred
    assert [camera.id for camera in found.manifest.cameras] == ["front", "left"]
    assert found.manifest.subjects == (Subject("a", "monday"), Subject("b", "monday"))
    assert len(found.images) == 4


def test_without_calibration_there_is_one_take(capture):
    (capture / "capture.json").unlink()
    assert read_capture(capture).manifest.takes == (Take("default"),)


def test_several_takes_cannot_be_inferred(capture):
    (capture / "capture.json").unlink()
    for take in ("monday", "tuesday"):
        (capture / "calibration" / take).mkdir(parents=True)
    with pytest.raises(ArtifactError, match=r"several takes \(monday, tuesday\)\. Write a capture.json"):
        read_capture(capture)


@pytest.fixture
def sequences(tmp_path):
    """Several photographs per camera and subject, whose numbers do not agree, and one take."""
    for name in ("a/left/00001", "a/left/00365", "a/right/00002", "a/right/00364", "b/right/00009"):
        image(tmp_path / f"subjects/{name}.png")
    image(tmp_path / "calibration/left/1.png")
    return tmp_path


def test_of_several_photographs_the_first_of_each_camera_is_the_subjects(sequences):
    found = read_capture(sequences)
    assert found.inferred
    assert [camera.id for camera in found.manifest.cameras] == ["left", "right"]
    assert {view: file.relative_to(sequences).as_posix() for view, file in found.images.items()} == {
        ("a", "left"): "subjects/a/left/00001.png",
        ("a", "right"): "subjects/a/right/00002.png",
        ("b", "right"): "subjects/b/right/00009.png",
    }
    assert found.missing_views == [("b", "left")]


def test_folders_of_cameras_in_calibration_are_no_takes(sequences):
    found = read_capture(sequences)
    (take,) = found.manifest.takes
    assert take.id == "default"
    assert [file.name for file in found.calibration_files(take, "left")] == ["1.png"]


def test_a_subject_may_list_its_photographs(sequences):
    smile = {"left": "subjects/a/left/00365.png", "right": "subjects/a/right/00364.png"}
    cameras = (CaptureCamera("left"), CaptureCamera("right"))
    manifest = Manifest(cameras, (Take("t"),), (Subject("smile", "t", smile),))
    write_capture(sequences, manifest)
    found = read_capture(sequences)
    assert found.manifest == manifest
    assert found.images["smile", "right"] == sequences / smile["right"]


@pytest.mark.parametrize(
    ("images", "words"),
    [
        (
            {"left": "subjects/a/left/7.png"},
            r"subjects\[0\].images.left: there is no file subjects/a/left/7.png",
        ),
        (
            {"lift": "subjects/a/left/00001.png"},
            r"'lift' is not one of the cameras .* Perhaps 'left' was meant",
        ),
        ({"left": "../elsewhere.png"}, r"subjects\[0\].images.left: .* climbs out"),
    ],
)
def test_a_photograph_that_is_not_there_is_named(sequences, images, words):
    content = {"cameras": [{"id": "left"}], "takes": [{"id": "t"}]}
    content |= {"schema": "preface/capture", "schema_version": 1}
    content["subjects"] = [{"id": "a", "take": "t", "images": images}]
    (sequences / "capture.json").write_text(json.dumps(content))
    with pytest.raises(ArtifactError, match=words):
        read_capture(sequences)


# ------------------------------------------------------------------------------------------ boards


def test_a_take_without_a_board_uses_the_only_one():
    assert replace(MANIFEST, boards=(CHARUCO,)).board_of(MANIFEST.takes[1]) == CHARUCO
    assert MANIFEST.board_of(MANIFEST.takes[0]) == CHARUCO
    assert MANIFEST.board_of(MANIFEST.takes[1]) is None


def test_the_dictionaries_are_opencvs():
    schema = json.loads((SCHEMA_DIRECTORY / "capture.schema.json").read_text())
    assert set(schema["$defs"]["board"]["properties"]["dictionary"]["enum"]) == set(DICTIONARY_SIZES)
    for name, size in DICTIONARY_SIZES.items():
        assert len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList) == size, name


def test_a_charuco_board_shows_as_many_markers_as_opencv_draws():
    for squares in ((11, 8), (7, 7), (4, 5)):
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        board = cv2.aruco.CharucoBoard(squares, 0.02, 0.015, dictionary)
        assert replace(CHARUCO, squares=squares).marker_count == len(board.getIds())
