"""``preface-build-shards``: what its flags refuse before anything is built."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "shards" / "dataset"))

from made_up_capture import write_studio

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
    studio, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(build_shards_dataset, "find_people", None)
    (tmp_path / "file").write_text("mine")
    assert main(studio.arguments(tmp_path / "file" / "shards")) == 1
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'file' / 'shards'}: writing: ")
