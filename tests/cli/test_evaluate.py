"""``preface-evaluate`` as a user runs it, on heads of ball-shaped people that were never trained."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from preface.artifacts import read_artifact
from preface.cli.evaluate import main
from preface.cli.inspect import inspect
from preface.model.evaluation.metrics_file import read_metrics

for folder in ("training", "evaluation"):
    sys.path.insert(0, str(Path(__file__).parents[1] / "model" / folder))


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> Path:
    import ball_heads

    folder = tmp_path_factory.mktemp("balls")
    ball_heads.write_dataset(folder)
    return folder


@pytest.fixture(scope="module")
def models(tmp_path_factory) -> Path:
    """Two heads of one person, one of them elsewhere under the same name, and a prior."""
    from untrained import fitted_to, write_model

    folder = tmp_path_factory.mktemp("models")
    two, three = fitted_to(["camera0", "camera1"]), fitted_to(["camera1", "camera2", "camera3"])
    write_model(folder / "with" / "head", ["id0000"], fit=two)
    write_model(folder / "without" / "head", ["id0000"], fit=three, seed=1, latent=0)
    write_model(folder / "all", ["id0000"], fit=fitted_to([f"camera{n}" for n in range(6)]))
    write_model(folder / "prior", ["id0000", "id0001"], held_out={"id0001": ("camera4",)})
    return folder


def test_heads_side_by_side_leave_figures_tables_pictures_and_a_page(models, shards, tmp_path, capsys):
    out = tmp_path / "out"
    heads = [str(models / "with" / "head"), str(models / "without" / "head" / "model.json")]
    assert main([*heads, "--shards", str(shards), "--output", str(out), "--lpips", "none"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(out / "report.html")
    names = ["with-head", "without-head"]
    assert {path.name for path in out.iterdir()} == {
        *("metrics.md", "metrics.tex", "report.html", "report.json"),
        *names,
    }
    for name in names:
        content = read_metrics(out / name)
        # The views that neither of them has seen.
        assert [view["name"] for view in content["views"]] == ["camera4", "camera5"]
        assert {"psnr", "ssim", "psnr_face", "silhouette_iou"} <= set(content["mean"])
        assert cv2.imread(str(out / name / "sheet.png")).std() > 1
        mean = f"{content['mean']['psnr']:.2f}"
        for table in ("metrics.md", "metrics.tex"):
            assert mean in (out / table).read_text()
    assert len((out / "metrics.md").read_text().splitlines()) == 4
    read_artifact(out / "report.json", "preface/report")
    (report,) = inspect(out / "with-head")
    assert not report.problems
    assert report.summary["views"] == ["camera4", "camera5"]
    assert report.summary["kind"] == "head"
    # The folder itself stands for all of them.
    assert [one.path.parent.name for one in inspect(out)] == ["out", *names]


def test_a_figure_that_no_view_can_have_is_told_of_once(models, shards, tmp_path, capsys):
    arguments = [
        "--shards",
        str(shards),
        "--output",
        str(tmp_path / "out"),
        "--lpips",
        "alex",
        "--no-normals",
    ]
    assert main([str(models / "with" / "head"), *arguments]) == 0
    told = "".join(capsys.readouterr())
    assert told.count("no lpips_alex: 24x32 pixels are too few") == 1
    views = read_metrics(tmp_path / "out" / "head")["views"]
    assert len(views) > 1
    assert all("lpips_alex" in view["left_out"] for view in views)


def test_a_folder_that_holds_other_things_is_left_alone(models, shards, tmp_path, capsys):
    (tmp_path / "holiday.jpg").write_bytes(b"mine")
    arguments = ["--shards", str(shards), "--output", str(tmp_path), "--lpips", "none"]
    assert main([str(models / "with" / "head"), *arguments]) == 1
    assert "holds other things than an evaluation (holiday.jpg)" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]


def test_normals_are_left_out_when_they_are_not_wanted_and_no_figure_changes(models, shards, tmp_path):
    common = [str(models / "prior"), "--shards", str(shards), "--identity", "id0001", "--lpips", "none"]
    assert main([*common, "--output", str(tmp_path / "shown")]) == 0
    assert main([*common, "--output", str(tmp_path / "plain"), "--no-normals"]) == 0
    shown, plain = (read_metrics(tmp_path / name / "prior") for name in ("shown", "plain"))
    assert shown["views"] == plain["views"]
    assert shown["settings"] == plain["settings"]
    pages = [(tmp_path / name / "report.json").read_text() for name in ("shown", "plain")]
    assert ["normals in the canonical frame" in page for page in pages] == [True, False]


def test_a_prior_is_evaluated_at_the_view_that_it_held_out_and_images_are_kept_when_asked_for(
    models, shards, tmp_path
):
    out = tmp_path / "out"
    arguments = ["--shards", str(shards), "--output", str(out), "--images"]
    assert main([str(models / "prior"), *arguments, "--identity", "id0001"]) == 0
    (view,) = read_metrics(out / "prior")["views"]
    assert view["name"] == "camera4"
    assert view["lpips"] > 0
    assert "24x32 pixels are too few: alex needs 31" in view["left_out"]["lpips_alex"]
    images = [cv2.imread(str(out / "prior" / f"camera4{kind}.png")) for kind in ("", ".truth", ".error")]
    assert {image.shape for image in images} == {(32, 24, 3)}
    # Bytes are rounded, the figure is not.
    error = np.mean((images[0] / 255 - images[1] / 255) ** 2)
    assert -10 * np.log10(error) == pytest.approx(view["psnr"], abs=0.05)


def test_the_same_command_writes_the_same_bytes(models, shards, tmp_path, monkeypatch):
    contents = []
    for place in ("one", "two"):
        (tmp_path / place).mkdir()
        monkeypatch.chdir(tmp_path / place)
        arguments = ["--shards", str(shards), "--output", "out", "--lpips", "none", "--views", "camera5"]
        assert main([str(models / "with" / "head"), *arguments]) == 0
        files = sorted(path for path in Path("out").rglob("*") if path.is_file())
        contents.append({str(path): path.read_bytes() for path in files})
    assert contents[0] == contents[1]


@pytest.mark.parametrize(
    ("heads", "flags", "status", "words"),
    [
        (["prior"], [], 1, "--identity"),
        (["prior"], ["--identity", "id0002"], 1, "there is no 'id0002'"),
        (["prior"], ["--identity", "id0000"], 1, "no view of 'id0000' is left"),
        (["all"], [], 1, "no view of 'id0000' is left"),
        (["with/head"], ["--identity", "id0001"], 1, "Perhaps 'id0000' was meant"),
        (["with/head"], ["--views", "camera4", "camera6"], 1, "has no view 'camera6'"),
        (["with/head"], ["--views"], 2, "expected at least one argument"),
        (["with/head"], ["--face-half-side", "-1"], 2, "0.001 to 10"),
        (["with/head"], ["--device", "cuda:77"], 2, "--device"),
        (["with/head"], ["--lpips", "squeeze"], 2, "squeeze"),
        (["with/head", "with/head"], [], 1, "given twice"),
        (["absent"], [], 1, "absent"),
        ([], [], 2, "HEAD"),
    ],
)
def test_what_cannot_be_is_told_before_anything_is_written(
    models, shards, tmp_path, heads, flags, status, words, capsys
):
    arguments = [*(str(models / head) for head in heads), "--shards", str(shards)]
    try:
        ended = main([*arguments, "--output", str(tmp_path / "out"), *flags])
    except SystemExit as error:
        ended = error.code
    assert ended == status
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_missing_weights_of_lpips_are_told_before_anything_is_rendered(
    models, shards, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("PREFACE_CACHE", str(tmp_path / "nothing"))
    out = tmp_path / "out"
    assert main([str(models / "with" / "head"), "--shards", str(shards), "--output", str(out)]) == 1
    assert "python -m preface.model.metrics.lpips_weights" in capsys.readouterr().err
    assert not out.exists()


def test_shards_that_are_none_or_of_another_box_weights_that_are_missing_and_unwritable_outputs_are_errors(
    models, shards, tmp_path, capsys
):
    head = models / "with" / "head"
    assert main([str(head), "--shards", str(tmp_path), "--output", str(tmp_path / "out")]) == 1
    assert "manifest.json" in capsys.readouterr().err
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "model.json").write_bytes((head / "model.json").read_bytes())
    arguments = ["--shards", str(shards), "--output", str(tmp_path / "out")]
    assert main([str(head), str(tmp_path / "copy"), *arguments]) == 1
    assert "model.safetensors" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").touch()
    arguments = ["--shards", str(shards), "--lpips", "none", "--output", str(tmp_path / "file" / "out")]
    assert main([str(head), *arguments]) == 1
    assert "file" in capsys.readouterr().err
    content = json.loads((head / "model.json").read_text())
    content["box"][0][0] -= 0.01
    (tmp_path / "model.json").write_text(json.dumps(content))
    assert main([str(tmp_path), "--shards", str(shards), "--output", str(tmp_path / "out")]) == 1
    assert "same --box" in capsys.readouterr().err
