"""``preface-build-shards export``: what it says beforehand, what it prints, what it refuses."""

import argparse
import shutil
from collections import namedtuple

import pytest

from preface.artifacts import ArtifactError
from preface.cli import build_shards_export
from preface.cli.inspect import inspect

Usage = namedtuple("Usage", "total used free")


def export(*arguments):
    parser = argparse.ArgumentParser()
    build_shards_export.add_arguments(parser)
    return build_shards_export.run(parser.parse_args([str(argument) for argument in arguments]))


@pytest.mark.parametrize("kind", ["rays", "transforms"])
def test_the_size_is_stated_before_anything_is_written(folder, tmp_path, capsys, kind):
    output = tmp_path / "out"
    lines = export(folder, "--format", kind, "--views", "camera0", "--output", output, "--dry-run")
    said = capsys.readouterr().err
    assert "5 views of 5 identities, 2,400 rays" in said
    assert lines[-1] == str(output)
    assert not output.exists()
    if kind == "rays":
        assert "bytes per ray" in said


@pytest.mark.parametrize(("kind", "file"), [("rays", "id0002.safetensors"), ("transforms", "id0002")])
def test_the_last_line_is_the_folder_that_was_written(folder, tmp_path, kind, file):
    output = tmp_path / "out"
    flags = ("--format", kind, "--identities", "id0002", "--views", "camera0", "--output", output)
    lines = export(folder, *flags, "--units", "scene")
    assert lines[-1] == str(output)
    assert [path.name for path in output.iterdir()] == [file]


@pytest.mark.parametrize("kind", ["rays", "transforms"])
def test_more_than_the_disk_has_room_for_is_refused_before_anything_is_written(
    folder, tmp_path, monkeypatch, kind
):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9 - 1000, 1000))
    with pytest.raises(ArtifactError, match="the disk has 1 KB left") as caught:
        export(folder, "--format", kind, "--views", "camera0", "--output", tmp_path / "new" / "out")
    assert "Choose fewer identities" in caught.value.remedy
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("kind", ["rays", "transforms"])
def test_an_export_can_be_inspected_as_a_folder_and_person_by_person(folder, tmp_path, kind):
    output = tmp_path / "out"
    people = ("id0001", "id0002")
    lines = export(
        folder, "--format", kind, "--identities", *people, "--views", "camera0", "--output", output
    )
    reports = inspect(output)
    assert [report.summary["identity"] for report in reports] == list(people)
    assert [str(report.path) for report in reports] == lines[:2]
    for report in [*reports, *inspect(lines[0])]:
        assert not report.problems
        assert report.summary["kind"].startswith("an export for other programs")
        assert report.summary["cameras"] == ["camera0"]


def test_an_image_that_is_missing_from_an_export_is_a_problem(folder, tmp_path):
    export(folder, "--format", "transforms", "--views", "camera0", "--output", tmp_path / "out")
    (tmp_path / "out" / "id0003" / "images" / "camera0.png").unlink()
    (problem,) = (problem for report in inspect(tmp_path / "out") for problem in report.problems)
    assert problem.path == tmp_path / "out" / "id0003" / "transforms.json"
    assert "there is no images/camera0.png beside it" in problem.problem
