"""preface-calibrate as a program: what it writes, what it prints, and how it ends when something is wrong."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from preface.artifacts import SCHEMA_DIRECTORY, read_artifact
from preface.capture.corners import Corners, write_corners
from preface.capture.formats import FORMATS as KNOWN_FORMATS
from preface.capture.images import write_png
from preface.capture.rig import read_rig
from preface.cli.calibrate import CAMERA_MODELS, FORMATS, main
from preface.geometry.cameras import CAMERA_MODELS as KNOWN_MODELS

BENCH = Path(__file__).resolve().parents[2] / "tools" / "bench"
if str(BENCH) not in sys.path:
    sys.path.insert(0, str(BENCH))
PLAIN = ["--camera-model", "PINHOLE", "--board-warp", "off"]


@pytest.fixture(scope="module")
def observations():
    from calibration_scene import SceneConfig, simulate

    config = SceneConfig(
        cameras=3, frames=14, azimuth=25, width=640, height=960, focal=2000, distortion=(0, 0, 0, 0)
    )
    return simulate(config, seed=1).observations


@pytest.fixture
def capture(tmp_path):
    """A capture whose pictures nobody needs, since corners are given."""
    for take in ("monday", "tuesday"):
        for camera in ("C00", "C01", "C02"):
            folder = tmp_path / "capture" / "calibration" / take / camera
            folder.mkdir(parents=True)
            write_png(folder / "F000.png", np.full((960, 640), 90, np.uint8))
    return tmp_path / "capture"


@pytest.fixture
def corners(tmp_path, observations):
    return write_corners(tmp_path / "corners.json", Corners("monday", observations))


def run(*arguments):
    """The exit status; argparse ends the program by SystemExit."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


# ---------------------------------------------------------------------------------- as a program


