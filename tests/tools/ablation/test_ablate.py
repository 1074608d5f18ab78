"""``tools/ablate.py`` from ball-shaped heads and a prior that was hardly trained to tables, and again."""

import itertools
import json
import shutil
from pathlib import Path

import ball_heads
import numpy as np
import pytest
import small_runs
import torch

import ablate
from ablation import running
from ablation.priors import halved_shards, nested, subset_shards
from preface.artifacts import load_json, write_artifact
from preface.model.training.loop import Ended
from preface.model.training.prior import train_prior
from preface.model.training.prior_files import read_prior
from preface.shards import Dataset

CHEAP = ["--quality", "draft", "--inversion-steps", "1", "--finetuning-steps", "2", "--rays", "16"]
CHOICE = ["--only", "frozen-latent", "identities", "--seeds", "0", "--prior-identities", "1"]


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shards")
    ball_heads.write_dataset(folder)
    return folder


@pytest.fixture(scope="module")
def prior(shards, tmp_path_factory):
    folder = tmp_path_factory.mktemp("prior")
    changes = {"training": {"steps": 4}, "run": {"validate_every": 4, "faces_between": 0}}
    assert train_prior(small_runs.config(shards, folder, **changes), small_runs.quiet).status == 0
    return folder


def run(shards, prior, output, *more):
    return ablate.main([str(shards), "--prior", str(prior), "--output", str(output), *more])


def test_tables_are_made_and_gone_on_with(shards, prior, tmp_path, capsys):
    asked = [shards, prior, tmp_path, *CHOICE, *CHEAP]
    assert run(*asked, "--plan") == 0
    plan = capsys.readouterr().out
    assert "| prior identities-1 | 0 | 1 |" in plan
    assert "| all | 0 | 4 |" in plan
    assert not list(tmp_path.rglob("*.json"))

    assert run(*asked) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == str(tmp_path / "ablation.md")
    cells = {path.parent.name: path for path in (tmp_path / "cells").rglob("*.json")}
    assert set(cells) == {"full", "frozen-latent", "identities-1"}
    report = json.loads((tmp_path / "ablation.json").read_text())
    assert [table["table"] for table in report["tables"]] == ["frozen-latent", "identities"]

    # The table's figure is the cell's, which is the mean of its views.
    content = json.loads(cells["full"].read_text())
    assert content["settings"]["fit"]["views"] == ["camera1", "camera4"]
    assert content["settings"]["held_out"] == list(content["views"]) == ["camera3"]
    mean = np.mean([view["psnr_face"] for view in content["views"].values()])
    row = next(row for row in report["tables"][0]["rows"] if row["variant"] == "full")
    assert row["ours"]["psnr"]["mean"] == pytest.approx(mean)

    # The smaller prior saw one of the three people, for as many steps.
    smaller = read_prior(tmp_path / "priors" / "identities-1")
    assert len(smaller.identities) == 1
    assert set(smaller.identities) < set(read_prior(prior).identities)
    assert smaller.steps == read_prior(prior).steps

    # A cell that is missing is made again, and nothing else.
    others = {name: path.stat().st_mtime_ns for name, path in cells.items() if name != "full"}
    cells["full"].unlink()
    assert run(*asked) == 0
    assert {name: cells[name].stat().st_mtime_ns for name in others} == others
    assert json.loads(cells["full"].read_text())["figures"] == pytest.approx(content["figures"])
    assert run(*asked, "--plan") == 0
    assert "| all | 3 | 3 | 0 s |" in capsys.readouterr().out

    # Other settings are refused: cells of one table are of one method.
    assert run(*asked, "--rays", "32") == 1
    assert "fit.finetuning.rays is 16 there and 32 now" in capsys.readouterr().err


