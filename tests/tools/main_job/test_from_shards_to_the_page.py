"""The main job from shards on, by its commands: a prior, a head from two views, its orbit, its figures, the page."""

import json
import shutil
import subprocess
from pathlib import Path

import ball_heads
import numpy as np
import pytest
import small_runs

import show_demo
from bench.head_truth_pictures import write_pictures
from demo_page.heads import BASELINE, FROM_THE_BOX, HEAD
from demo_page.stages import camera_error, read_stages, result_of
from preface.artifacts import ArtifactError, read_artifact
from preface.capture.rig import Rig, RigCamera
from preface.cli import evaluate, fit, inspect, render
from preface.geometry import Camera, Similarity
from preface.model import pretrained
from preface.model.rendering.paths import look_at
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
    for name, start in ((HEAD, from_prior), (BASELINE, alone)):
        assert fit.main([str(shards), *start, *who, *how, "--output", str(folder / name)]) == 0
    renders, evaluation = str(folder / "renders"), str(folder / "evaluation")
    orbit = ["--orbit", "3", "--video", "--no-exr", "--size", "24x32", "--output", renders]
    assert render.main([str(folder / HEAD), *orbit]) == 0
    measured = [str(folder / name) for name in (HEAD, BASELINE)]
    assert (
        evaluate.main(
            [*measured, "--shards", str(shards), "--lpips", "none", "--images", "--output", evaluation]
        )
        == 0
    )
    stages = "fit\t9.6\tpreface-fit shards\nevaluation\t2\tpreface-evaluate\nfit\t4.2\tpreface-fit shards\n"
    (folder / show_demo.STAGES_FILE).write_text(stages)
    return folder


def blocks(page, kind):
    twin = read_artifact(page.with_suffix(".json"), "preface/report")
    return [block for section in twin["sections"] for block in section["blocks"] if block["kind"] == kind]


def test_the_prior_gains_three_decibels_on_views_kept_away(made):
    figures = [
        json.loads((made / "evaluation" / name / "metrics.json").read_text()) for name in (HEAD, BASELINE)
    ]
    assert all({view["name"] for view in f["views"]}.isdisjoint(VIEWS) for f in figures)
    assert figures[0]["mean"]["psnr"] > figures[1]["mean"]["psnr"] + 3


def test_every_artefact_is_valid(made, capsys):
    for folder in ("shards", "prior", HEAD, BASELINE, "evaluation/head"):
        assert inspect.main([str(made / folder)]) == 0, folder
    assert "valid" in capsys.readouterr().out


def test_the_page_shows_the_heads_the_orbit_and_every_command_with_its_last_run(made, capsys):
    assert show_demo.main([str(made)]) == 0
    page = made / "report.html"
    assert capsys.readouterr().out.strip() == str(page)
    mean = json.loads((made / "evaluation/head/metrics.json").read_text())["mean"]
    own, none = blocks(page, "table")[0]["rows"]
    assert (own["fitted from"], own["people"]) == ("this demo's prior", 3)
    assert (none["fitted from"], none["people"]) == ("no prior", None)
    assert own["face PSNR"] == mean["psnr_face"]
    assert own["silhouette"] == mean["silhouette_iou"]
    gained = blocks(page, "key_figures")[0]["figures"][-1]
    assert gained["value"] == f"{mean['psnr_face'] - none['face PSNR']:+.1f}"
    fitted, evaluated = blocks(page, "table")[-2]["rows"]
    assert (fitted["time"], evaluated["time"]) == (4, 2)
    assert f"{mean['psnr_face']:.1f} dB on the face" in fitted["what came of it"]
    assert evaluated["what came of it"] == f"{len(json_views(made))} views kept away"
    commands = [row["command"] for row in blocks(page, "table")[-1]["rows"]]
    assert commands == ["preface-fit shards", "preface-evaluate"]
    assert len(blocks(page, "picture")) == 3  # inputs, views, orbit
    assert "40 degrees either way" in blocks(page, "video")[0]["caption"]
    assert {"evaluation/report.html", "renders"} <= {
        link["path"] for link in blocks(page, "links")[0]["links"]
    }


def json_views(made):
    return json.loads((made / "evaluation/head/metrics.json").read_text())["views"]


