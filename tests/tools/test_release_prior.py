"""``tools/release_prior.py``: what a release holds, what it leaves out, and everything that it refuses."""

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "model" / "training"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "model" / "evaluation"))

import ball_heads
from untrained import fitted_to, write_model

import release_prior
from preface.align.alignment_files import read_template, write_template
from preface.artifacts import load_json, provenance, sha256, write_artifact
from preface.cli.fit_photos import expected_template
from preface.model import pretrained
from preface.model.training.checkpoint import STATE, WEIGHTS, write_checkpoint
from preface.model.training.prior_files import prior_payload, read_prior

ROOT = Path(__file__).resolve().parents[2]
FIT = f"fit\t90\tpreface-fit shards --prior {pretrained.PRETRAINED}\n"
STAGES = (
    "studio\t600\tpython tools/synthetic_studio --output studio\nprior\t5.5\tpreface-train shards\n" + FIT
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Shards, a prior of two of their people as a run leaves it, and figures of two others."""
    folder = tmp_path_factory.mktemp("made")
    shards = folder / "shards"
    shards.mkdir()
    ball_heads.write_dataset(shards)
    prior = write_model(folder / "prior", ["id0000", "id0001"], held_out={"id0001": ("camera4",)})
    describe(prior, shards)
    template = expected_template()
    config = {
        "template": "/home/somebody/old alignment/template.json",
        "detection": ["C:\\models\\face.task"],
    }
    write_template(
        prior / "template.json", type(template)(**{**vars(template), "provenance": provenance(config, {})})
    )
    for who, psnr in (("id0002", 20.0), ("id0003", 24.0)):
        metrics(folder / f"{who}-with", who, psnr, sha256(prior / "model.json"), shards)
        metrics(folder / f"{who}-without", who, psnr - 5, None, shards)
    (folder / "stages.tsv").write_text(STAGES)
    return folder


def describe(prior, shards, **changes):
    """Write model.json anew as a run on these shards does, with what it needs to go on."""
    known = read_prior(prior)
    tensors = {WEIGHTS: known.load_model().state_dict(), STATE: {"step/x": torch.zeros(3)}}
    made = provenance({"shards": "/data/of/somebody/shards"}, {"manifest.json": shards / "manifest.json"}, 7)
    payload = prior_payload(known) | {
        "provenance": made,
        "configuration": {"preset": "tiny", "model": known.model.to_dict()},
        **changes,
    }
    write_checkpoint(prior, payload, tensors)


def metrics(folder, identity, psnr, prior, shards, fitted=False):
    folder.mkdir()
    content = load_json(ROOT / "data_specs" / "metrics.example.json")
    manifest = sha256(shards / "manifest.json")
    fit = {**fitted_to(["camera1", "camera4"], identity), "prior": prior}
    fit["shards"] = {"manifest": manifest, "path": "shards"}
    view = {"name": "camera0", "fitted": fitted, "degrees_from_fitted": 9.0, "psnr": psnr, "ssim": 0.5}
    view |= {"face": None, "left_out": {}}
    mean = {"psnr": psnr, "ssim": 0.5}
    changed = {"identity": identity, "kind": "head", "fit": fit, "views": [view], "mean": mean}
    write_artifact(folder / "metrics.json", content | changed)


def run(made, output, *more, people=("id0002", "id0003")):
    words = [made / "prior", "--shards", made / "shards", "--stages", made / "stages.tsv", "--output", output]
    words += ["--metrics", *(made / f"{who}-with" for who in people)]
    words += ["--baseline", *(made / f"{who}-without" for who in people)]
    return release_prior.main([str(word) for word in (*words, *more)])


def test_a_release_is_the_prior_without_what_only_training_needs(made, tmp_path, capsys, monkeypatch):
    assert run(made, tmp_path / "box") == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "box" / "MODEL_CARD.md")
    assert {file.name for file in (tmp_path / "box").iterdir()} == set(pretrained.FILES)
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "box")
    released, trained = read_prior("pretrained"), read_prior(made / "prior")
    assert set(released.files) == {"weights"}
    assert released.identities == trained.identities
    ours, theirs = released.load_model().state_dict(), trained.load_model().state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    (before, after) = (
        read_template(folder / "template.json") for folder in (made / "prior", tmp_path / "box")
    )
    assert (before.keypoints == after.keypoints).all()


def test_nothing_says_where_things_lay(made, tmp_path, capsys):
    assert run(made, tmp_path / "box") == 0
    capsys.readouterr()
    for name in ("model.json", "template.json", "MODEL_CARD.md"):
        text = (tmp_path / "box" / name).read_text()
        for place in ("/home", "/data", "C:", "somebody", str(tmp_path), str(made)):
            assert place not in text, (name, place)
    assert load_json(tmp_path / "box" / "model.json")["provenance"]["config"] == {"shards": "shards"}


def test_the_card_tells_data_commands_figures_limits_and_digests(made, tmp_path, capsys):
    assert run(made, tmp_path / "box", "--machine", "an abacus") == 0
    capsys.readouterr()
    card = (tmp_path / "box" / "MODEL_CARD.md").read_text()
    for part in (
        "anny",
        "Apache-2.0",
        "CC0",
        "must not be used for",
        "surveillance",
        "Impersonation",
        "ethnicity",
    ):
        assert part in card
    assert "on an abacus" in card
    assert "| studio | 10 min | `python tools/synthetic_studio --output studio` |" in card
    assert "| 2 views | draft | this prior | 2 | 2 | 22.00 | 0.5000 |" in card
    assert "| 2 views | draft | nothing | 2 | 2 | 17.00 | 0.5000 |" in card
    assert "seed 7" in card
    for name in ("model.json", "model.safetensors", "template.json"):
        assert sha256(tmp_path / "box" / name) in card


def test_a_prior_may_be_released_again_with_figures_of_heads_fitted_from_the_release(made, tmp_path, capsys):
    assert run(made, tmp_path / "box") == 0
    metrics(tmp_path / "new", "id0003", 30.0, sha256(tmp_path / "box" / "model.json"), made / "shards")
    before = (tmp_path / "box" / "model.json").read_bytes()
    assert run(made, tmp_path / "box", "--metrics", str(tmp_path / "new")) == 0
    assert (tmp_path / "box" / "model.json").read_bytes() == before
    assert "| 1 | 1 | 30.00 |" in (tmp_path / "box" / "MODEL_CARD.md").read_text()
    capsys.readouterr()


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        ("", "is empty"),
        ("studio\t1\tsynthetic_studio --assets mine\n", "may not be passed on"),
        ("studio\t1\tsynthetic_studio --assets=mine\n", "may not be passed on"),
        ("prior\t1\tpreface-train /home/me/shards\n", "'/home/me/shards' says where things lay"),
        ("prior\t1\tpreface-train --output=/home/me\n", "says where things lay"),
        ("prior\t1\tpreface-train 'shards\n", "is no command"),
    ],
)
def test_commands_that_may_not_be_told_are_refused(made, tmp_path, capsys, stages, words):
    (tmp_path / "stages.tsv").write_text(stages)
    assert run(made, tmp_path / "box", "--stages", str(tmp_path / "stages.tsv")) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "box").exists()


def test_figures_of_others_are_refused(made, tmp_path, capsys):
    ours, shards = sha256(made / "prior" / "model.json"), made / "shards"
    metrics(tmp_path / "other", "id0002", 20.0, "0" * 64, shards)
    metrics(tmp_path / "known", "id0001", 20.0, ours, shards)
    metrics(tmp_path / "seen", "id0002", 20.0, ours, shards, fitted=True)
    cases = {
        ("--metrics", "other"): "was fitted from another prior",
        ("--metrics", "known"): "is one of the prior's own people",
        ("--metrics", "seen"): "some were fitted to 'id0002'",
        ("--baseline", "other"): "was fitted from a prior",
    }
    for (flag, name), words in cases.items():
        assert run(made, tmp_path / "box", flag, str(tmp_path / name)) == 1
        assert words in capsys.readouterr().err
    assert not (tmp_path / "box").exists()


def test_a_prior_that_cannot_be_released_is_refused(made, tmp_path, capsys, monkeypatch):
    (tmp_path / "shards").mkdir()
    ball_heads.write_dataset(tmp_path / "shards", heads=2)
    assert run(made, tmp_path / "box", "--shards", str(tmp_path / "shards")) == 1
    assert "Give the shards that it was trained on" in capsys.readouterr().err
    monkeypatch.setattr(release_prior, "MAX_BYTES", 1000)
    assert run(made, tmp_path / "box") == 1
    assert "a release has at most 1,000" in capsys.readouterr().err
    half = write_model(tmp_path / "prior", ["id0000", "id0001"])
    payload = json.loads((half / "model.json").read_text())
    write_artifact(half / "model.json", payload | {"step": 1, "steps": 2})
    words = [str(half), "--shards", str(made / "shards"), "--stages", str(made / "stages.tsv")]
    assert release_prior.main([*words, "--metrics", str(made / "id0002-with")]) == 1
    assert "has 1 of 2 steps" in capsys.readouterr().err
    assert not (tmp_path / "box").exists()
