"""preface-inspect as a program: its exit status, its two outputs, and its manners in a pipeline."""

import json
import os
import resource
import shutil
import subprocess
import sys

import numpy as np
import pytest

from preface.artifacts import SCHEMA_DIRECTORY
from preface.capture.images import write_png
from preface.capture.manifest import Board, CaptureCamera, Manifest, Subject, Take, write_capture

COMMAND = [sys.executable, "-m", "preface.cli.inspect"]


def run(*arguments, **options):
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, check=False, **options
    )


@pytest.fixture
def capture(tmp_path):
    cameras = (CaptureCamera("front", 4, 6), CaptureCamera("left"))
    board = Board("board", "charuco", (11, 8), 0.02203, 0.0165, "DICT_5X5_100")
    take = Take("monday", background="black")
    write_capture(
        tmp_path, Manifest(cameras, (take,), (Subject("a", "monday"), Subject("b", "monday")), (board,))
    )
    for name in (
        "subjects/a/front",
        "subjects/a/left",
        "subjects/b/front",
        "masks/a/front",
        "background/left",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write_png(tmp_path / f"{name}.png", np.zeros((6, 4, 3), np.uint8))
    (tmp_path / "calibration/monday/front").mkdir(parents=True)
    shutil.copy(tmp_path / "background/left.png", tmp_path / "calibration/monday/front/0.png")
    return tmp_path


def test_a_valid_capture_is_summarised_and_ends_with_0(capture):
    result = run(capture)
    assert result.returncode == 0
    assert result.stderr == ""
    for words in (
        "preface/capture: valid",
        "2: front, left",
        "charuco 11x8",
        "3 x 4x6 PNG",
        "1: b/left",
        "black",
    ):
        assert words in result.stdout


def test_json_says_the_same_to_programs(capture):
    result = run(capture, "--json")
    assert result.returncode == 0
    (artifact,) = json.loads(result.stdout)["artifacts"]
    assert artifact["ok"]
    summary = artifact["summary"]
    assert summary["cameras"] == ["front", "left"]
    assert summary["missing_views"] == ["b/left"]
    assert (summary["images"], summary["masks"]) == (3, 1)
    assert summary["takes"] == [
        {"id": "monday", "background": "black", "board": "board", "calibration_files": 1, "plates": 1}
    ]


def test_an_inferred_capture_says_so(capture):
    (capture / "capture.json").unlink()
    result = run(capture)
    assert result.returncode == 0
    assert "inferred from the layout" in result.stdout


def test_a_folder_with_a_rig_and_a_capture_shows_both(capture):
    shutil.copy(SCHEMA_DIRECTORY / "rig.example.json", capture / "rig.json")
    result = run(capture)
    assert result.returncode == 0
    assert "preface/capture: valid" in result.stdout
    assert "preface/rig: valid" in result.stdout
    assert "focal length px 13512.2" in result.stdout


def test_a_folder_without_artefacts_says_what_may_be_meant(tmp_path):
    empty, rigs = tmp_path / "empty", tmp_path / "rigs"
    for folder in (empty, rigs):
        folder.mkdir()
    (rigs / "monday.json").touch()
    told = run(empty, rigs, tmp_path)
    assert told.returncode == 1
    first, second, third = told.stderr.splitlines()
    assert first.endswith(
        "nor a folder subjects, and neither do its folders. Name an artefact or the folder that holds it."
    )
    assert second.endswith(f", such as {rigs / 'monday.json'}.")
    assert third.endswith(f", such as {rigs / 'monday.json'}.")


def test_a_folder_of_the_rigs_of_several_takes_and_the_one_above_stand_for_them(tmp_path):
    for take in ("monday", "tuesday"):
        example("rig", tmp_path / "rigs" / f"{take}.json")
    for folder in (tmp_path, tmp_path / "rigs"):
        result = run(folder)
        assert result.returncode == 0
        assert result.stdout.count("preface/rig: valid") == 2


def test_every_problem_is_told_not_only_the_first(capture):
    write_png(capture / "subjects/a/front.png", np.zeros((6, 6, 3), np.uint8))
    (capture / "subjects/a/left.png").write_bytes(b"not an image")
    result = run(capture)
    assert result.returncode == 1
    first, second = result.stderr.splitlines()
    assert "a/front.png: size: is 6x6, but capture.json says 4x6 for 'front'" in first
    assert "a/left.png: header: is empty or not a PNG" in second
    assert "2 problems" in result.stdout


def test_problems_are_in_the_json_too(capture):
    (capture / "subjects/a/left.png").write_bytes(b"not an image")
    result = run(capture, "--json")
    assert result.returncode == 1
    assert result.stderr == ""
    (problem,) = json.loads(result.stdout)["artifacts"][0]["problems"]
    assert problem["file"].endswith("left.png")
    assert problem["field"] == "header"
    assert problem["remedy"].startswith("Export the image as PNG")


def test_images_of_one_camera_with_different_sizes_are_a_problem(capture):
    write_png(capture / "background/left.png", np.zeros((8, 8, 3), np.uint8))
    result = run(capture)
    assert result.returncode == 1
    assert "background/left.png: size: is 8x8" in result.stderr


def test_one_bad_artefact_among_good_ones_ends_with_1(capture):
    result = run(capture, capture / "gone.json")
    assert result.returncode == 1
    assert "preface/capture: valid" in result.stdout
    assert "gone.json: file: no such file or directory" in result.stderr


@pytest.mark.parametrize("arguments", [[], ["--bogus"], ["--json"]])
def test_wrong_usage_ends_with_2(arguments):
    result = run(*arguments)
    assert result.returncode == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("preface-inspect: error: ")
    assert line.endswith("; see preface-inspect --help")


def test_help_is_quick_and_imports_nothing_heavy():
    heavy = "{'numpy', 'torch', 'cv2', 'open3d', 'scipy', 'tyro', 'jsonschema', 'OpenEXR', 'PIL'}"
    program = (
        "import sys; from preface.cli.inspect import main\n"
        "try: main(['--help'])\n"
        f"finally: print(sorted({heavy} & set(sys.modules)))"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    output = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert "Validate captures, rigs, alignments" in output
    assert output.splitlines()[-1] == "[]"
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.5  # CPU seconds


def test_a_closed_pipe_is_no_error(capture):
    reader, writer = os.pipe()
    os.close(reader)
    result = subprocess.run(
        [*COMMAND, str(capture)], stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert result.returncode == 0
    assert result.stderr == ""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")  # noqa: PTH110
def test_output_to_a_full_disk_ends_with_1_and_the_reason(capture):
    with open("/dev/full", "w") as full:  # noqa: PTH123
        result = subprocess.run(
            [*COMMAND, str(capture)], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert result.returncode == 1
    assert result.stderr == (
        "standard output: writing: no space left on device. Free some space on that disk and run again.\n"
    )


def test_names_outside_the_terminals_encoding_are_escaped(tmp_path):
    result = run(
        tmp_path / "Büro\x1b[31m.json", env={**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    )
    assert result.returncode == 1
    assert "B\\xfcro\\x1b[31m.json: file: no such file" in result.stderr


# ------------------------------------------------------------------- folders that hold no artefact's own name


def example(name, target):
    """The worked example of a schema, as a file."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(SCHEMA_DIRECTORY / f"{name}.example.json", target)


def test_the_folder_of_an_evaluation_stands_for_its_report_and_the_figures_of_each_head(tmp_path):
    example("report", tmp_path / "report.json")
    example("metrics", tmp_path / "head" / "metrics.json")
    example("metrics", tmp_path / "alone" / "metrics.json")
    (tmp_path / "other.json").write_text("not JSON")
    result = run(tmp_path, "--json")
    found = {(a["path"], a["schema"]) for a in json.loads(result.stdout)["artifacts"]}
    assert result.returncode == 0
    assert found == {
        (str(tmp_path / "report.json"), "preface/report"),
        (str(tmp_path / "head" / "metrics.json"), "preface/metrics"),
        (str(tmp_path / "alone" / "metrics.json"), "preface/metrics"),
    }


def test_the_photographs_of_a_head_stand_for_their_alignment_though_a_template_lies_beside_it(tmp_path):
    example("template", tmp_path / "template.json")
    example("rig", tmp_path / "alignment" / "rig.json")
    result = run(tmp_path)
    assert result.returncode == 0
    assert "template.json: preface/template: valid" in result.stdout
    assert "alignment/rig.json: preface/rig: valid" in result.stdout


def test_a_folder_of_nothing_known_is_a_problem(tmp_path):
    (tmp_path / "holiday.jpg").touch()
    result = run(tmp_path)
    assert result.returncode == 1
    assert "holds none of capture.json" in result.stderr