def test_an_interrupted_fit_ends_the_run_with_its_status_and_is_not_taken_for_a_result(
    shards, prior, tmp_path, monkeypatch, capsys
):
    interrupted = Ended(tmp_path / "model.json", 130)
    monkeypatch.setattr(running, "fit_head", lambda config, say: interrupted)
    assert run(shards, prior, tmp_path, "--only", "regularisers", *CHEAP) == 130
    assert "run the same command again" in capsys.readouterr().err
    assert not list((tmp_path / "cells").rglob("*.json"))


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--only", "regularizers"], 2, "regularisers"),
        (["--identities", "id0000"], 2, "the prior was trained on this person"),
        (["--identities", "id0009"], 2, "id0009"),
        (["--views", "camera0", "camera1"], 2, "five from one side to the other"),
        (["--views", "camera0", "camera1", "camera2", "camera3", "camera9"], 2, "camera9"),
        (["--prior-identities", "1", "2", "3", "4"], 2, "4 numbers"),
        (["--finetuning-steps", "0"], 2, "at least 1"),
    ],
)
def test_what_cannot_be_is_told_before_anything_is_made(
    shards, prior, tmp_path, arguments, status, words, capsys
):
    try:
        ended = run(shards, prior, tmp_path / "out", *arguments)
    except SystemExit as error:
        ended = error.code
    assert ended == status
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_people_of_a_smaller_prior_are_among_those_of_each_larger_one(shards, tmp_path):
    names = [f"id{number:04d}" for number in range(60)]
    chosen = [nested(names, count) for count in (4, 15, 30, 60)]
    assert [len(each) for each in chosen] == [4, 15, 30, 60]
    assert all(set(few) < set(many) for few, many in itertools.pairwise(chosen))
    with Dataset(shards) as dataset:
        subset_shards(dataset, ["id0001"], "train", tmp_path)
        with Dataset(tmp_path) as smaller:
            assert smaller.manifest.splits == {"train": ("id0001",), "unused": ("id0000", "id0002", "id0003")}
            np.testing.assert_array_equal(smaller.manifest.box, dataset.manifest.box)
            np.testing.assert_array_equal(smaller.pixels(1, 2), dataset.pixels(1, 2))


def test_half_the_resolution_sees_the_same_with_a_quarter_of_the_pixels(shards, tmp_path):
    with Dataset(shards) as dataset:
        halved_shards(dataset, ["id0000", "id0002"], "train", tmp_path)
        with Dataset(tmp_path) as half:
            assert (half.manifest.width, half.manifest.height) == (12, 16)
            assert half.names == ("id0000", "id0002")
            assert half.verify() == []
            # A pixel looks where the corner between its four did: same pose, focal length and middle halved.
            np.testing.assert_allclose(
                half.tables["intrinsics"][1, :, :4], dataset.tables["intrinsics"][2, :, :4] / 2
            )
            np.testing.assert_array_equal(
                half.tables["canonical_from_camera"][1], dataset.tables["canonical_from_camera"][2]
            )
            mask = dataset.pixels(2, 3)[..., 3].astype(float)
            means = mask.reshape(16, 2, 12, 2).mean(axis=(1, 3))
            np.testing.assert_allclose(half.pixels(1, 3)[..., 3], means, atol=0.51)


def test_names_are_the_same_people_only_in_the_shards_that_the_prior_was_trained_on(
    shards, prior, tmp_path, capsys, monkeypatch
):
    monkeypatch.syspath_prepend(Path(small_runs.__file__).parents[1] / "evaluation")
    from untrained import write_model

    with Dataset(shards) as dataset:
        everybody = list(dataset.names)
    elsewhere = write_model(tmp_path / "elsewhere", everybody)
    asked = ["--only", "regularisers", *CHEAP, "--plan"]
    assert run(shards, elsewhere, tmp_path / "out", *asked) == 1
    said = capsys.readouterr().err
    assert "which was trained on other shards, knows everybody's name" in said
    assert f"--identities {' '.join(everybody[:3])}" in said
    # The prior of these shards, as if it were one of others.
    trained = Path(shutil.copytree(prior, tmp_path / "trained"))
    content = load_json(trained / "model.json")
    content["provenance"]["inputs"]["manifest.json"] = "0" * 64
    write_artifact(trained / "model.json", content)
    known = content["identities"][0]
    assert run(shards, trained, tmp_path / "out", *asked, "--identities", known) == 0
    assert f"'{known}', from other shards; taken for another person" in capsys.readouterr().err


def test_smaller_priors_need_the_people_of_the_full_one(shards, tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(Path(small_runs.__file__).parents[1] / "evaluation")
    from untrained import write_model

    strangers = write_model(tmp_path / "prior", ["somebody", "else"])
    namesakes = write_model(tmp_path / "namesakes", ["id0001", "id0002"])
    assert run(shards, namesakes, tmp_path / "out", *CHOICE, *CHEAP, "--plan") == 1
    assert "are not those that the prior was trained on" in capsys.readouterr().err
    assert run(shards, strangers, tmp_path / "out", *CHOICE, *CHEAP, "--plan") == 1
    said = capsys.readouterr().err
    assert "'somebody', whom the prior was trained on, is not there" in said
    assert "--only initialisation regularisers views frozen-latent" in said
