"""``preface-build-shards``: what its flags refuse before anything is built."""

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "shards" / "dataset"))

from made_up_capture import Places, write_studio

from preface.cli import build_shards_dataset
from preface.cli.build_shards import main


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    """Three people; not to be changed."""
    return write_studio(tmp_path_factory.mktemp("studio"))


@pytest.mark.parametrize(
    ("holdout", "words"),
    [
        (
            "120%",
            "'120%' is neither a number of identities, a share between 0 and 1 (0.1 or 10%), nor a name",
        ),
        ("100%", "'100%' is neither"),
        ("0%", "'0%' is neither"),
        ("-5%", "'-5%' is neither"),
        ("nan", "'nan' is neither"),
        ("NaN%", "'NaN%' is neither"),
        ("1.5", "'1.5' is neither"),
        ("-2", "'-2' is neither"),
        ("0", "'0' of 3 identities is nobody"),
        ("1%", "'1%' of 3 identities is nobody"),
    ],
)
def test_a_holdout_that_is_no_part_of_the_people_is_wrong_usage(studio, tmp_path, capsys, holdout, words):
    with pytest.raises(SystemExit) as stopped:
        main(studio.arguments(tmp_path / "shards", "--dry-run", f"--holdout={holdout}"))
    assert stopped.value.code == 2
    assert f"--holdout: {words}" in capsys.readouterr().err


def test_an_output_that_cannot_be_written_is_told_before_people_are_looked_at(
    studio, tmp_path, capsys, unlooked
):
    (tmp_path / "file").write_text("mine")
    assert main(studio.arguments(tmp_path / "file" / "shards")) == 1
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'file' / 'shards'}: writing: ")


@pytest.fixture
def unlooked(monkeypatch):
    """Fails who opens a person's alignment or photographs."""
    monkeypatch.setattr(build_shards_dataset, "find_people", None)


@pytest.mark.parametrize(
    ("more", "status", "words"),
    [
        (["--holdout=100%"], 2, "--holdout: '100%' is neither"),
        (["--holdout", "1%"], 2, "'1%' of 3 identities is nobody"),
        (["--holdout", "3"], 1, "leave nobody for training"),
        (["--holdout", "p0", "nobody"], 1, "there is no 'nobody'"),
        (["--only", "p7"], 1, "there is no 'p7'"),
        (["--only", "p1", "--holdout", "p2"], 1, "there is no 'p2'"),
        (["--resolution", "24x30"], 1, "has another aspect"),
        (["--resolution", "192x256"], 1, "larger than the photograph"),
        (["--shard", "3", "--identities-per-shard", "1"], 1, "there is no shard 3, only 0 to 2"),
        (["--matting-model", "ABSENT"], 1, "there is no such file"),
        (["--foreground", "onnx", "--matting-model", "WORDS"], 1, "matting model"),
        (["--output", "OTHERS"], 1, "holds other things than a dataset"),
        (["--output", "OTHERS", "--dry-run"], 1, "holds other things than a dataset"),
        (["--rig", "ABSENT"], 1, "absent"),
        (["--scheduler", "dask"], 1, "Dask is not installed"),
    ],
)
def test_wrong_flags_are_refused_before_people_are_looked_at(
    studio, tmp_path, capsys, monkeypatch, unlooked, more, status, words
):
    monkeypatch.setitem(sys.modules, "distributed", None)
    (tmp_path / "others").mkdir()
    for name in ("words.onnx", "others/thesis.tex"):
        (tmp_path / name).write_text("years of work")
    places = {"ABSENT": "absent.onnx", "WORDS": "words.onnx", "OTHERS": "others"}
    given = [str(tmp_path / places[word]) if word in places else word for word in more]
    try:
        ended = main(studio.arguments(tmp_path / "shards", *given))
    except SystemExit as stopped:
        ended = stopped.code
    told = capsys.readouterr().err
    assert (ended, words in told) == (status, True), told
    assert "foreground by" not in told
    assert not (tmp_path / "shards").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--finish"], "2 of 2 shards are missing: 0, 1"),
        (["--strict"], "build without --strict to leave it out"),
        (["--holdout", "p1"], "there is no 'p1' among the 2 identities"),
        (["--shard", "2"], "there is no shard 2, only 0 to 1"),
    ],
)
def test_what_only_those_who_are_left_tell_is_told_before_photographs_are_decoded(
    studio, tmp_path, capsys, monkeypatch, more, words
):
    """Of three people, one has no photograph that could be used."""
    monkeypatch.setattr(build_shards_dataset, "foreground_choices", None)
    own = Places(*(tmp_path / path.name for path in (studio.capture, studio.rig, studio.alignment)))
    shutil.copytree(studio.capture.parent, tmp_path, dirs_exist_ok=True)
    for photograph in (own.capture / "subjects" / "p1").iterdir():
        photograph.write_bytes(b"")
    assert main(own.arguments(tmp_path / "shards", "--identities-per-shard", 1, *more)) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "shards").exists()
