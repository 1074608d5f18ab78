"""A prior's run: it learns, it goes on exactly where it was, it refuses what cannot be, and says why."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import ball_heads
import cv2
import numpy as np
import pytest
import safetensors.torch
import small_runs
import torch
from small_runs import assert_equal_bits, config, quiet, tensors, words_of_log

from preface.artifacts import ArtifactError
from preface.model.rays import Rays
from preface.model.training import prior as prior_module
from preface.model.training.configuration import TrainingConfigError
from preface.model.training.data import WholeViews
from preface.model.training.lock import only_run
from preface.model.training.logs import read_log
from preface.model.training.prior import TrainingError, train_prior
from preface.model.training.prior_files import read_prior
from preface.model.training.trainer import Trainer
from preface.shards import Dataset, Loader


def psnr(folder):
    return read_prior(folder).validation["psnr"]


def test_training_brings_unseen_views_closer(balls, tmp_path):
    training = {"steps": 60, "views": 3, "rays": 32}
    run = {"validate_every": 10, "micro_rays": 512}
    ended = train_prior(config(balls, tmp_path / "a", training, run), quiet)
    assert (ended.status, ended.path) == (0, tmp_path / "a" / "model.json")
    curve = [entry["psnr"] for entry in read_log(tmp_path / "a" / "log.jsonl", "validation")]
    assert len(curve) == 6
    assert curve[-1] > curve[0] + 3
    assert psnr(tmp_path / "a") == curve[-1] > 16
    losses = [entry["loss"] for entry in read_log(tmp_path / "a" / "log.jsonl", "train")]
    assert losses[-1] < 0.5 * losses[0]


def test_opacity_follows_masks_where_it_is_asked_for(balls, tmp_path):
    """The heads' hair is black on black as far as colours can tell."""
    training = {"steps": 60, "views": 3, "rays": 32, "holdout_views": 0}
    found = {}
    for weight in (0.0, 0.5):
        train_prior(config(balls, tmp_path / str(weight), {**training, "opacity": weight}), quiet)
        model = read_prior(tmp_path / str(weight)).load_model()
        with Dataset(balls) as dataset, torch.no_grad():
            loader = Loader(
                dataset, WholeViews(dataset.index(), np.array([[0, 2]])), scale=dataset.manifest.scene_scale
            )
            batch = loader.batch(0)
            seen = model(Rays.from_batch(batch), model.codes[:1])
        found[weight] = float((seen.acc - (batch.alpha * batch.hit)[:, 0]).abs().mean())
    assert found[0.5] < 0.8 * found[0.0]


def test_the_template_of_the_shards_goes_with_the_prior(balls, tmp_path):
    shards = shutil.copytree(balls, tmp_path / "shards")
    (shards / "template.json").write_text('{"schema": "preface/template"}')
    train_prior(config(shards, tmp_path / "a", {"steps": 1, "holdout_views": 0}), quiet)
    assert (tmp_path / "a" / "template.json").read_bytes() == (shards / "template.json").read_bytes()


@pytest.fixture(scope="module")
def straight(balls, tmp_path_factory):
    """20 steps without a break."""
    folder = tmp_path_factory.mktemp("straight") / "prior"
    train_prior(config(balls, folder), quiet)
    return folder


def interrupt_at(step, number):
    """Says nothing, and sends this process a signal when a line about a step comes by."""

    def say(words):
        if words.startswith(f"step {step:>7,} of"):
            os.kill(os.getpid(), number)

    return say


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_interrupted_goes_on_bit_for_bit(balls, straight, tmp_path, number, status):
    here = config(balls, tmp_path / "prior")
    said = []
    say = interrupt_at(10, number)
    ended = train_prior(here, lambda words: (said.append(words), say(words)))
    assert ended.status == status
    assert "the same command goes on" in said[-1]
    half = read_prior(tmp_path / "prior")
    assert (half.step, half.steps, half.finished) == (10, 20, False)
    assert train_prior(here, quiet).status == 0
    assert_equal_bits(tensors(tmp_path / "prior"), tensors(straight))
    ours, theirs = (read_log(folder / "log.jsonl", "train") for folder in (tmp_path / "prior", straight))
    assert [e["loss"] for e in ours] == [e["loss"] for e in theirs]
    assert psnr(tmp_path / "prior") == psnr(straight)


