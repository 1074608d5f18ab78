"""Wrong flags are refused by name, with a remedy, before anything is written."""

import pytest

from synthetic_studio.cli import main

BAD_FLAGS = [
    ("--resolution", "256"),
    ("--resolution", "256x0"),
    ("--resolution", "-256x384"),
    ("--resolution", "100000x384"),
    ("--views", "0"),
    ("--views", "1000"),
    ("--identities", "-1"),
    ("--antialias", "0"),
    ("--seed", "-3"),
    ("--takes", "0"),
    ("--jobs", "-1"),
    ("--assets", "/no/such/folder"),
    ("--sensor.blur", "-0.1"),
    ("--sensor.blur", "nan"),
    ("--sensor.full-well", "-5"),
    ("--sensor.read-noise", "inf"),
    ("--sensor.exposure", "0"),
    ("--sensor.exposure-seed", "-1"),
    ("--sensor.vignetting", "-1"),
    ("--board.frames", "0"),
    ("--board.tilt", "90"),
    ("--board.square-mm", "0"),
    ("--board.marker-ratio", "1"),
    ("--drift.translation-mm", "-1"),
    ("--drift.rotation-degrees", "nan"),
]


def status(arguments):
    """The exit status; wrong usage ends the program by SystemExit."""
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    return stop.value.code


@pytest.mark.parametrize(("flag", "value"), BAD_FLAGS)
@pytest.mark.parametrize("dry", [True, False])
def test_a_wrong_value_is_refused_by_name_with_a_remedy(flag, value, dry, tmp_path, capsys):
    output = tmp_path / "studio"
    assert status([f"--output={output}", f"{flag}={value}", *(["--dry-run"] if dry else [])]) == 2
    message = capsys.readouterr().err
    assert f"{flag} {value}" in message or f"{flag} {float(value):g}" in message
    assert ";" in message.split(flag, 1)[1]  # what to do follows
    assert not output.exists()


@pytest.mark.parametrize("squares", [("6", "8"), ("2", "3"), ("61", "4")])
def test_an_impossible_board_is_refused(squares, tmp_path, capsys):
    assert status(["--output", str(tmp_path / "x"), "--board.squares", *squares]) == 2
    assert "--board.squares" in capsys.readouterr().err


def test_a_bow_that_hides_the_board_is_refused(tmp_path, capsys):
    assert status(["--output", str(tmp_path / "x"), "--board.bow-mm", "500", "0"]) == 2
    assert "--board.bow-mm" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--views", "many"], ["--no-such-flag"], []])
def test_what_cannot_be_parsed_is_wrong_usage(arguments, tmp_path):
    assert status([*(["--output", str(tmp_path / "x")] if arguments else []), *arguments]) == 2


def test_an_output_that_is_a_file_is_refused(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    assert status(["--output", str(file)]) == 2
    assert str(file) in capsys.readouterr().err
    assert file.read_text() == "mine"


def test_help_explains_every_flag(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for flag in ("--identities", "--resolution", "--board.bow-mm", "--sensor.vignetting", "--dry-run"):
        assert flag in text


def test_dry_run_states_images_bytes_and_time_and_writes_nothing(tmp_path, capsys):
    output = tmp_path / "deep" / "studio"
    status = main([f"--output={output}", "--identities=64", "--clean-plates", "--dry-run"])
    text = capsys.readouterr().out
    assert status == 0
    assert "832" in text  # 64 people in 13 views
    assert "1,040" in text  # 40 frames, 13 cameras, 2 takes
    assert "26" in text
    assert "MB, truth included" in text
    assert "min on" in text
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(("size", "pixels", "warned"), [("96x144", 7, True), ("256x384", 19, False)])
def test_markers_that_are_too_small_to_calibrate_from_are_told_of(size, pixels, warned, tmp_path, capsys):
    assert main([f"--output={tmp_path / 'studio'}", f"--resolution={size}", "--dry-run"]) == 0
    text = capsys.readouterr().out
    (line,) = (line for line in text.splitlines() if line.startswith("markers"))
    assert abs(float(line.split()[1]) - pixels) < 0.5
    assert ("can hardly be calibrated" in text) == warned
    assert ("--resolution from 16" in text) == warned


def test_a_chessboard_has_no_markers(tmp_path, capsys):
    assert main([f"--output={tmp_path / 'studio'}", "--board.kind=chessboard", "--dry-run"]) == 0
    assert "marker" not in capsys.readouterr().out


def test_wrong_usage_is_one_line(capsys):
    assert status(["--views", "many", "--output", "x"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("synthetic_studio: error: ")
    assert line.endswith("see synthetic_studio --help")