def test_help_does_not_wait_for_libraries():
    command = [sys.executable, "-X", "importtime", "-m", "preface.cli.calibrate", "--help"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    for command in ("board", "photos", "import", "export"):
        assert f"\n    {command} " in result.stdout
    imported = {line.rpartition("|")[2].strip() for line in result.stderr.splitlines()}
    assert "argparse" in imported
    assert not imported & {"numpy", "cv2", "scipy", "torch", "pycolmap", "matplotlib", "jsonschema"}


def test_the_names_that_help_lists_are_those_there_are():
    assert tuple(KNOWN_MODELS) == CAMERA_MODELS
    assert tuple(KNOWN_FORMATS) == FORMATS


# ------------------------------------------------------------------------------ board, from corners


def test_corners_become_a_rig_with_its_report(capture, corners, tmp_path, capsys, observations):
    path = tmp_path / "rig.json"
    given = ["--corners", corners, "--take", "monday", "--output", path, *PLAIN]
    assert run("board", capture, *given) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == str(path)
    rig = read_rig(path)
    assert rig.take == "monday"
    assert list(rig.cameras) == list(observations.camera_ids)
    assert 0.25 < rig.held_out_reprojection_error.rms < 0.35  # noise of 0.2 px in x and in y
    for camera in rig.cameras.values():
        assert camera.reprojection_error.rms < 0.35
        assert len(camera.covariance) == 4 + 6
        assert min(camera.standard_deviations.params) > 0
    assert list(rig.provenance["inputs"]) == ["corners.json"]
    assert rig.provenance["config"]["camera_model"] == "PINHOLE"
    twin = read_artifact(tmp_path / "rig.report.json", "preface/report")
    assert twin["title"] == "Calibration of take 'monday'"
    assert (tmp_path / "rig.report.html").is_file()


def test_the_same_corners_give_the_same_bytes(capture, corners, tmp_path):
    written = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        given = ["--corners", corners, "--take", "monday", "--output", folder, *PLAIN]
        assert run("board", capture, *given) == 0
        written.append([(folder / file).read_bytes() for file in ("rig.json", "rig.report.html")])
    assert written[0] == written[1]


def test_a_camera_can_be_left_out(capture, corners, tmp_path):
    path = tmp_path / "rig.json"
    given = ["--corners", corners, "--take", "monday", "--output", path, *PLAIN]
    assert run("board", capture, *given, "--leave-out", "C01") == 0
    assert list(read_rig(path).cameras) == ["C00", "C02"]


def test_a_measured_distance_shows_a_wrong_square_size(capture, corners, tmp_path, capsys):
    path = tmp_path / "rig.json"
    given = ["--corners", corners, "--take", "monday", "--output", path, *PLAIN]
    assert run("board", capture, *given) == 0
    centers = [camera.camera_from_rig.inverse.translation for camera in read_rig(path).cameras.values()]
    distance = np.linalg.norm(centers[0] - centers[2])
    path.unlink()
    capsys.readouterr()
    assert run("board", capture, *given, "--known-distance", "C00", "C02", 1.1 * distance) == 1
    problem = capsys.readouterr().err
    assert "square size would have to be 1.1000 times" in problem
    assert not path.exists()
    assert run("board", capture, *given, "--known-distance", "C00", "C02", 1.005 * distance) == 0


def test_both_backends_agree(capture, corners, tmp_path):
    pytest.importorskip("pycolmap")
    rigs = []
    for backend in ("own", "pycolmap"):
        path = tmp_path / f"{backend}.json"
        given = ["--corners", corners, "--take", "monday", "--output", path, *PLAIN]
        assert run("board", capture, *given, "--backend", backend) == 0
        rigs.append(read_rig(path))
    for ours, theirs in zip(*(rig.cameras.values() for rig in rigs), strict=True):
        assert np.abs(ours.camera.params - theirs.camera.params).max() < 0.1
        assert np.allclose(ours.translation, theirs.translation, atol=5e-5)


# ------------------------------------------------------------------------------- board, from images


BOARD = ["--board", "chessboard", "--squares", "6x5", "--square-size", "0.03"]


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """Two takes of two cameras, 480x360, that see a chessboard of 6x5 inner corners in 12 poses."""
    folder = tmp_path_factory.mktemp("photographed")
    rng = np.random.default_rng(3)
    row, column = np.indices((6, 7))
    sheet = np.kron(np.where((row + column) % 2, 230, 20), np.ones((48, 48))).astype(np.uint8)
    sheet = np.pad(sheet, 48, constant_values=230)
    board_from_sheet = np.diag([0.03 / 48, 0.03 / 48, 1.0])
    board_from_sheet[:2, 2] = (0.5 / 48 - 1) * 0.03
    K = np.array([[700.0, 0, 239.5], [0, 700.0, 179.5], [0, 0, 1]])
    second_from_first = np.eye(4)
    second_from_first[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.35, 0.02]))[0]
    second_from_first[:3, 3] = (-0.2, 0.0, 0.04)
    for take in ("a", "b"):
        for frame in range(12):
            pose = np.eye(4)
            pose[:3, :3] = cv2.Rodrigues(rng.uniform([-0.5, -0.65, -0.3], [0.5, 0.3, 0.3]))[0]
            middle = rng.uniform([-0.05, -0.04, 0.5], [0.05, 0.04, 0.65])
            pose[:3, 3] = middle - pose[:3, :3] @ (0.105, 0.09, 0)
            for camera, camera_from_first in (("left", np.eye(4)), ("right", second_from_first)):
                seen = camera_from_first @ pose
                image_from_board = K @ seen[:3, [0, 1, 3]]
                image = np.full((360, 480), 128, np.uint8)
                fine = np.diag([4, 4, 1.0])
                fine[:2, 2] = 1.5
                large = cv2.warpPerspective(
                    sheet,
                    fine @ image_from_board @ board_from_sheet,
                    (1920, 1440),
                    cv2.resize(image, (1920, 1440)),
                    cv2.INTER_LINEAR,
                    cv2.BORDER_TRANSPARENT,
                )
                image = cv2.resize(large, (480, 360), interpolation=cv2.INTER_AREA)
                place = folder / "calibration" / take / camera
                place.mkdir(parents=True, exist_ok=True)
                write_png(place / f"{frame:02d}.png", image)
    return folder


def test_all_takes_of_a_capture_are_calibrated_at_once(photographed, tmp_path, capsys):
    assert run("board", photographed, *BOARD, "--output", tmp_path, *PLAIN, "--jobs", "1") == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == str(tmp_path / "rigs" / "b.json")
    for take in ("a", "b"):
        rig = read_rig(tmp_path / "rigs" / f"{take}.json")
        assert list(rig.cameras) == ["left", "right"]
        assert rig.cameras["left"].camera.intrinsics[0] == pytest.approx(700, rel=0.01)
        assert np.linalg.norm(rig.cameras["right"].translation) == pytest.approx(0.204, rel=0.02)
        assert "left/00.png" in rig.provenance["inputs"]
        corners = read_artifact(tmp_path / "rigs" / f"{take}.corners.json", "preface/corners")
        assert corners["board"]["type"] == "chessboard"
    assert "since take 'a'" in out
    twin = read_artifact(tmp_path / "rigs" / "b.report.json", "preface/report")
    assert twin["sections"][-1]["heading"] == "Drift between takes"


