"""Checkpoints are one generation: whatever fails while one is written, a whole one can be read."""

import json
from pathlib import Path

import pytest
import small_runs
import torch

from preface import artifacts
from preface.artifacts import ArtifactError
from preface.model.training import checkpoint
from preface.model.training.checkpoint import STATE, WEIGHTS, read_tensors, write_checkpoint
from preface.model.training.prior_files import prior_payload, read_prior


@pytest.fixture(scope="module")
def payload():
    """Of the worked example."""
    return prior_payload(read_prior(artifacts.SCHEMA_DIRECTORY / "prior.example.json"))


def generation(number):
    return {WEIGHTS: {"w": torch.full((3, 2), float(number))}, STATE: {"m": torch.full((4,), float(number))}}


def write(folder, payload, number):
    return write_checkpoint(folder, {**payload, "step": number}, generation(number))


def numbers(folder):
    """The generation that each of the three files is of, as a reader sees them."""
    path = folder / "model.json"
    content = artifacts.read_artifact(path, "preface/prior")
    weights, state = (read_tensors(path, content, role) for role in (WEIGHTS, STATE))
    return {content["step"], int(weights["w"][0, 0]), int(state["m"][0])}


def test_round_trip_is_exact(tmp_path, payload):
    odd = torch.tensor([1e-45, -0.0, 3.4e38, 1 / 3])
    path = write_checkpoint(tmp_path, payload, {WEIGHTS: {"w": odd, "t": torch.arange(6).view(2, 3).T}})
    found = read_tensors(path, json.loads(path.read_text()), WEIGHTS)
    assert found["w"].view(torch.int32).tolist() == odd.view(torch.int32).tolist()
    assert found["t"].tolist() == [[0, 3], [1, 4], [2, 5]]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.json", "model.safetensors"]


class Crash(BaseException):
    """Stands for a process that was killed."""


def crash_after(monkeypatch, count):
    """Let `count` renames happen, and kill the process in place of the next."""
    happened = []
    replace = Path.replace

    def counted(self, target):
        if len(happened) == count:
            raise Crash
        happened.append(target)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", counted)
    return happened


@pytest.mark.parametrize("renames", range(6))
def test_a_crash_at_any_rename_leaves_the_old_generation_or_the_new_one(
    tmp_path, payload, monkeypatch, renames
):
    write(tmp_path, payload, 1)
    with monkeypatch.context() as patched:
        happened = crash_after(patched, renames)
        try:
            write(tmp_path, payload, 2)
        except Crash:
            assert len(happened) == renames
    found = numbers(tmp_path)
    assert found in ({1}, {2})
    # The next run, which may crash early too, keeps it readable, and ends with its own.
    with monkeypatch.context() as patched:
        crash_after(patched, 1)
        with pytest.raises(Crash):
            write(tmp_path, payload, 3)
    assert numbers(tmp_path) == found
    write(tmp_path, payload, 4)
    assert numbers(tmp_path) == {4}
    assert not list(tmp_path.glob("*.next"))


def test_weights_that_were_changed_are_refused(tmp_path, payload):
    path = write(tmp_path, payload, 1)
    file = tmp_path / "model.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    with pytest.raises(ArtifactError, match=r"model.safetensors: sha256: .*Restore"):
        read_tensors(path, json.loads(path.read_text()), WEIGHTS)


def test_weights_of_another_generation_are_refused(tmp_path, payload):
    path = write(tmp_path, payload, 1)
    old = (tmp_path / "model.safetensors").read_bytes()
    write(tmp_path, payload, 2)
    (tmp_path / "model.safetensors").write_bytes(old)
    with pytest.raises(ArtifactError, match="sha256"):
        read_tensors(path, json.loads(path.read_text()), WEIGHTS)


def test_a_copy_without_training_state_can_be_used_but_not_trained_on(tmp_path, payload):
    path = write_checkpoint(tmp_path, payload, {WEIGHTS: generation(1)[WEIGHTS]})
    content = json.loads(path.read_text())
    assert read_tensors(path, content, WEIGHTS)
    with pytest.raises(ArtifactError, match="can be used but not trained on"):
        read_tensors(path, content, STATE)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({}, "w: is missing"),
        ({"w": torch.zeros(2, 3)}, r"float32 \[2, 3\], and the model has float32 \[3, 2\]"),
        ({"w": torch.zeros(3, 2).half()}, "float16"),
        ({"w": torch.zeros(3, 2), "v": torch.zeros(1)}, "v: is not a tensor of this model"),
        ({"w": torch.full((3, 2), float("nan"))}, "not finite"),
    ],
)
def test_tensors_of_another_architecture_are_refused(found, words):
    with pytest.raises(ArtifactError, match=words):
        checkpoint.require_same_tensors(Path("model.safetensors"), found, {"w": torch.zeros(3, 2)})


def changed(tmp_path, payload, **fields):
    files = {"weights": {"file": "model.safetensors", "bytes": 1, "sha256": "0" * 64}}
    path = tmp_path / "model.json"
    path.write_text(json.dumps({**payload, "files": files, **fields}))
    return path


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"schema": "preface/rig"}, "schema"),
        ({"schema_version": 2}, "Upgrade"),
        ({"architecture": "triplane"}, "architecture: is 'triplane'"),
        (
            {
                "model": {
                    "levels": 3,
                    "latent": 8,
                    "proposal": {"depth": 1, "width": 2},
                    "samples": [4],
                    "nerf": {},
                }
            },
            "nerf",
        ),
        ({"identities": ["a", "a"]}, "identities"),
        ({"step": -1}, "step"),
        ({"scene_scale": 0}, "scene_scale"),
        ({"box": [[0, 0, 0], [1, -1, 1]]}, "box: has no volume"),
        ({"optimizer": "adam"}, "optimizer"),
        ({"files": {}}, "weights"),
    ],
)
def test_descriptions_that_cannot_be_are_refused(tmp_path, payload, fields, words):
    with pytest.raises(ArtifactError, match=words):
        read_prior(changed(tmp_path, payload, **fields))


def test_an_unknown_key_of_the_model_is_named(tmp_path, payload):
    model = {**payload["model"], "nerv": 1}
    with pytest.raises(ArtifactError, match=r"model.nerv: .*did you mean nerf"):
        read_prior(changed(tmp_path, payload, model=model))


def test_a_folder_that_refuses_names_what_to_do(tmp_path, payload):
    (tmp_path / "model.safetensors.next").mkdir()
    with pytest.raises(ArtifactError, match=r"model\.safetensors\.next"):
        write(tmp_path, payload, 1)


def test_configuration_survives_the_round_trip(tmp_path, payload):
    model = {**small_runs.MODEL.to_dict()}
    assert read_prior(changed(tmp_path, payload, model=model)).model == small_runs.MODEL
