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


@pytest.mark.parametrize(("flag", "value"), BAD_FLAGS)
@pytest.mark.parametrize("dry", [True, False])
def test_a_wrong_value_is_refused_by_name_with_a_remedy(flag, value, dry, tmp_path, capsys):
    output = tmp_path / "studio"
    status = main([f"--output={output}", f"{flag}={value}", *(["--dry-run"] if dry else [])])
    message = capsys.readouterr().err
    assert status == 2
    assert f"{flag} {value}" in message or f"{flag} {float(value):g}" in message
    assert ";" in message.split(flag, 1)[1]  # what to do follows
    assert not output.exists()


@pytest.mark.parametrize("squares", [("6", "8"), ("2", "3"), ("61", "4")])
def test_an_impossible_board_is_refused(squares, tmp_path, capsys):
    assert main(["--output", str(tmp_path / "x"), "--board.squares", *squares]) == 2
    assert "--board.squares" in capsys.readouterr().err


def test_a_bow_that_hides_the_board_is_refused(tmp_path, capsys):
    assert main(["--output", str(tmp_path / "x"), "--board.bow-mm", "500", "0"]) == 2
    assert "--board.bow-mm" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--views", "many"], ["--no-such-flag"], []])
def test_what_cannot_be_parsed_is_wrong_usage(arguments, tmp_path):
    with pytest.raises(SystemExit) as stop:
        main([*(["--output", str(tmp_path / "x")] if arguments else []), *arguments])
    assert stop.value.code == 2


def test_an_output_that_is_a_file_is_refused(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    assert main(["--output", str(file)]) == 2
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
    assert "GB" in text
    assert "min" in text
    assert not any(tmp_path.iterdir())