def test_corners_that_were_written_are_read_back(photographed, tmp_path, capsys):
    first = ["--take", "a", "--output", tmp_path / "rig.json", *PLAIN]
    assert run("board", photographed, *BOARD, *first, "--jobs", "1") == 0
    before = read_rig(tmp_path / "rig.json")
    again = ["--take", "a", "--output", tmp_path / "again.json", *PLAIN]
    assert run("board", photographed, *BOARD, *again, "--corners", tmp_path / "rig.corners.json") == 0
    for ours, theirs in zip(
        before.cameras.values(), read_rig(tmp_path / "again.json").cameras.values(), strict=True
    ):
        assert (ours.camera, ours.translation) == (theirs.camera, theirs.translation)
    assert "left/00.png" in read_rig(tmp_path / "again.json").provenance["inputs"]


def test_the_wrong_board_is_named(photographed, tmp_path, capsys):
    wrong = ["--board", "chessboard", "--squares", "9x6", "--square-size", "0.03"]
    assert run("board", photographed, *wrong, "--take", "a", "--output", tmp_path, "--jobs", "1") == 1
    problem = capsys.readouterr().err
    assert "found a 6x5 inner-corner chessboard, expected 9x6" in problem
    assert "Traceback" not in problem
    assert not (tmp_path / "rig.json").exists()


# ------------------------------------------------------------------------------------ what is wrong


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--squares", "9x6"], "--board does not say which"),
        (["--board", "chessboard", "--squares", "9x6"], "needs --square-size"),
        (
            ["--board", "chessboard", "--squares", "9by6", "--square-size", "0.01"],
            "'9by6' is not COLUMNSxROWS",
        ),
        (["--board", "charuco", "--squares", "4x5", "--square-size", "0.05"], "marker_size: is missing"),
        (["--board", "chessboard", "--squares", "9x6", "--square-size", "-1"], "'-1' is not a length"),
        (["--board", "cardboard"], "invalid choice: 'cardboard'"),
        (["--held-out", "1"], "'1' is not a whole number of at least 2"),
        ([*BOARD, "--output", "rig.json"], "there are 2 takes"),
        ([*BOARD, "--report", "page.html", "--output", "."], "there are 2 takes"),
        ([*BOARD, "--take", "monday", "--report", "page.pdf"], "does not end in .html"),
        (["--take", "monday"], "describe it with --board"),
    ],
)
def test_wrong_usage_ends_with_2(capture, flags, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("board", capture, *flags) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.glob("rig*.json"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--take", "mondya"], "there is no take 'mondya'. Perhaps 'monday' was meant"),
        (["--take", "monday", "--leave-out", "C09"], "there is no camera 'C09'"),
        (["--take", "monday", "--known-distance", "C00", "C9", "1"], "there is no camera 'C9'"),
        (["--take", "monday", "--output", "/dev/null/rig.json"], "writing"),
    ],
)
def test_what_is_wrong_with_the_input_ends_with_1_and_one_line(
    capture, corners, tmp_path, change, words, capsys
):
    given = ["--corners", corners, "--output", tmp_path / "rig.json", *PLAIN]
    assert run("board", capture, *given, *change) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("calibrated in")]
    assert len(lines) == 1
    assert words in lines[0]
    assert not (tmp_path / "rig.json").exists()


@pytest.mark.parametrize("flag", ["--output", "--report"])
def test_an_output_that_cannot_be_written_is_told_before_boards_are_searched_for(
    capture, tmp_path, capsys, monkeypatch, flag
):
    monkeypatch.setattr("preface.cli.calibrate_board.detect_corners", None)
    (tmp_path / "file").write_text("mine")
    place = tmp_path / "file" / ("rig.json" if flag == "--output" else "rig.html")
    where = ["--output", tmp_path / "new" / "rig.json", flag, place]
    assert run("board", capture, *BOARD, "--take", "monday", *where) == 1
    told = f"{tmp_path / 'file'}: writing: not a directory. Correct the path: one of its folders is a file.\n"
    assert capsys.readouterr().err == told
    assert not (tmp_path / "new").exists()


