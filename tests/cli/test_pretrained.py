"""Commands with the prior that comes with preface; here, one of ball-shaped people that was never trained."""

import json
import sys
from pathlib import Path

import made_up_studio as made
import numpy as np
import pytest

from preface.align.alignment_files import read_template, write_template
from preface.artifacts import load_json
from preface.capture.images import write_png
from preface.cli import align, evaluate, fit, inspect, render
from preface.cli.fit_photos import StageError, expected_template, prepare
from preface.model import pretrained

for folder in ("training", "evaluation"):
    sys.path.insert(0, str(Path(__file__).parents[1] / "model" / folder))

SMALL = ["--device", "cpu", "--quality", "draft", "--inversion.lpips", "0", "--inversion.steps", "1"]
SMALL += ["--inversion.patches", "1", "--inversion.patch", "8", "--finetuning.steps", "1"]
SMALL += ["--finetuning.rays", "16", "--finetuning.normals", "0", "--products", "mkl"]


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    import ball_heads

    folder = tmp_path_factory.mktemp("balls")
    ball_heads.write_dataset(folder)
    return folder


def write_box(folder):
    from untrained import write_model

    write_model(folder, ["id0000", "id0001"], held_out={"id0001": ("camera4",)})
    write_template(folder / "template.json", expected_template())
    (folder / "MODEL_CARD.md").write_text("# a card\n")
    return folder


@pytest.fixture
def box(tmp_path, monkeypatch):
    """What lies in the package's folder."""
    folder = write_box(tmp_path / "package")
    monkeypatch.setattr(pretrained, "FOLDER", folder)
    return folder


def fit_words(shards, output, *more):
    words = [shards, "--identity", "id0003", "--views", "camera1", "camera4", "--output", output]
    return [str(word) for word in (*words, *more, *SMALL)]


def test_a_head_is_fitted_from_it_and_does_not_say_where_it_was_installed(
    box, shards, tmp_path, monkeypatch, capsys
):
    assert fit.main(fit_words(shards, tmp_path / "a")) == 0
    elsewhere = write_box(tmp_path / "another" / "place")
    monkeypatch.setattr(pretrained, "FOLDER", elsewhere)
    assert fit.main(fit_words(shards, tmp_path / "b", "--prior", "pretrained")) == 0
    texts = [(tmp_path / name / "model.json").read_text() for name in "ab"]
    assert texts[0] == texts[1]
    assert str(box) not in texts[0]
    assert load_json(tmp_path / "a" / "model.json")["fit"]["prior"]
    # Its architecture, and nothing that it knows.
    alone = fit_words(shards, tmp_path / "c", "--prior", "none", "--like", "pretrained")
    assert fit.main(alone) == 0
    found = load_json(tmp_path / "c" / "model.json")
    assert found["model"]["nerf"] == load_json(box / "model.json")["model"]["nerf"]
    assert found["fit"]["prior"] is None
    capsys.readouterr()


def test_people_who_were_placed_elsewhere_than_its_own_are_told_of(box, shards, tmp_path, capsys):
    moved = expected_template()
    shifted = moved.keypoints + np.outer([1, -1, 0, 0, 0], [0.01, 0, 0])  # their mean stays at the origin
    try:
        write_template(shards / "template.json", moved)
        assert fit.main(fit_words(shards, tmp_path / "same")) == 0
        assert "another template" not in capsys.readouterr().err
        write_template(shards / "template.json", type(moved)(**{**vars(moved), "keypoints": shifted}))
        assert fit.main(fit_words(shards, tmp_path / "moved")) == 0
        told = capsys.readouterr().err
        assert "another template than the prior's, 6.3 mm away" in told
        assert "preface-align studio CAPTURE --rig RIG --template pretrained" in told
    finally:
        (shards / "template.json").unlink()


def test_it_is_inspected_rendered_and_evaluated(box, shards, tmp_path, capsys):
    assert inspect.main(["pretrained"]) == 0
    assert "id0000, id0001" in capsys.readouterr().out
    who, out = ["pretrained", "--identity", "id0001"], tmp_path / "out"
    assert render.main([*who, "--size", "8x8", "--no-exr", "--output", str(out / "renders")]) == 0
    text = (out / "renders" / "rig.json").read_text()
    assert json.loads(text)["provenance"]["config"]["model"] == "pretrained"
    assert str(box) not in text
    words = [*who, "--shards", str(shards), "--lpips", "none", "--output", str(out / "evaluation")]
    assert evaluate.main(words) == 0
    text = (out / "evaluation" / box.name / "metrics.json").read_text()
    assert json.loads(text)["provenance"]["config"]["heads"] == ["pretrained"]
    assert str(box) not in text
    capsys.readouterr()


@pytest.mark.parametrize("command", ["studio", "photos"])
def test_people_are_placed_on_its_template(box, command, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(
        f"preface.cli.align_{command}.run", lambda config: asked.append(config.template) or []
    )
    words = [command, "somewhere", "--output", "out", *(["--rig", "rig"] if command == "studio" else [])]
    assert align.main([*words, "--template", "pretrained"]) == 0
    assert align.main([*words, "--template", "./pretrained"]) == 0
    assert align.main(words) == 0
    assert asked == [box, Path("pretrained"), None]
    assert read_template(asked[0]).scheme == "facemesh478"
    capsys.readouterr()


def test_photographs_are_placed_on_a_copy_of_its_template(box, tmp_path, monkeypatch):
    (tmp_path / "me").mkdir()
    write_png(tmp_path / "me" / "a.png", np.zeros((*made.SIZE[::-1], 3), np.uint8))
    seen = []
    monkeypatch.setattr("preface.cli.align.main", lambda words: seen.append(words) or 1)  # and stop there
    with pytest.raises(StageError):
        prepare(fit.parse([str(tmp_path / "me"), "--output", str(tmp_path / "head")]), lambda _: None)
    (words,) = seen
    used = Path(words[words.index("--template") + 1])
    assert used == tmp_path / "head" / "photos" / "template.json"
    assert used.read_bytes() == (box / "template.json").read_bytes()


def test_where_it_is_missing_every_command_says_so(box, shards, tmp_path, capsys):
    for file in box.iterdir():
        file.unlink()
    out = ["--output", str(tmp_path / "out")]
    assert fit.main(fit_words(shards, tmp_path / "head")) == 1
    assert inspect.main(["pretrained"]) == 1
    assert render.main(["pretrained", *out]) == 1
    assert evaluate.main(["pretrained", "--shards", str(shards), *out]) == 1
    assert align.main(["studio", "somewhere", "--rig", "rig", "--template", "pretrained", *out]) == 1
    assert capsys.readouterr().err.count("this preface was installed without it") == 5
    assert not (tmp_path / "head").exists()
