"""The main job from shards on, by its commands: a prior, a head from two views, its orbit, its figures, the page."""

import json
import shutil
import subprocess
from pathlib import Path

import ball_heads
import pytest
import small_runs

import show_demo
from preface.artifacts import read_artifact, sha256
from preface.cli import evaluate, fit, inspect, render
from preface.model import pretrained
from preface.model.training.prior import train_prior

UNSEEN, VIEWS = "id0003", ["camera1", "camera4"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What the demo leaves behind, of balls."""
    folder = tmp_path_factory.mktemp("demo")
    shards = folder / "shards"
    shards.mkdir()
    ball_heads.write_dataset(shards)
    training = {"steps": 100, "views": 2, "rays": 32, "holdout_views": 0}
    run = {"micro_rays": 512, "faces_between": 0}
    train_prior(small_runs.config(shards, folder / "prior", training, run), small_runs.quiet)
    who = ["--identity", UNSEEN, "--views", *VIEWS, "--quality", "draft", "--device", "cpu"]
    how = ["--finetuning.rays", "128", "--finetuning.rate-last", "1e-4"]
    inversion = ["--inversion.steps", "15", "--inversion.lpips", "0", "--inversion.rate", "0.05"]
    from_prior = ["--prior", str(folder / "prior"), *inversion, "--finetuning.steps", "25"]
    alone = ["--prior", "none", "--like", str(folder / "prior"), "--finetuning.steps", "40"]
    for name, start in ((show_demo.HEAD, from_prior), (show_demo.BASELINE, alone)):
        assert fit.main([str(shards), *start, *who, *how, "--output", str(folder / name)]) == 0
    renders, evaluation = str(folder / "renders"), str(folder / "evaluation")
    orbit = ["--orbit", "3", "--video", "--no-exr", "--size", "24x32", "--output", renders]
    assert render.main([str(folder / show_demo.HEAD), *orbit]) == 0
    heads = [str(folder / name) for name in (show_demo.HEAD, show_demo.BASELINE)]
    assert evaluate.main([*heads, "--shards", str(shards), "--lpips", "none", "--output", evaluation]) == 0
    stages = "fit\t1.5\tpreface-fit shards\nevaluation\t2\tpreface-evaluate\nfit\t0.5\tpreface-fit shards\n"
    (folder / show_demo.STAGES_FILE).write_text(stages)
    return folder


def blocks(page, kind):
    twin = read_artifact(page.with_suffix(".json"), "preface/report")
    return [block for section in twin["sections"] for block in section["blocks"] if block["kind"] == kind]


def test_the_prior_gains_three_decibels_on_views_kept_away(made):
    figures = [
        json.loads((made / "evaluation" / name / "metrics.json").read_text())
        for name in (show_demo.HEAD, show_demo.BASELINE)
    ]
    assert all({view["name"] for view in f["views"]}.isdisjoint(VIEWS) for f in figures)
    assert figures[0]["mean"]["psnr"] > figures[1]["mean"]["psnr"] + 3


def test_every_artefact_is_valid(made, capsys):
    for folder in ("shards", "prior", show_demo.HEAD, show_demo.BASELINE, "evaluation/head"):
        assert inspect.main([str(made / folder)]) == 0, folder
    assert "valid" in capsys.readouterr().out


def test_the_page_shows_both_heads_the_orbit_and_every_command_once(made, capsys):
    assert show_demo.main([str(made)]) == 0
    page = made / "report.html"
    assert capsys.readouterr().out.strip() == str(page)
    mean = json.loads((made / "evaluation/head/metrics.json").read_text())["mean"]
    row = blocks(page, "table")[0]["rows"][0]
    assert row["with the prior"] == mean["psnr_face"]
    assert row["better by"] == pytest.approx(row["with the prior"] - row["without"])
    assert [row["time"] for row in blocks(page, "table")[-1]["rows"]] == [2.0, 2.0]
    assert len(blocks(page, "picture")) == 4
    assert len(blocks(page, "video")) == 1
    assert {"evaluation/report.html", "renders"} <= {
        link["path"] for link in blocks(page, "links")[0]["links"]
    }


def test_the_page_says_which_prior_was_used(made, tmp_path, monkeypatch):
    fit = {"prior": sha256(made / "prior" / "model.json")}
    assert "was trained here on 3 people" in show_demo.prior_words(made, fit)
    box = tmp_path / "box"
    shutil.copytree(made / "prior", box)
    for name in ("template.json", "MODEL_CARD.md"):
        (box / name).write_text("{}")
    monkeypatch.setattr(pretrained, "FOLDER", box)
    assert "is the one that comes with preface, trained on 3 people" in show_demo.prior_words(tmp_path, fit)
    with pytest.raises(show_demo.ArtifactError, match="is not that of"):
        show_demo.prior_words(tmp_path, {"prior": "0" * 64})


def test_the_demo_refuses_what_it_does_not_know_before_it_does_anything():
    script = Path(show_demo.__file__).with_name("demo.sh")
    run = subprocess.run(["bash", script, "--pretained"], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (2, "")
    assert "'--pretained' is not known" in run.stderr
    assert "--pretrained" in run.stderr


def test_what_is_missing_is_named(made, tmp_path, capsys):
    assert show_demo.main([str(tmp_path)]) == 1
    assert str(tmp_path / show_demo.HEAD) in capsys.readouterr().err
    (tmp_path / "stages.tsv").write_text("fit\tsoon\tpreface-fit\n")
    with pytest.raises(show_demo.ArtifactError, match="'soon' is not a number of seconds"):
        show_demo.read_stages(tmp_path / "stages.tsv")
