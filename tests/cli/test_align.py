"""preface-align as a program: what it writes, what it prints, and how it ends when something is wrong."""

import json
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import made_up_studio as made
import numpy as np
import pytest
from PIL import Image

from preface.align.detection import DetectionOptions
from preface.align.keypoints import CANONICAL_KEYPOINTS, IBUG68
from preface.align.landmark_files import landmark_file, write_landmarks
from preface.align.report import alignment_report
from preface.artifacts import load_json
from preface.capture.images import write_png
from preface.capture.manifest import CaptureCamera, Manifest, Subject, Take, write_capture
from preface.capture.rig import read_rig, write_rig
from preface.cli.align import main
from preface.reports import Report

CAMERAS = ("c0", "c1", "c2", "c3", "c4")
ANGLES = (-40.0, -20.0, 0.0, 20.0, 40.0)
PEOPLE = {"anna": (0.0, 0.0, 0.0), "bert": (0.004, 0.002, 0.0), "carl": (-0.003, 0.0, 0.005)}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A capture of three people before five cameras, its rig, and landmarks of another program."""
    root = tmp_path_factory.mktemp("original")
    folder = root / "capture"
    rig = made.rig(CAMERAS, ANGLES, "monday")
    for person, offset in PEOPLE.items():
        points = made.face(made.TEMPLATE + np.array(offset))
        for camera in CAMERAS:
            photograph = folder / "subjects" / person / f"{camera}.png"
            photograph.parent.mkdir(parents=True, exist_ok=True)
            write_png(photograph, np.full((made.SIZE[1], made.SIZE[0], 3), 60, np.uint8))
            give_landmarks(root, person, camera, made.seen(points, rig.cameras[camera]))
    subjects = tuple(Subject(person, "monday") for person in PEOPLE)
    cameras = tuple(CaptureCamera(camera) for camera in CAMERAS)
    write_capture(folder, Manifest(cameras, (Take("monday"),), subjects))
    write_rig(root / "rig.json", rig)
    return root


@pytest.fixture
def capture(original, tmp_path):
    """A copy of it to work on and to spoil."""
    return shutil.copytree(original, tmp_path / "copy") / "capture"


@pytest.fixture(autouse=True)
def light_report(monkeypatch):
    """A page without pictures, which take most of a small run's time."""
    name = "preface.cli.align_studio.alignment_report"
    monkeypatch.setattr(name, lambda studio, provenance, load_image: Report("light", provenance))


def give_landmarks(folder, person, camera, found):
    path = landmark_file(folder / "landmarks", (person, camera))
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_landmarks(path, (person, camera), made.SIZE, found)


def landmarks_of(capture, person, camera):
    return landmark_file(capture.parent / "landmarks", (person, camera))


