"""What all commands share: exit statuses and messages, the types of flags, and where commands write."""

import argparse
import io
import os
import signal
from pathlib import Path

import pytest

from preface.artifacts import ArtifactError
from preface.cli import output
from preface.cli.folders import make_folder, require_own, require_writable
from preface.cli.typed_flags import refusing
from preface.cli.usage import UsageError


class ExpectedError(Exception):
    """What a command says that it may raise."""


def status_of(run, capsys):
    """Exit status, standard output and standard error of a command's work."""
    try:
        status = output.interruptible(
            lambda: output.exit_status(run, refusing("preface-x"), "here", lambda: (ExpectedError,))
        )
    except SystemExit as end:
        status = end.code
    return (status, *capsys.readouterr())


def raising(error):
    def run():
        raise error

    return run


def test_a_result_is_printed_and_errors_have_one_form_and_their_status(capsys):
    assert status_of(lambda: ["found", "rig.json"], capsys) == (0, "found\nrig.json\n", "")
    error = ArtifactError("a.json", "cameras[0]", "is missing", "Add it")
    assert status_of(raising(error), capsys) == (1, "", "a.json: cameras[0]: is missing. Add it.\n")
    assert status_of(raising(ExpectedError("too few")), capsys) == (1, "", "here: too few\n")
    status, out, err = status_of(raising(UsageError("--a and --b exclude each other")), capsys)
    assert (status, out) == (2, "")
    assert err == "preface-x: error: --a and --b exclude each other; see preface-x --help\n"


def test_a_defect_is_not_hidden_and_an_interruption_is_no_defect(capsys):
    with pytest.raises(ZeroDivisionError):
        status_of(lambda: [str(1 // 0)], capsys)
    interrupt = raising(KeyboardInterrupt())
    assert status_of(interrupt, capsys) == (128 + signal.SIGINT, "", "interrupted\n")
    assert output.resumable(lambda: output.exit_status(interrupt, refusing("x"), "here")) == 130
    assert "run the same command again to resume" in capsys.readouterr().err


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_whatever_a_file_is_called_it_can_be_printed(monkeypatch, encoding):
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr("sys.stdout", stream)
    assert output.print_lines(["\u4e2d.json", "bell\a", "\udce9"]) == 0
    lines = stream.buffer.getvalue().decode(encoding).splitlines()
    assert lines == ["\u4e2d.json" if encoding == "utf-8" else "\\u4e2d.json", "bell\\x07", "\\udce9"]


@pytest.mark.parametrize("text", ["", "two", "nan", "inf", "-inf", "1e400", "0x10"])
def test_what_is_no_finite_number_is_none(text):
    for kind in (output.number(-1e300, 1e300), output.positive, output.length):
        with pytest.raises(argparse.ArgumentTypeError, match=f"'{text}' is not a"):
            kind(text)


def test_limits_belong_to_a_range_and_zero_is_no_length():
    within = output.number(-1, 2.5)
    assert [within(text) for text in ("-1", "2.5", "0")] == [-1.0, 2.5, 0.0]
    for text in ("-1.01", "2.51"):
        with pytest.raises(argparse.ArgumentTypeError, match=r"not a number from -1 to 2\.5"):
            within(text)
    assert output.length("0.022") == 0.022
    for kind in (output.positive, output.length):
        with pytest.raises(argparse.ArgumentTypeError):
            kind("0")


def test_a_known_distance_is_two_names_and_a_length():
    assert output.known_distance(None) is None
    assert output.known_distance(["a", "b", "0.5"]) == ("a", "b", 0.5)
    for metres in ("far", "nan", "-1", "0"):
        with pytest.raises(UsageError, match=f"--known-distance: '{metres}' is not a length"):
            output.known_distance(["a", "b", metres])


# ----------------------------------------------------------------------------------------- folders


def test_a_folder_that_can_be_written_is_not_touched(tmp_path):
    require_writable(tmp_path / "not" / "yet" / "there")
    require_writable(tmp_path)
    assert list(tmp_path.iterdir()) == []
    folder = make_folder(tmp_path / "not" / "yet")
    assert folder.is_dir()
    assert make_folder(folder) == folder


@pytest.mark.parametrize("function", [require_writable, make_folder])
def test_a_folder_below_a_file_is_refused_with_the_remedy(tmp_path, function):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ArtifactError, match="one of its folders is a file"):
        function(tmp_path / "file" / "below")
    (tmp_path / "nowhere").symlink_to("gone")
    with pytest.raises(ArtifactError, match="nowhere: writing: "):
        function(tmp_path / "nowhere")


def test_a_folder_that_takes_no_files_is_refused_before_there_is_anything_to_write(monkeypatch, tmp_path):
    def refuse(*arguments, dir, **more):
        raise PermissionError(13, os.strerror(13), dir)

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    with pytest.raises(ArtifactError, match=r"permission denied\. Correct the permissions") as caught:
        require_writable(tmp_path / "new")
    assert caught.value.path == Path(tmp_path / "new")


def test_a_folder_with_others_things_is_refused_and_ones_own_gone_on_with(tmp_path):
    def refused():
        require_own(tmp_path, "a prior", ("model.json", ".run.lock"))

    refused()
    require_own(tmp_path / "new", "a prior", ("model.json",))
    (tmp_path / "events").mkdir()
    (tmp_path / ".DS_Store").touch()
    refused()  # nothing is lost among hidden files and empty folders
    for name in ("a.jpg", "b.jpg", "c.jpg", "d.jpg"):
        (tmp_path / name).touch()
    with pytest.raises(
        ArtifactError, match=r"holds other things than a prior \(a.jpg, b.jpg, c.jpg, \.\.\.\)"
    ) as told:
        refused()
    assert "Choose a new folder" in str(told.value)
    (tmp_path / ".run.lock").touch()
    refused()
    require_own(tmp_path, "renders", (), lambda entry: entry.suffix == ".png")