def test_a_killed_run_goes_on_from_its_last_checkpoint_bit_for_bit(balls, straight, tmp_path, monkeypatch):
    here = config(balls, tmp_path / "prior", run={"validate_every": 5})
    step = Trainer.step

    class Killed(BaseException):
        pass

    def killed(self, number, batch):
        if number == 13:
            raise Killed
        return step(self, number, batch)

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "step", killed)
        with pytest.raises(Killed):
            train_prior(here, quiet)
    assert read_prior(tmp_path / "prior").step == 10
    train_prior(here, quiet)
    assert_equal_bits(tensors(tmp_path / "prior"), tensors(straight))


def test_a_finished_run_is_left_alone(balls, straight):
    before = (straight / "model.json").read_bytes()
    said = []
    assert train_prior(config(balls, straight), said.append).status == 0
    assert "taken already" in said[-1]
    assert (straight / "model.json").read_bytes() == before


def test_a_run_that_is_stopped_while_it_is_looked_at_has_nothing_to_train_again(
    balls, straight, tmp_path, monkeypatch
):
    here = config(balls, tmp_path / "prior")

    def stopped(self, log, step, last):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(prior_module._Run, "_validate", stopped)
        with pytest.raises(KeyboardInterrupt):
            train_prior(here, quiet)
    assert read_prior(tmp_path / "prior").finished
    assert train_prior(here, quiet).status == 0
    assert psnr(tmp_path / "prior") == psnr(straight)
    assert_equal_bits(tensors(tmp_path / "prior"), tensors(straight))


def test_the_page_of_logs_describes_every_value_of_every_line(straight):
    kinds, undescribed = words_of_log(straight / "log.jsonl")
    assert kinds == {"train", "validation"}
    assert undescribed == set()


def test_the_checkpoint_describes_what_was_trained(balls, straight):
    prior = read_prior(straight)
    manifest = json.loads((balls / "manifest.json").read_text())
    assert prior.identities == ("id0000", "id0001", "id0002")
    assert prior.scene.scene_scale == manifest["scene_scale"]
    np.testing.assert_array_equal(prior.scene.box, manifest["box"])
    assert prior.scene.resolution == (ball_heads.WIDTH, ball_heads.HEIGHT)
    assert {len(views) for views in prior.held_out.values()} == {1}
    assert list(prior.provenance["inputs"]) == ["manifest.json"]
    assert prior.model == small_runs.MODEL
    model = prior.load_model()
    stored = safetensors.torch.load_file(straight / "model.safetensors")
    for name, value in model.state_dict().items():
        assert torch.equal(value, stored[name])


def test_pictures_show_views_beside_the_truth_and_faces_between_faces(straight):
    views = cv2.imread(str(straight / "validation" / "views-00000020.png"))
    between = cv2.imread(str(straight / "validation" / "interpolation.png"))
    assert views.shape[0] > 3 * ball_heads.HEIGHT
    assert views.shape[1] > 4 * ball_heads.WIDTH
    assert between.shape[1] > 7 * ball_heads.WIDTH
    assert views.std() > 10


def test_the_size_of_parts_and_bfloat16_change_little(balls, straight, tmp_path):
    train_prior(config(balls, tmp_path / "parts", run={"micro_rays": 16}), quiet)
    train_prior(config(balls, tmp_path / "half", matmul="bf16"), quiet)
    train_prior(config(balls, tmp_path / "seed", {"seed": 1}), quiet)
    first = [read_log(folder / "log.jsonl", "train")[0]["loss"] for folder in (straight, tmp_path / "parts")]
    assert first[1] == pytest.approx(first[0], rel=1e-4)
    assert psnr(tmp_path / "half") == pytest.approx(psnr(straight), abs=0.5)
    assert psnr(tmp_path / "seed") != psnr(straight)


