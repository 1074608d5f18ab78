"""``preface-fit``: flags, exit statuses, what it prints; and from photographs to a head in one command."""

import subprocess
import sys
from pathlib import Path

import pytest

from preface.artifacts import load_json
from preface.cli.fit import FitCommand, PhotographsConfig, main, parse
from preface.cli.inspect_prior import summarise_prior
from preface.model.fitting.configuration import QUALITIES

for folder in ("training", "evaluation"):
    sys.path.insert(0, str(Path(__file__).parents[1] / "model" / folder))

SMALL = ["--device", "cpu", "--quality", "draft", "--inversion.lpips", "0", "--inversion.steps", "2"]
SMALL += ["--inversion.patches", "1", "--inversion.patch", "8", "--finetuning.steps", "2"]
SMALL += ["--finetuning.rays", "16", "--finetuning.normals", "0", "--log-every", "1"]
MODEL = ["--model.nerf.width", "16", "--model.nerf.depth", "2", "--model.samples", "6", "4"]
MODEL += ["--model.proposal.width", "8", "--model.proposal.depth", "1"]


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    import ball_heads

    folder = tmp_path_factory.mktemp("balls")
    ball_heads.write_dataset(folder)
    return folder


def status_of(arguments):
    try:
        return main([str(word) for word in arguments])
    except SystemExit as end:
        return end.code


def test_help_names_every_flag_and_loads_neither_torch_nor_numpy():
    code = """
import sys
from preface.cli.fit import parse
try:
    parse(["--help"])
except SystemExit as end:
    print(end.code, "torch" in sys.modules, "numpy" in sys.modules)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "0 False False"
    for flag in ("--prior", "--views", "--refine-cameras", "--inversion.steps", "--photos.template"):
        assert flag in run.stdout


@pytest.mark.parametrize("quality", QUALITIES)
def test_a_quality_sets_the_defaults_of_all_flags(quality):
    found = parse(["shards", "--quality", quality, "--views", "a", "b", "--finetuning.rays", "77"])
    inversion, finetuning, run = QUALITIES[quality]
    assert (found.inversion, found.run, found.quality) == (inversion, run, quality)
    assert (found.finetuning.rays, found.finetuning.rate) == (77, finetuning.rate)
    assert (found.views, found.photos) == (("a", "b"), PhotographsConfig())


def test_wrong_usage_ends_with_status_two(balls, tmp_path, capsys):
    assert status_of([]) == 2
    assert status_of([balls, "--quality", "best"]) == 2
    assert status_of([balls, "--prior", "none", "--output", tmp_path / "h"]) == 2  # no views
    assert "preface-fit: error: --views: 0 cameras" in capsys.readouterr().err
    assert status_of([balls, "--photos.resolution", "8x8", "--views", "camera0"]) == 2
    assert "is for a folder of photographs" in capsys.readouterr().err


def test_a_folder_of_neither_kind_is_refused(tmp_path, capsys):
    assert status_of([tmp_path]) == 1
    told = f"{tmp_path}: folder: holds neither shards (manifest.json) nor photographs"
    assert capsys.readouterr().err.startswith(told)
    (tmp_path / "subjects").mkdir()
    assert status_of([tmp_path]) == 1
    assert "is a capture" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words"),
    [("gone", "folder: there is no such folder"), ("me.jpg", "file: is a file, and neither")],
)
def test_what_is_no_folder_is_said_to_be_none_whatever_else_is_missing(tmp_path, capsys, name, words):
    (tmp_path / "me.jpg").touch()
    for more in ([], ["--views", "a", "--prior", "none"]):
        assert status_of([tmp_path / name, *more]) == 1
        told = capsys.readouterr().err
        assert told.startswith(f"{tmp_path / name}: {words}")
        assert "one of one to seven photographs" in told


def test_shards_may_be_given_by_their_manifest(balls, tmp_path, capsys):
    assert status_of([balls / "manifest.json", "--prior", "none", "--output", tmp_path / "h"]) == 2
    assert "--views: 0 cameras" in capsys.readouterr().err


def test_a_head_is_fitted_and_its_path_printed_last(balls, tmp_path, capsys):
    head = tmp_path / "head"
    words = [balls, "--prior", "none", "--identity", "id0003", "--views", "camera1", "camera4"]
    assert status_of([*words, "--output", head, *SMALL, *MODEL]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(head / "model.json")
    fit = load_json(head / "model.json")["fit"]
    assert (fit["identity"], fit["views"], fit["prior"]) == ("id0003", ["camera1", "camera4"], None)
    problems = []
    said = summarise_prior(head, problems)
    assert problems == []
    assert (said["head_of"], said["fitted_to"]) == ("id0003", ["camera1", "camera4"])
    assert (said["from"], said["fitted_at"], said["finetuning"]) == ("random weights", "24x32", "2 steps")
    assert status_of([*words, "--output", head, *SMALL, *MODEL]) == 0
    assert "are taken already" in capsys.readouterr().err
    assert status_of([*words, "--output", head, *SMALL, *MODEL, "--seed", "5"]) == 1
    assert "seed is 0 there and 5 now" in capsys.readouterr().err


@pytest.mark.parametrize(("kept", "words"), [(True, "kept, "), (False, "not kept, ")])
def test_what_became_of_corrections_of_the_cameras_is_inspected(tmp_path, kept, words):
    from untrained import fitted_to, write_model

    fit = fitted_to(["camera1"]) | {"refinement": {"gain_db": -0.123, "kept": kept}}
    said = summarise_prior(write_model(tmp_path, ["id0000"], fit=fit), [])
    assert said["corrections_of_cameras"] == f"{words}views met -0.12 dB better with them"


def test_a_command_fits_what_it_was_told():
    command = parse(["p", "--views", "x", "--seed", "3", "--refine-cameras"])
    config = command.fit(Path("s"), "anna", ("a", "b"))
    assert type(config) is not FitCommand
    assert (config.shards, config.identity, config.views) == (Path("s"), "anna", ("a", "b"))
    assert (config.seed, config.refine_cameras) == (3, True)


def test_a_folder_that_holds_other_things_is_left_alone(balls, tmp_path, capsys):
    (tmp_path / "capture.json").write_text("{}")
    assert status_of([balls, "--prior", "none", "--views", "camera0", "--output", tmp_path]) == 1
    assert "holds other things than a head (capture.json)" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["capture.json"]


def test_an_interrupted_preparation_of_photographs_is_gone_on_with(tmp_path, capsys):
    (tmp_path / "head" / "photos" / "alignment").mkdir(parents=True)
    (tmp_path / "head" / "photos" / "template.json").write_text("{}")
    (tmp_path / "none").mkdir()
    assert status_of([tmp_path / "none", "--output", tmp_path / "head"]) == 1
    assert "holds neither shards" in capsys.readouterr().err  # it is about the photographs, not the output
