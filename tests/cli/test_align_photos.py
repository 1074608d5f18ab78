"""preface-align photos as a program: from photographs and their landmarks to cameras, a face and its place."""

import made_up_studio as made
import numpy as np
import pytest
from PIL import Image

from preface.align.alignment_files import read_index, read_template
from preface.align.keypoints import CANONICAL_KEYPOINTS, FACEMESH478
from preface.align.landmark_bias import shipped_bias
from preface.align.landmark_files import landmark_file, write_landmarks
from preface.align.landmarks import NoFace, ViewLandmarks, box_around
from preface.align.person_file import read_alignment
from preface.align.photos.face import face_prior
from preface.artifacts import load_json
from preface.capture.images import write_png
from preface.capture.rig import read_rig, write_rig
from preface.cli.align import main
from preface.reports import Report

PHOTOGRAPHS = {"a": -15.0, "b": 15.0}
LENS = made.rig(("a",), (0.0,)).cameras["a"].camera


def cameras():
    return made.rig(tuple(PHOTOGRAPHS), tuple(PHOTOGRAPHS.values()), "phone")


@pytest.fixture
def folder(tmp_path):
    """Two photographs of the expected face, and its landmarks."""
    points = face_prior().mean
    (tmp_path / "me").mkdir()
    for name, entry in cameras().cameras.items():
        write_png(tmp_path / "me" / f"{name}.png", np.full((made.SIZE[1], made.SIZE[0], 3), 90, np.uint8))
        pixels, _ = entry.camera.project(entry.camera_from_rig.apply(points))
        count = FACEMESH478.size
        give(tmp_path, name, ViewLandmarks(
            FACEMESH478.name, pixels, np.full(count, 0.5), np.ones(count), box_around(pixels)
        ))  # fmt: skip
    return tmp_path / "me"


def give(root, name, found):
    path = landmark_file(root / "landmarks", ("me", name))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_landmarks(path, ("me", name), made.SIZE, found)


def align(folder, *more):
    root = folder.parent
    given = ["--landmarks", root / "landmarks", "--output", root / "alignment"]
    try:
        return main([str(word) for word in ("photos", folder, *given, *more)])
    except SystemExit as end:
        return end.code


def expected_keypoints():
    return FACEMESH478.keypoint_pixels(face_prior().mean)


def test_one_photograph_yields_a_camera_a_face_and_a_report(folder, capsys):
    assert align(folder, "--only", "a") == 0
    output = capsys.readouterr().out.splitlines()
    alignment = folder.parent / "alignment"
    assert output[-1] == str(alignment / "alignment.json")
    assert output[0].startswith("1 of 1 photographs used")
    assert any(line.startswith("The focal length is") for line in output)
    assert list(read_rig(alignment).cameras) == ["a"]
    (entry,) = read_index(alignment).aligned
    assert (entry.identity, entry.views) == ("me", ("a",))
    assert load_json(alignment / "report.json")["schema"] == "preface/report"
    found = read_alignment(alignment / entry.file).subject.keypoints.positions
    apart = np.linalg.norm(found[0] - found[1])
    assert apart == pytest.approx(np.linalg.norm(np.subtract(*expected_keypoints()[:2])), rel=0.05)


def test_given_cameras_are_used_and_an_old_template_is_joined(folder, monkeypatch):
    monkeypatch.setattr("preface.cli.align_photos.photo_report", lambda *_: Report("light", {}))
    root = folder.parent
    write_rig(root / "cameras.json", cameras())
    flags = ["--cameras", root / "cameras.json", "--metric-cameras", "--identity", "me"]
    assert align(folder, *flags) == 0
    (root / "alignment" / "template.json").rename(root / "old.json")
    assert align(folder, *flags, "--template", root / "old.json") == 0
    person = read_alignment(root / "alignment" / "me.json")
    np.testing.assert_allclose(person.subject.keypoints.positions, expected_keypoints(), atol=1e-4)
    template = read_template(root / "old.json")
    carried = person.placement.canonical_from_rig.apply(person.subject.keypoints.positions)
    np.testing.assert_allclose(carried, template.keypoints, atol=1e-6)
    assert len(carried) == len(CANONICAL_KEYPOINTS)


def test_a_photograph_without_a_face_is_left_out_with_its_reason(folder, monkeypatch, capsys):
    monkeypatch.setattr("preface.cli.align_photos.photo_report", lambda *_: Report("light", {}))
    give(folder.parent, "b", NoFace("it shows a dog"))
    assert align(folder) == 0
    assert capsys.readouterr().out.startswith("1 of 2 photographs used")
    view = read_alignment(folder.parent / "alignment" / "me.json").subject.views["b"]
    assert (view.used, view.code, view.reason) == (False, "no_face", "it shows a dog")


def test_photographs_that_exif_wants_turned_are_turned(folder, monkeypatch):
    monkeypatch.setattr("preface.cli.align_photos.photo_report", lambda *_: Report("light", {}))
    assert align(folder, "--output", folder.parent / "stored") == 0
    for file in folder.glob("*.png"):
        exif = Image.Exif()
        exif[0x0112] = 6  # the stored pixels are to be turned clockwise by a quarter
        Image.new("RGB", made.SIZE[::-1]).save(file, exif=exif)
    assert align(folder, "--output", folder.parent / "turned") == 0
    stored, turned = (read_rig(folder.parent / name) for name in ("stored", "turned"))
    for name in stored.cameras:
        camera = turned.cameras[name].camera
        assert (camera.width, camera.height) == made.SIZE
        np.testing.assert_array_equal(camera.params, stored.cameras[name].camera.params)


def test_the_correction_of_landmarks_is_recorded_when_it_is_asked_for(folder, monkeypatch):
    monkeypatch.setattr("preface.cli.align_photos.photo_report", lambda *_: Report("light", {}))
    for choice, recorded in (("off", None), ("on", shipped_bias().name)):
        assert align(folder, "--only", "a", "--landmark-bias", choice) == 0
        history = read_index(folder.parent / "alignment").provenance
        assert history["config"]["landmark_bias"] == recorded


@pytest.mark.parametrize(
    ("flags", "status", "words"),
    [
        (["--only", "aa"], 1, "no photograph 'aa'"),
        (["--metric-cameras"], 2, "--cameras"),
        (["--known-distance", "a", "b", "far"], 2, "'far' is not a length"),
        (["--identity", "../me"], 2, "cannot be the name"),
        (["--identity", "template"], 1, "name of another file"),
        (["--cameras", "none.json"], 1, "none.json"),
    ],
)
def test_what_cannot_work_says_why(folder, capsys, flags, status, words):
    assert align(folder, *flags) == status
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.out == ""
    assert not (folder.parent / "alignment" / "alignment.json").exists()


def test_landmarks_that_are_not_there_leave_no_folder(folder, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    output = tmp_path / "new" / "alignment"
    assert align(folder, "--landmarks", tmp_path / "empty", "--output", output) == 1
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'empty'}: ")
    assert not output.parent.exists()


def test_an_empty_folder_is_told(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert align(tmp_path / "empty") == 1
    assert "holds no photograph" in capsys.readouterr().err
