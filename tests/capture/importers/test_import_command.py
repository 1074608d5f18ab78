"""``preface-build-shards import``: its flags, what it prints, what it refuses."""

import argparse

import layouts
import pytest

from preface.artifacts import load_json
from preface.cli import build_shards_import
from preface.cli.usage import UsageError


def run(*arguments):
    parser = argparse.ArgumentParser()
    build_shards_import.add_arguments(parser)
    return build_shards_import.run(parser.parse_args([str(argument) for argument in arguments]))


@pytest.fixture
def source(tmp_path):
    layouts.write_facescape(tmp_path / "data", "1/1_neutral", layouts.cameras(12), invalid=range(10))
    return tmp_path / "data"


def test_the_last_line_is_the_capture_and_all_that_is_left_out_is_said(source, tmp_path, capsys):
    lines = run(source, "--layout", "facescape", "--output", tmp_path / "capture", "--link", "copy")
    assert lines == [
        "1 subjects of 1 people, 2 views, 0 masks, 1 takes; left out: 10",
        str(tmp_path / "capture"),
    ]
    said = capsys.readouterr().err
    assert said.count("left out: 1/1_neutral/") == build_shards_import.MAX_NAMED
    assert "and 2 more; capture.json lists them" in said
    listed = load_json(tmp_path / "capture" / "capture.json")["metadata"]["imported"]["left_out"]
    assert len(listed) == 10


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "a"])
def test_a_unit_that_is_no_length_is_wrong_usage(source, tmp_path, value, capsys):
    flags = ("--layout", "cafca", "--output", tmp_path / "capture", f"--metres-per-unit={value}")
    with pytest.raises(SystemExit) as caught:
        run(source, *flags)
    assert caught.value.code == 2
    assert "positive number" in capsys.readouterr().err


@pytest.mark.parametrize(("layout", "flags"), [("cafca", ()), ("facescape", ("--metres-per-unit", "0.001"))])
def test_registrations_that_contradict_other_flags_are_wrong_usage(source, tmp_path, layout, flags):
    output = ("--layout", layout, "--output", tmp_path / "capture")
    with pytest.raises(UsageError, match="leave"):
        run(source, *output, "--registrations", tmp_path / "Rt_scale_dict.json", *flags)