def as_if_from_the_box(made, folder, monkeypatch):
    """The demo again, its head standing for one from the prior in the box, too, with made-up errors of surfaces."""
    shutil.copytree(made, folder)
    for name in ("head", "shards", "renders"):
        shutil.copytree(made / name, folder / f"{name}-pretrained")
    shutil.copytree(made / "evaluation/head", folder / "evaluation-pretrained/head-pretrained")
    box = folder / "box"
    shutil.copytree(made / "prior", box)
    for name in ("template.json", "MODEL_CARD.md"):
        (box / name).write_text("{}")
    monkeypatch.setattr(pretrained, "FOLDER", box)
    flat = np.ones((32, 24))
    facing = np.broadcast_to([0.0, 0.0, 1.0], (32, 24, 3))
    for suffix, names in (("", (HEAD, BASELINE)), ("-pretrained", (FROM_THE_BOX,))):
        figures = {"depth_median_mm": 4.25, "density_normals_median_deg": 20.0}
        errors = [{"head": f"demo/{name}", "views": {"camera0": figures}, "mean": figures} for name in names]
        (folder / f"geometry{suffix}.json").write_text(json.dumps({"heads": errors}))
        for name in names:
            shown = folder / "geometry" / name
            shown.mkdir(parents=True)
            write_pictures(shown, "camera0", (flat, flat, 0 * flat), (facing, facing, 0 * flat))


def test_the_head_from_the_prior_in_the_box_stands_first_and_surfaces_beside_the_truth(
    made, tmp_path, monkeypatch
):
    folder = tmp_path / "demo"
    as_if_from_the_box(made, folder, monkeypatch)
    assert show_demo.main([str(folder)]) == 0
    page = folder / "report.html"
    rows = blocks(page, "table")[0]["rows"]
    assert [row["fitted from"] for row in rows] == ["the prior in the box", "this demo's prior", "no prior"]
    assert {row["depth off"] for row in rows} == {4.25}
    assert len(blocks(page, "video")) == 2
    assert len(blocks(page, "picture")) == 6  # inputs, views, depth, normals, and two orbits
    box, own, none, blurred, beside = blocks(page, "text")[1]["paragraphs"]
    assert "comes with preface and was trained on 3 people" in box
    assert "was trained here on 3 people" in own
    assert "from random weights" in none
    assert "blurred" in blurred
    assert "more people" in beside
    assert result_of("geometry, the prior in the box", folder) == (
        "depth off by 4.2 mm, normals by 20° (medians, 1 views)"
    )


def test_a_head_of_another_prior_than_the_one_that_is_there_is_refused(made, tmp_path, monkeypatch):
    folder = tmp_path / "demo"
    as_if_from_the_box(made, folder, monkeypatch)
    monkeypatch.undo()
    assert show_demo.main([str(folder)]) == 1
    with pytest.raises(ArtifactError, match="is not that of"):
        show_demo.build_report(folder)


def test_what_came_of_the_stages_is_read_from_what_they_left(made, tmp_path):
    assert result_of("shards", made).endswith("MB")
    assert result_of("prior", made) == "3 people, 100 steps"
    assert result_of("orbit", made) == "3 frames"
    assert result_of("inspection", made) == ""
    people = tmp_path / "alignment"
    people.mkdir()
    index = {"aligned": [{"file": "id0000.json"}], "excluded": [{"identity": "id0001"}]}
    (people / "alignment.json").write_text(json.dumps(index))
    (people / "id0000.json").write_text(json.dumps({"residuals": {"chin": 3e-3, "nose_tip": 4e-3}}))
    assert result_of("alignment", tmp_path) == "1 of 2 aligned, keypoints 3.5 mm from the template (RMS)"


def test_a_rig_is_held_against_the_truth_whatever_its_frame_but_not_its_scale():
    camera = Camera("PINHOLE", 30, 40, np.array([100.0, 100.0, 15.0, 20.0]))
    poses = [look_at(np.array([np.sin(a), 0.2 * a, np.cos(a)]), np.zeros(3)) for a in (-0.6, -0.1, 0.3, 0.8)]

    def rig(poses):
        cameras = {f"cam{i}": RigCamera.at(camera, pose.inverse) for i, pose in enumerate(poses)}
        return Rig("take00", cameras, None, None, {})

    turned = Similarity(np.array(1.0), poses[2].rotation, np.array([1.0, 2.0, 3.0]))
    assert camera_error(rig([turned.apply_to_pose(pose) for pose in poses]), rig(poses)) < 1e-9
    larger = Similarity(np.array(1.01), np.eye(3), np.zeros(3))
    assert 1 < camera_error(rig([larger.apply_to_pose(pose) for pose in poses]), rig(poses)) < 10


def test_the_demo_refuses_what_it_does_not_know_before_it_does_anything():
    script = Path(show_demo.__file__).with_name("demo.sh")
    run = subprocess.run(["bash", script, "--pretained"], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (2, "")
    assert "'--pretained' is not known" in run.stderr
    assert "--pretrained" in run.stderr


def test_what_is_missing_is_named(made, tmp_path, capsys):
    assert show_demo.main([str(tmp_path)]) == 1
    assert str(tmp_path / HEAD) in capsys.readouterr().err
    (tmp_path / "stages.tsv").write_text("fit\tsoon\tpreface-fit\n")
    with pytest.raises(ArtifactError, match="'soon' is not a number of seconds"):
        read_stages(tmp_path / "stages.tsv")