def run(*arguments):
    """The exit status; argparse ends the program by SystemExit."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


def align(capture, *more, output="alignment", rig=None):
    rig = capture.parent / "rig.json" if rig is None else rig
    given = ["--landmarks", capture.parent / "landmarks", "--output", capture.parent / output]
    return run("studio", capture, "--rig", rig, *given, *more)


def of(capture, person, output="alignment"):
    return load_json(capture.parent / output / f"{person}.json")


def keypoints(content):
    return np.array([content["keypoints"][name] for name in CANONICAL_KEYPOINTS])


# ------------------------------------------------------------------------------------ what is written


def test_everybody_is_carried_onto_the_template(capture, capsys):
    assert align(capture) == 0
    written = capsys.readouterr().out.splitlines()
    assert (capture.parent / "alignment" / "alignment.json").samefile(written[-1])
    template = load_json(capture.parent / "alignment" / "template.json")
    for person, offset in PEOPLE.items():
        content = of(capture, person)
        np.testing.assert_allclose(keypoints(content), made.TEMPLATE + offset, atol=1e-5)
        move = content["canonical_from_rig"]
        assert move["scale"] == pytest.approx(1, abs=1e-3)
        np.testing.assert_allclose(move["quaternion_wxyz"], [1, 0, 0, 0], atol=1e-3)
    median = np.median([made.TEMPLATE + offset for offset in PEOPLE.values()], axis=0)
    found = np.array([template["keypoints"][name] for name in CANONICAL_KEYPOINTS])
    np.testing.assert_allclose(found, median - median.mean(axis=0), atol=1e-5)


def test_the_report_stands_beside_it_and_says_who_was_aligned(capture, capsys, monkeypatch):
    monkeypatch.setattr("preface.cli.align_studio.alignment_report", alignment_report)
    assert align(capture) == 0
    assert "3 of 3 people" in capsys.readouterr().out
    page = load_json(capture.parent / "alignment" / "report.json")
    assert page["schema"] == "preface/report"
    assert (capture.parent / "alignment" / "report.html").stat().st_size > 10_000


def test_a_new_person_joins_an_old_template(capture):
    assert align(capture, "--only", "anna", "bert") == 0
    assert not (capture.parent / "alignment" / "carl.json").exists()
    old = (capture.parent / "alignment" / "template.json").read_bytes()
    assert align(capture, "--only", "carl", "--template", capture.parent / "alignment", output="new") == 0
    new = load_json(capture.parent / "new" / "template.json")
    assert new["keypoints"] == json.loads(old)["keypoints"]
    assert new["identities"] == ["anna", "bert"]
    carried = made.TEMPLATE + PEOPLE["carl"]
    expected = np.median([PEOPLE["anna"], PEOPLE["bert"]], axis=0) - PEOPLE["carl"]
    move = of(capture, "carl", "new")["canonical_from_rig"]
    center = np.median([made.TEMPLATE + PEOPLE[p] for p in ("anna", "bert")], axis=0).mean(axis=0)
    np.testing.assert_allclose(np.array(move["translation"]), expected - center, atol=1e-4)
    assert carried.shape == (5, 3)


def test_the_template_is_made_from_the_first_people(capture):
    assert align(capture, "--identities", "1") == 0
    assert load_json(capture.parent / "alignment" / "template.json")["identities"] == ["anna"]


def test_people_who_stand_elsewhere_are_brought_together_by_procrustes(capture):
    assert align(capture, "--procrustes", output="together") == 0
    template = load_json(capture.parent / "together" / "template.json")
    found = np.array([template["keypoints"][name] for name in CANONICAL_KEYPOINTS])
    np.testing.assert_allclose(found, made.TEMPLATE, atol=1e-5)
    assert (
        max(template["spread"].values() if isinstance(template["spread"], dict) else template["spread"])
        < 1e-5
    )


def test_a_metric_rig_may_keep_its_scale(capture):
    assert align(capture, "--scale", "fixed") == 0
    assert of(capture, "bert")["canonical_from_rig"]["scale"] == 1


def test_a_rig_of_arbitrary_scale_serves_a_given_template_and_makes_none(capture, capsys):
    """As `preface-calibrate photos` leaves it: nothing is said about the size of faces, and no head has it."""
    assert align(capture, output="metric") == 0
    rig, template = read_rig(capture.parent / "rig.json"), capture.parent / "metric"
    inches = {
        name: replace(camera, translation=tuple(39.37 * x for x in camera.translation))
        for name, camera in rig.cameras.items()
    }
    path = write_rig(capture.parent / "own.json", replace(rig, cameras=inches, scale="arbitrary"))
    capsys.readouterr()
    assert align(capture, "--template", template, output="own", rig=path) == 0
    assert "inches" not in capsys.readouterr().err
    moves = [of(capture, "bert", output)["canonical_from_rig"]["scale"] for output in ("own", "metric")]
    assert moves[0] * 39.37 == pytest.approx(moves[1])
    assert align(capture, output="none", rig=path) == 1
    assert "own.json: scale: arbitrary, so that no template can be made" in capsys.readouterr().err
    assert align(capture, "--template", template, "--scale", "fixed", output="none", rig=path) == 1
    assert "--scale fixed would keep it" in capsys.readouterr().err
    assert not (capture.parent / "none").exists()


def test_a_second_run_gives_the_same_bytes(capture):
    assert align(capture) == 0
    folder = capture.parent / "alignment"
    first = {path.name: path.read_bytes() for path in folder.glob("*.json")}
    assert align(capture) == 0
    assert first == {path.name: path.read_bytes() for path in folder.glob("*.json")}


def test_rigs_are_found_in_the_folder_that_calibration_wrote(capture):
    rigs = capture.parent / "calibrated" / "rigs"
    rigs.mkdir(parents=True)
    (capture.parent / "rig.json").rename(rigs / "monday.json")
    (rigs / "monday.report.json").write_text('{"schema": "preface/report"}')
    assert align(capture, rig=capture.parent / "calibrated") == 0


def test_the_result_can_be_inspected(capture):
    assert align(capture) == 0
    folder = capture.parent / "alignment"
    command = [sys.executable, "-m", "preface.cli.inspect", folder, folder / "anna.json", "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    found = {entry["schema"]: entry["summary"] for entry in json.loads(result.stdout)["artifacts"]}
    assert found["preface/template"]["identities"] == 3
    assert found["preface/alignment"]["identity"] == "anna"
    assert found["preface/alignment"]["views_used"] == 5


def test_an_interrupted_search_is_resumed_and_repeated_only_where_something_changed(capture, monkeypatch):
    rig, searched = made.rig(CAMERAS, ANGLES, "monday"), []
    patience = [7]  # photographs until the user interrupts

    def detect(images, options, done, read):
        found = {}
        for person, camera in images:
            if len(searched) == patience[0]:
                raise KeyboardInterrupt
            searched.append((person, camera))
            points = made.face(made.TEMPLATE + np.array(PEOPLE[person]))
            found[person, camera] = made.seen(points, rig.cameras[camera])
            done((person, camera), found[person, camera])
        return found

    def search(*flags):
        searched.clear()
        given = ["--rig", capture.parent / "rig.json", "--output", capture.parent / "alignment"]
        return run("studio", capture, *given, *flags), len(searched)

    monkeypatch.setattr("preface.cli.align_landmarks.detect_views", detect)
    assert search() == (130, 7)
    assert not (capture.parent / "alignment" / "alignment.json").exists()
    patience[0] = 100
    assert search() == (0, 8)
    assert search() == (0, 0)
    write_png(
        capture / "subjects" / "bert" / "c1.png", np.full((made.SIZE[1], made.SIZE[0], 3), 61, np.uint8)
    )
    assert search() == (0, 1)
    assert search("--crops", "3") == (0, 15)


# --------------------------------------------------------------------------------------- left out


def test_a_view_of_another_size_or_to_be_rotated_or_missing_is_left_out_with_its_reason(capture):
    photographs = capture / "subjects" / "anna"
    write_png(photographs / "c0.png", np.zeros((20, 10, 3), np.uint8))
    (photographs / "c1.png").unlink()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", made.SIZE).save(photographs / "c1.jpg", exif=exif)
    (photographs / "c2.png").unlink()
    assert align(capture) == 0
    reasons = {camera: view.get("reason", "") for camera, view in of(capture, "anna")["views"].items()}
    assert "10x20" in reasons["c0"]
    assert "orientation" in reasons["c1"].lower()
    assert "no photograph" in reasons["c2"]
    views = of(capture, "anna")["views"]
    assert [camera for camera, view in views.items() if view["used"]] == ["c3", "c4"]


def test_a_camera_that_the_rig_lacks_is_left_out(capture):
    write_rig(capture.parent / "rig.json", made.rig(CAMERAS[1:], ANGLES[1:], "monday"))
    assert align(capture) == 0
    view = of(capture, "anna")["views"]["c0"]
    assert not view["used"]
    assert "c0" in view["reason"]


def test_a_person_seen_by_one_camera_is_excluded_with_a_reason_and_the_rest_goes_on(capture, capsys):
    for camera in CAMERAS[1:]:
        landmarks_of(capture, "bert", camera).unlink()
    assert align(capture) == 0
    captured = capsys.readouterr()
    assert "2 of 3 people" in captured.out
    assert "bert" in captured.err
    assert not (capture.parent / "alignment" / "bert.json").exists()
    index = load_json(capture.parent / "alignment" / "alignment.json")
    assert "bert" in str(index["excluded"])


def test_someone_excluded_now_does_not_keep_an_earlier_alignment(capture):
    assert align(capture) == 0
    assert (capture.parent / "alignment" / "bert.json").exists()
    for camera in CAMERAS[1:]:
        landmarks_of(capture, "bert", camera).unlink()
    assert align(capture) == 0
    assert not (capture.parent / "alignment" / "bert.json").exists()


def test_a_view_with_swapped_sides_is_named(capture):
    rig = made.rig(CAMERAS, ANGLES, "monday")
    found = made.seen(made.face(made.TEMPLATE), rig.cameras["c3"])
    found.pixels[:] = found.pixels[IBUG68.mirror]
    give_landmarks(capture.parent, "anna", "c3", found)
    assert align(capture) == 0
    content = of(capture, "anna")
    assert not content["views"]["c3"]["used"]
    assert "left" in content["views"]["c3"]["reason"]
    np.testing.assert_allclose(keypoints(content), made.TEMPLATE, atol=1e-5)


def test_landmarks_on_the_wrong_person_are_left_out(capture):
    rig = made.rig(CAMERAS, ANGLES, "monday")
    elsewhere = made.seen(made.face(made.TEMPLATE + np.array((0.06, 0, 0))), rig.cameras["c2"])
    give_landmarks(capture.parent, "anna", "c2", elsewhere)
    assert align(capture) == 0
    content = of(capture, "anna")
    assert [camera for camera, view in content["views"].items() if not view["used"]] == ["c2"]
    np.testing.assert_allclose(keypoints(content), made.TEMPLATE, atol=1e-5)


# ------------------------------------------------------------------------------------------ errors


def nobody_has_a_face(capture):
    for person in PEOPLE:
        for camera in CAMERAS[1:]:
            landmarks_of(capture, person, camera).unlink()


def rig_of_another_size(capture):
    for file in (capture / "subjects").rglob("*.png"):
        write_png(file, np.zeros((20, 10, 3), np.uint8))


def rig_of_other_cameras(capture):
    write_rig(capture.parent / "rig.json", made.rig(tuple("vwxyz"), ANGLES, "monday"))


def two_rigs_of_a_take(capture):
    write_rig(capture.parent / "second.json", made.rig(CAMERAS, ANGLES, "monday"))
    return ["--rig", capture.parent / "rig.json", capture.parent / "second.json"]


def no_rig_of_the_take(capture):
    cameras = tuple(CaptureCamera(camera) for camera in CAMERAS)
    subjects = (Subject("anna", "monday"), Subject("bert", "tuesday"))
    write_capture(capture, Manifest(cameras, (Take("monday"), Take("tuesday")), subjects))


def template_of_another_scheme(capture):
    assert align(capture, output="old") == 0
    path = capture.parent / "old" / "template.json"
    path.write_text(path.read_text().replace('"ibug68"', '"facemesh478"'))
    return ["--template", path]


def output_is_a_file(capture):
    (capture.parent / "alignment").write_text("mine")


BAD = [
    (nobody_has_a_face, "nobody|no one|not one|all"),
    (rig_of_another_size, "rig.json: cameras: .*240x320 there, but its photographs are 10x20"),
    (rig_of_other_cameras, "rig.json: cameras: has none of the capture's cameras"),
    (two_rigs_of_a_take, "second.json: take: is a second rig of take 'monday'"),
    (no_rig_of_the_take, "none of the rigs is of take 'tuesday'"),
    (template_of_another_scheme, "facemesh478.*ibug68|ibug68.*facemesh478"),
    (output_is_a_file, "alignment: "),
    (lambda capture: ["--only", "anne"], "there is no 'anne'.*Perhaps 'anna' was meant"),
    (lambda capture: ["--rig", capture.parent / "none.json"], "none.json: file: no such file"),
    (lambda capture: ["--rig", capture], "holds no rig"),
    (lambda capture: ["--landmarks", capture], "no file with landmarks of this capture"),
    (lambda capture: ["--template", capture.parent / "no.json"], "no.json: file: no such file"),
]


@pytest.mark.parametrize(("spoil", "words"), BAD)
def test_what_cannot_work_ends_with_1_and_says_why(capture, capsys, spoil, words):
    more = spoil(capture) or []
    capsys.readouterr()
    assert align(capture, *more) == 1
    captured = capsys.readouterr()
    assert re.search(words, captured.err), captured.err
    assert "Traceback" not in captured.err
    assert captured.out == ""
    assert not (capture.parent / "alignment" / "alignment.json").exists()


def test_landmarks_that_are_not_there_leave_no_folder(capture, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert align(capture, "--landmarks", tmp_path / "empty") == 1
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'empty'}: ")
    assert not (capture.parent / "alignment").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["studio"],
        ["studio", "capture"],
        ["studio", "capture", "--rig", "r", "--scale", "big"],
        ["studio", "capture", "--rig", "r", "--jobs", "0"],
        ["studio", "capture", "--rig", "r", "--identities", "0"],
        ["studio", "capture", "--rig", "r", "--template", "t", "--procrustes"],
        ["studio", "capture", "--rig", "r", "--template", "t", "--identities", "3"],
        ["photos"],
    ],
)
def test_wrong_usage_ends_with_2(arguments, capsys):
    assert run(*arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("preface-align")
    assert ": error: " in line
    assert line.endswith(" --help")


def test_help_says_what_the_detector_does_unless_it_is_told(capsys):
    usual = DetectionOptions()
    with pytest.raises(SystemExit, match="0"):
        main(["studio", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert re.search(rf"--search-side PIXELS [^-]*\(default: {usual.scale}\)", said)
    assert re.search(rf"--crops N [^-]*\(default: {usual.jitters}\)", said)


def test_help_comes_at_once():
    program = "import sys; from preface.cli.align import main\ntry: main(['studio', '--help'])\n"
    program += "except SystemExit: pass\nassert 'numpy' not in sys.modules"
    began = time.process_time()
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "--landmark-model" in result.stdout
    assert time.process_time() - began < 5


def test_the_correction_of_facemesh_is_not_for_landmarks_of_another_detector(capture, capsys):
    assert align(capture, "--landmark-bias", "on") == 2
    assert "--landmark-bias on is for landmarks of facemesh478: these are ibug68" in capsys.readouterr().err
    assert align(capture, "--landmark-bias", "auto") == 0
    assert all("correction" not in view for view in of(capture, "anna")["views"].values())
    assert (
        load_json(capture.parent / "alignment" / "alignment.json")["provenance"]["config"]["landmark_bias"]
        is None
    )
