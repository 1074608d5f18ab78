"""Which rigs a path means, and where a new rig and its report go."""

import shutil
from pathlib import Path

import pytest

from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError
from preface.cli.rig_files import new_report_file, new_rig_file, one_rig_file, rig_files
from preface.cli.usage import UsageError


@pytest.fixture
def takes(tmp_path):
    """What a calibration of two takes leaves."""
    (tmp_path / "rigs").mkdir()
    for name in ("take00", "take01"):
        shutil.copy(SCHEMA_DIRECTORY / "rig.example.json", tmp_path / "rigs" / f"{name}.json")
    (tmp_path / "rigs" / "take00.corners.json").write_text('{"schema": "preface/corners"}')
    return tmp_path


def test_a_folder_means_its_rigs_and_nothing_else(takes):
    assert rig_files(takes) == [takes / "rigs/take00.json", takes / "rigs/take01.json"]
    assert rig_files(takes / "rigs/take01.json") == [takes / "rigs/take01.json"]
    (takes / "empty").mkdir()
    with pytest.raises(ArtifactError, match="holds no rig"):
        rig_files(takes / "empty")


def test_where_one_rig_is_wanted_several_are_named(takes):
    with pytest.raises(ArtifactError) as caught:
        one_rig_file(takes)
    assert caught.value.problem == "holds several rigs: rigs/take00.json, rigs/take01.json"
    assert caught.value.remedy == f"Name one, such as {takes / 'rigs/take00.json'}"
    (takes / "rigs/take01.json").unlink()
    assert one_rig_file(takes) == takes / "rigs/take00.json"
    shutil.copy(takes / "rigs/take00.json", takes / "rig.json")
    assert one_rig_file(takes) == takes / "rig.json"
    assert one_rig_file(takes / "gone.json") == takes / "gone.json"


def test_a_new_rig_goes_into_a_folder_or_is_the_file(tmp_path):
    assert new_rig_file(tmp_path) == tmp_path / "rig.json"
    assert new_rig_file(Path("new")) == Path("new/rig.json")
    assert new_rig_file(Path("mine.json")) == Path("mine.json")
    assert new_report_file(None, Path("a/mine.json")) == Path("a/mine.report.html")
    assert new_report_file(Path("page.html"), Path("mine.json")) == Path("page.html")
    with pytest.raises(UsageError, match=r"page\.pdf does not end in \.html"):
        new_report_file(Path("page.pdf"), Path("mine.json"))