def test_too_few_frames_name_the_capture_and_the_camera(capture, tmp_path, observations, capsys):
    few = write_corners(tmp_path / "few.json", Corners("monday", observations.subset(observations.frame < 2)))
    given = ["--corners", few, "--take", "monday", "--output", tmp_path / "rig.json", *PLAIN]
    assert run("board", capture, *given) == 1
    problem = capsys.readouterr().err
    assert problem.startswith(f"{capture}: camera 'C0")
    assert "a camera takes 3 or more" in problem
    assert not (tmp_path / "rig.json").exists()


def test_a_capture_that_is_not_there(tmp_path, capsys):
    assert run("board", tmp_path / "nowhere", *BOARD) == 1
    assert "there is no such folder" in capsys.readouterr().err


# ---------------------------------------------------------------------------------- import, export


def test_a_rig_goes_out_and_comes_back(capture, corners, tmp_path, capsys):
    path = tmp_path / "rig.json"
    given = ["--corners", corners, "--take", "monday", "--output", path, *PLAIN]
    assert run("board", capture, *given) == 0
    capsys.readouterr()
    assert run("export", path, "--format", "nerfstudio", "--output", tmp_path / "transforms.json") == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "transforms.json")
    back = tmp_path / "back.json"
    assert run("import", tmp_path / "transforms.json", "--take", "monday", "--output", back) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(back)
    rig, again = read_rig(path), read_rig(back)
    assert again.take == "monday"
    assert list(again.provenance["inputs"]) == ["transforms.json"]
    for name, camera in rig.cameras.items():
        assert np.array_equal(again.cameras[name].camera.intrinsics, camera.camera.intrinsics)
        assert np.allclose(again.cameras[name].translation, camera.translation, rtol=0, atol=1e-12)


def test_an_imported_rig_may_be_of_arbitrary_scale(tmp_path):
    example, source = SCHEMA_DIRECTORY / "rig.example.json", tmp_path / "transforms.json"
    assert run("export", example, "--format", "nerfstudio", "--output", source) == 0
    for scale, words in (("metric", ()), ("arbitrary", ("--scale", "arbitrary"))):
        back = tmp_path / f"{scale}.json"
        assert run("import", source, *words, "--output", back) == 0
        assert read_rig(back).scale == scale


def test_a_folder_of_several_rigs_is_not_exported_but_its_rigs_are_named(tmp_path, capsys):
    for take in ("monday", "tuesday"):
        path = tmp_path / "rigs" / f"{take}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes((SCHEMA_DIRECTORY / "rig.example.json").read_bytes())
    target = tmp_path / "transforms.json"
    assert run("export", tmp_path, "--format", "nerfstudio", "--output", target) == 1
    problem = capsys.readouterr().err
    assert "holds several rigs: rigs/monday.json, rigs/tuesday.json" in problem
    assert f"Name one, such as {tmp_path / 'rigs' / 'monday.json'}" in problem
    assert not target.exists()


def test_a_file_of_no_known_format_says_what_was_tried(tmp_path, capsys):
    source = tmp_path / "notes.json"
    source.write_text(json.dumps({"hello": 1}))
    assert run("import", source, "--output", tmp_path / "rig.json") == 1
    problem = capsys.readouterr().err
    assert "is of no known format" in problem
    assert "nerfstudio" in problem
    assert not (tmp_path / "rig.json").exists()


def test_photographs_that_are_too_few(tmp_path, capsys):
    write_png(tmp_path / "one.png", np.zeros((8, 8, 3), np.uint8))
    pytest.importorskip("pycolmap")
    assert run("photos", tmp_path, "--output", tmp_path / "rig.json") == 1
    assert "Give at least two" in capsys.readouterr().err


@pytest.mark.parametrize(("asked", "expected"), [(None, "1"), ("4", None)])
def test_blas_keeps_to_one_thread_unless_a_number_was_set(tmp_path, monkeypatch, asked, expected):
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.setenv(name, "")  # so that it is put back afterwards
        monkeypatch.delenv(name)
    if asked:
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert run("import", tmp_path / "nothing") == 1
    assert os.environ.get("OPENBLAS_NUM_THREADS") == expected