def test_a_model_with_its_own_background_sees_the_photographs_as_they_are(balls, tmp_path):
    training = {"steps": 40, "views": 3, "rays": 32}
    run = {"micro_rays": 512}
    here = config(balls, tmp_path / "a", training, run, background="modelled", clip_to_box=False)
    train_prior(here, quiet)
    assert psnr(tmp_path / "a") > 14


# --------------------------------------------------------------------------------------- two processes


def free_port():
    import socket

    with socket.socket() as some:
        some.bind(("127.0.0.1", 0))
        return some.getsockname()[1]


def test_two_processes_take_the_steps_of_one(balls, straight, tmp_path):
    arguments = [
        "--preset",
        "tiny",
        "--device",
        "cpu",
        "--products",
        "mkl",
        "--log-every",
        "5",
        "--validate-every",
        "1000000",
    ]
    arguments += ["--micro-rays", "64", "--steps", "20", "--identities", "3", "--views", "2", "--rays", "16"]
    arguments += ["--rate", "0.01", "--rate-last", "0.001", "--clip", "0", "--opacity", "0"]
    arguments += ["--validate-views", "1"]
    for name, value in small_runs.MODEL.to_dict().items():
        values = value if isinstance(value, dict) else {"": value}
        for part, number in values.items():
            flag = f"--model.{name}{'.' if part else ''}{part}".replace("_", "-")
            if isinstance(number, bool):
                arguments.append(flag if number else f"--model.no-{name.replace('_', '-')}")
                continue
            arguments += [flag, *map(str, number if isinstance(number, list) else [number])]
    command = [sys.executable, "-m", "preface.cli.train", str(balls), "--output", str(tmp_path / "two")]
    shared = {**os.environ, "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    shared["OMP_NUM_THREADS"] = "1"
    both = [
        subprocess.Popen(
            [*command, *arguments],
            env={**shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in (0, 1)
    ]
    errors = [process.communicate()[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    one, two = (read_log(folder / "log.jsonl", "train") for folder in (straight, tmp_path / "two"))
    assert len(two) == 4
    for ours, theirs in zip(two, one, strict=True):
        assert ours["loss"] == pytest.approx(theirs["loss"], rel=1e-4)
    assert psnr(tmp_path / "two") == pytest.approx(psnr(straight), abs=0.01)
    assert "step" not in errors[1]


# ------------------------------------------------------------------------------------------ bad input


def test_a_second_run_into_one_folder_is_refused(balls, tmp_path):
    with only_run(tmp_path), pytest.raises(ArtifactError, match=rf"process {os.getpid()} is training"):
        train_prior(config(balls, tmp_path), quiet)


def test_another_configuration_is_refused_with_the_fields_that_differ(balls, straight, tmp_path):
    other = config(balls, straight, {"steps": 30, "rate": 0.5}, latent=9)
    with pytest.raises(ArtifactError) as caught:
        train_prior(other, quiet)
    words = str(caught.value)
    for field in (
        "training.steps is 20 there and 30 now",
        "training.rate",
        "model.latent is 8 there and 9 now",
    ):
        assert field in words
    assert "another --output" in words


def test_other_shards_are_refused(straight, tmp_path):
    ball_heads.write_dataset(tmp_path, heads=3)
    with pytest.raises(ArtifactError, match="shards is"):
        train_prior(config(tmp_path, straight), quiet)


def test_heads_without_foreground_are_named(tmp_path):
    (tmp_path / "shards").mkdir()
    ball_heads.write_dataset(tmp_path / "shards", 3, without_foreground=(1,))
    with pytest.raises(ArtifactError, match=r"no foreground in any view of id0001: .*--model.background"):
        train_prior(config(tmp_path / "shards", tmp_path / "a"), quiet)


def test_an_unknown_split_names_those_that_there_are(balls, tmp_path):
    with pytest.raises(ArtifactError, match=r"no split 'all', only train, holdout"):
        train_prior(config(balls, tmp_path / "a", {"split": "all"}), quiet)


def test_shards_of_another_schema_are_refused(balls, tmp_path):
    content = json.loads((balls / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**content, "schema_version": 99}))
    with pytest.raises(ArtifactError, match="Upgrade preface"):
        train_prior(config(tmp_path, tmp_path / "a"), quiet)


def test_an_output_that_is_a_file_is_refused(balls, tmp_path):
    (tmp_path / "a").write_text("")
    with pytest.raises(ArtifactError, match="writing"):
        train_prior(config(balls, tmp_path / "a"), quiet)


@pytest.mark.parametrize(
    ("field", "words"), [("rgba", "loss is not finite: l1"), ("directions", "edges must ascend, but nan")]
)
def test_what_is_not_finite_keeps_the_last_good_checkpoint(balls, tmp_path, monkeypatch, field, words):
    step = Trainer.step

    def poisoned(self, number, batch):
        if number == 12:
            batch = replace(batch, **{field: getattr(batch, field) * torch.nan})
        return step(self, number, batch)

    monkeypatch.setattr(Trainer, "step", poisoned)
    with pytest.raises(TrainingError, match=rf"step 12: .*{words}.*checkpoint in .*lower --rate"):
        train_prior(config(balls, tmp_path / "a", run={"validate_every": 10}), quiet)
    kept = read_prior(tmp_path / "a")
    assert kept.step == 10
    assert all(torch.isfinite(p).all() for p in kept.load_model().parameters())


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        torch.OutOfMemoryError("CUDA out of memory"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory"),
    ],
)
def test_memory_that_runs_out_says_what_to_lower(balls, tmp_path, monkeypatch, error):
    def out_of_memory(self, number, batch):
        raise error

    monkeypatch.setattr(Trainer, "step", out_of_memory)
    with pytest.raises(TrainingError, match="--micro-rays 32"):
        train_prior(config(balls, tmp_path / "a"), quiet)


@pytest.mark.parametrize(
    ("training", "run", "model", "words"),
    [
        ({"steps": 0}, {}, {}, "--steps 0"),
        ({"rate": float("nan")}, {}, {}, "--rate nan"),
        ({"rate_last": 0.0}, {}, {}, "--rate-last 0.0"),
        ({"holdout_views": -1}, {}, {}, "--holdout-views -1"),
        ({}, {"micro_rays": 0}, {}, "--micro-rays 0"),
        ({}, {}, {"background": "captured"}, "no pictures of the empty studio"),
        ({"opacity": 0.1}, {}, {"background": "modelled"}, "--opacity 0.1: .*masks say nothing"),
        ({"opacity": -0.1}, {}, {}, "--opacity -0.1"),
        ({}, {}, {"latent": 0}, "a prior needs codes"),
    ],
)
def test_values_that_cannot_work_are_refused(balls, tmp_path, training, run, model, words):
    with pytest.raises(TrainingConfigError, match=words):
        train_prior(config(balls, tmp_path / "a", training, run, **model), quiet)
    assert not (tmp_path / "a").exists()


def test_cuda_that_is_not_there_is_refused(balls, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(TrainingConfigError, match="--device cpu"):
        train_prior(config(balls, tmp_path / "a", run={"device": "cuda"}), quiet)


def test_a_dry_run_writes_nothing(balls, tmp_path):
    said = []
    train_prior(config(balls, tmp_path / "a", run={"dry_run": True}), said.append)
    assert not (tmp_path / "a").exists()
    assert "3 identities of split 'train', 15 views of 24x32 to train on, 3 held out" in said[0]
