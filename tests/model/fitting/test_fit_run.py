"""A fit as a whole: it beats starting from nothing, goes on exactly where it was, and refuses what cannot be."""

import os
import signal
from dataclasses import replace

import ball_heads
import cv2
import numpy as np
import pytest
import small_fits
import torch
from small_fits import config
from small_runs import assert_equal_bits, quiet, tensors, words_of_log

from preface.artifacts import ArtifactError, provenance, read_artifact
from preface.model.configuration import PRESETS
from preface.model.fitting import beginning as beginning_module
from preface.model.fitting import run as run_module
from preface.model.fitting.heads import head_of_prior
from preface.model.fitting.previews import Previewer
from preface.model.fitting.run import fit_head
from preface.model.training.configuration import TrainingConfigError
from preface.model.training.lock import only_run
from preface.model.training.logs import read_log
from preface.model.training.loop import TrainingError
from preface.model.training.prior_files import read_prior
from preface.model.training.trainer import Trainer
from preface.shards.building import build_manifest
from preface.shards.writer import ShardWriter

REFINED = {"refine_cameras": True}


@pytest.fixture(scope="module")
def straight(balls, prior, tmp_path_factory):
    """A fit without a break, that refines its cameras too."""
    folder = tmp_path_factory.mktemp("straight") / "head"
    ended = fit_head(config(balls, prior, folder, **REFINED), quiet)
    assert (ended.status, ended.path) == (0, folder / "model.json")
    return folder


def test_a_prior_helps_views_that_were_not_fitted_to(balls, prior, tmp_path):
    long = {"inversion": {"steps": 15, "rate": 5e-2}, "finetuning": {"steps": 25, "rays": 128}}
    fit_head(config(balls, prior, tmp_path / "with", **long), quiet)
    more = {"finetuning": {"steps": 40, "rays": 128}}
    fit_head(config(balls, "none", tmp_path / "without", **more), quiet)
    found = [small_fits.held_out_psnr(balls, tmp_path / name) for name in ("with", "without")]
    assert found[0] > found[1] + 3


def test_the_baseline_may_have_the_architecture_of_a_prior(balls, prior, straight, tmp_path):
    """Everything but the code and what was learned; --model is then of no account."""
    given = config(balls, "none", tmp_path / "a", model=PRESETS["small"], like=prior)
    assert fit_head(given, quiet).status == fit_head(given, quiet).status == 0
    head, like = read_prior(tmp_path / "a"), read_prior(prior)
    assert head.model == replace(like.model, latent=0, predicted_normals=True)
    assert (
        head.model.levels == read_prior(straight).model.levels
    )  # as many as a fit from that prior ends with
    assert head.fit["prior"] is None
    refused(replace(given, like=None), r"model\.")


def test_corrections_that_gain_too_little_leave_the_fit_as_if_none_had_been_sought(balls, prior, tmp_path):
    said = []
    ended = fit_head(
        config(balls, prior, tmp_path / "a", cameras={"least_gain": 99.0}, **REFINED), said.append
    )
    fit_head(config(balls, prior, tmp_path / "b"), quiet)
    refused_, never = (read_prior(tmp_path / name) for name in "ab")
    assert ended.status == 0
    assert any("stay as they were" in words for words in said)
    assert refused_.fit["refinement"]["kept"] is False
    assert refused_.fit["cameras"] == never.fit["cameras"] == {}
    weights = [head.load_model().state_dict() for head in (refused_, never)]
    assert_equal_bits(*weights)
    assert (refused_.step, never.step) == (28, 16)
    assert (
        fit_head(config(balls, prior, tmp_path / "a", cameras={"least_gain": 99.0}, **REFINED), quiet).status
        == 0
    )


def test_a_fit_without_finetuning_ends_in_order_when_corrections_are_refused(balls, prior, tmp_path):
    here = config(balls, prior, tmp_path / "a", None, {"steps": 0}, None, {"least_gain": 99.0}, **REFINED)
    assert fit_head(here, quiet).status == 0
    assert read_prior(tmp_path / "a").finished


def test_corrections_are_judged_where_no_inversion_follows_them(balls, prior, tmp_path):
    """The code stays where it starts, and nothing but the judgement comes after the cameras' steps."""
    inversion, finetuning = {"steps": 0, "start": "mean"}, {"steps": 0}
    cameras = {"least_gain": 99.0}
    fit_head(config(balls, prior, tmp_path / "a", inversion, finetuning, None, cameras, **REFINED), quiet)
    head = read_prior(tmp_path / "a")
    assert head.finished
    assert head.fit["refinement"]["kept"] is False
    assert head.fit["cameras"] == {}


def test_cameras_without_a_prior_have_nothing_to_agree_with(balls, tmp_path):
    with pytest.raises(TrainingConfigError, match=r"--refine-cameras.*fit from a prior"):
        fit_head(config(balls, "none", tmp_path / "a", **REFINED), quiet)


def test_the_page_of_logs_describes_every_value_of_every_line(straight):
    kinds, undescribed = words_of_log(straight / "log.jsonl")
    assert kinds == {"inversion", "cameras", "finetuning", "preview"}
    assert undescribed == set()


def test_a_head_says_what_it_is(balls, prior, straight):
    content = read_artifact(straight / "model.json", "preface/prior")
    head = read_prior(straight)
    assert head.is_head
    assert not read_prior(prior).is_head
    assert (head.identities, head.step, head.steps) == ((small_fits.UNSEEN,), 28, 28)
    assert head.fit["views"] == list(small_fits.VIEWS)
    assert head.fit["prior"] == provenance({}, {"p": prior / "model.json"})["inputs"]["p"]
    assert head.fit["inversion"]["steps"] == head.fit["finetuning"]["steps"] == 8
    logged = read_log(straight / "log.jsonl", "inversion")
    assert [entry["step"] for entry in logged] == [2, 4, 6, 8, 14, 16, 18, 20]
    assert [entry["step"] for entry in read_log(straight / "log.jsonl", "cameras")] == [10, 12]
    assert head.fit["inversion"]["loss"] < 2 * logged[-1]["loss"]
    assert [entry["step"] for entry in read_log(straight / "log.jsonl", "finetuning")] == [22, 24, 26, 28]
    assert head.held_out == {small_fits.UNSEEN: ("camera0", "camera2", "camera3", "camera5")}
    assert set(head.fit["cameras"]) == set(small_fits.VIEWS)
    assert head.model.predicted_normals
    assert len(head.load_model().codes) == 1
    assert content["configuration"]["inversion"]["steps"] == 8


def test_pictures_show_each_view_after_each_phase(straight):
    sheets = sorted((straight / "previews").iterdir())
    assert [sheet.name for sheet in sheets] == [f"views-{step:08d}.png" for step in (8, 12, 20, 28)]
    picture = cv2.imread(str(sheets[-1]))
    assert picture.shape[1] > 6 * ball_heads.WIDTH
    assert picture.std() > 10
    assert len(read_log(straight / "log.jsonl", "preview")[-1]["psnr"]) == len(small_fits.VIEWS)


PHASES = {"inversion": 0, "cameras": 8, "inversion again": 12, "finetuning": 20}


@pytest.mark.parametrize(
    ("phase", "local"),
    [("inversion", 4), ("inversion", 8), ("cameras", 2), ("inversion again", 4), ("finetuning", 4)],
)
def test_a_fit_that_is_interrupted_in_any_phase_goes_on_bit_for_bit(
    balls, prior, straight, tmp_path, phase, local
):
    here = config(balls, prior, tmp_path / "head", **REFINED)
    said = []
    stopped, kind = PHASES[phase] + local, phase.split()[0]

    def say(words):
        said.append(words)
        due = words.startswith(f"{kind}: step {local:>7,} of")
        if due and (phase != "inversion again" or any("kept" in earlier for earlier in said)):
            os.kill(os.getpid(), signal.SIGINT)

    ended = fit_head(here, say)
    assert ended.status == 130
    assert "the same command goes on" in said[-1]
    half = read_prior(tmp_path / "head")
    assert half.step == (9 if stopped == 8 else stopped)
    assert not half.finished
    assert fit_head(here, quiet).status == 0
    assert_equal_bits(tensors(tmp_path / "head"), tensors(straight))
    assert read_prior(tmp_path / "head").fit == read_prior(straight).fit
    for kind in ("inversion", "cameras", "finetuning"):
        ours, theirs = (
            [entry["step"] for entry in read_log(folder / "log.jsonl", kind)]
            for folder in (tmp_path / "head", straight)
        )
        assert ours == theirs


@pytest.mark.parametrize(
    ("begins_with", "phase"),
    [
        ("refinement_trainer", "cameras"),
        ("gain", "inversion again"),  # not judged yet
        ("start_code", "inversion again"),  # judged
        ("finetuning_trainer", "finetuning"),
    ],
)
def test_a_fit_that_is_killed_between_the_phases_goes_on_bit_for_bit(
    balls, prior, straight, tmp_path, monkeypatch, begins_with, phase
):
    here = config(balls, prior, tmp_path / "head", **REFINED)
    usual = getattr(run_module, begins_with)

    def killed(*arguments, **named):
        if begins_with == "finetuning_trainer":
            assert not any(one.requires_grad for one in named["correction"].cameras.parameters())
        if (tmp_path / "head" / "model.json").exists():  # not where the code starts for the first time
            raise KeyboardInterrupt
        return usual(*arguments, **named)

    with monkeypatch.context() as patched:
        patched.setattr(run_module, begins_with, killed)
        with pytest.raises(KeyboardInterrupt):
            fit_head(here, quiet)
    before = read_prior(tmp_path / "head")
    assert before.step == PHASES[phase]
    assert ("refinement" in before.fit) == (begins_with in ("start_code", "finetuning_trainer"))
    fit_head(here, quiet)
    assert_equal_bits(tensors(tmp_path / "head"), tensors(straight))


def test_a_finished_fit_is_left_alone(balls, prior, straight):
    before = (straight / "model.json").read_bytes()
    said = []
    assert fit_head(config(balls, prior, straight, **REFINED), said.append).status == 0
    assert "taken already" in said[-1]
    assert (straight / "model.json").read_bytes() == before


def test_no_steps_at_all_are_the_prior_with_the_code_it_starts_from(balls, prior, tmp_path):
    none = {"inversion": {"steps": 0, "start": "mean"}, "finetuning": {"steps": 0}}
    assert fit_head(config(balls, prior, tmp_path / "a", **none), quiet).status == 0
    head, networks = read_prior(tmp_path / "a"), read_prior(prior).load_model()
    expected = head_of_prior(networks, networks.codes.detach().mean(dim=0)).state_dict()
    assert head.finished
    for name, value in head.load_model().state_dict().items():
        assert torch.equal(value, expected[name]), name


def test_a_frozen_code_is_the_one_that_inversion_found(balls, prior, tmp_path):
    frozen = {"inversion": {"steps": 4}, "finetuning": {"steps": 3, "frozen_latent": True}}
    fit_head(config(balls, prior, tmp_path / "frozen", **frozen), quiet)
    only = {"inversion": {"steps": 4}, "finetuning": {"steps": 0}}
    fit_head(config(balls, prior, tmp_path / "only", **only), quiet)
    frozen_head, inverted = (read_prior(tmp_path / name).load_model() for name in ("frozen", "only"))
    assert torch.equal(frozen_head.codes, inverted.codes)
    assert not torch.equal(frozen_head.nerf.color.weight, inverted.nerf.color.weight)
    assert not inverted.config.predicted_normals


def test_finer_views_are_inverted_at_the_priors_resolution(balls, prior, tmp_path, monkeypatch):
    """By a prior that says that its images were half as large."""
    coarse = replace(read_prior(prior), scene=replace(read_prior(prior).scene, resolution=(12, 16)))
    monkeypatch.setattr(
        beginning_module, "read_prior", lambda path: coarse if path == prior else read_prior(path)
    )
    sizes = []
    trainer = run_module.inversion_trainer

    def noted(model, inversion, data, *rest):
        sizes.append(data.scene.resolution)
        return trainer(model, inversion, data, *rest)

    monkeypatch.setattr(run_module, "inversion_trainer", noted)
    steps = {"inversion": {"steps": 2, "patch": 8}, "finetuning": {"steps": 1}}
    fit_head(config(balls, prior, tmp_path / "a", **steps, **REFINED), quiet)
    assert sizes == 2 * [(12, 16)]
    assert read_prior(tmp_path / "a").scene.resolution == (ball_heads.WIDTH, ball_heads.HEIGHT)
    assert (tmp_path / "a" / "inversion_views" / "manifest.json").exists()
    cameras = read_prior(tmp_path / "a").fit["cameras"]
    assert all(np.any(cameras[view]["rotation"]) for view in small_fits.VIEWS)


# ------------------------------------------------------------------------------------------- bad input


def refused(here, words, kind=ArtifactError):
    with pytest.raises(kind, match=words):
        fit_head(here, quiet)


def test_a_folder_of_another_fit_or_of_a_prior_is_refused(balls, prior, straight):
    refused(
        config(balls, prior, straight, views=("camera0",), **REFINED), r"views is \['camera1', 'camera4'\]"
    )
    refused(config(balls, "none", straight), r"inputs\.prior is \w+ there and None now.*inversion")
    refused(config(balls, prior, straight, {"steps": 9}, **REFINED), r"inversion\.steps is 8 there and 9 now")
    refused(config(balls, prior, prior), "would overwrite.*another --output")


def test_a_head_is_no_prior(balls, straight, tmp_path):
    refused(config(balls, straight, tmp_path / "a"), "is that of a head")


def test_a_prior_that_is_not_finished_is_used_with_a_warning(balls, prior, tmp_path, monkeypatch):
    half = replace(read_prior(prior), step=3)
    monkeypatch.setattr(
        beginning_module, "read_prior", lambda path: half if path == prior else read_prior(path)
    )
    said = []
    steps = {"inversion": {"steps": 0}, "finetuning": {"steps": 0}}
    assert fit_head(config(balls, prior, tmp_path / "a", **steps), said.append).status == 0
    assert "3 of 100 steps only" in said[0]


def test_shards_of_another_box_are_refused_before_anything_is_written(prior, tmp_path):
    (tmp_path / "shards").mkdir()
    size = (ball_heads.WIDTH, ball_heads.HEIGHT)
    with ShardWriter(tmp_path / "shards", 0, size, "raster", "other") as shard:
        shard.add(replace(ball_heads.head(3), box=ball_heads.BOX * 1.2))
    build_manifest(tmp_path / "shards", 1, {"all": ["id0003"]}, {}, provenance({}, {}))
    refused(config(tmp_path / "shards", prior, tmp_path / "a"), "Build the shards with --box")
    assert not (tmp_path / "a").exists()


def test_flags_that_cannot_work_are_refused_before_anything_is_read(tmp_path):
    here = config(tmp_path / "nothing", tmp_path / "nothing", tmp_path / "a", finetuning={"rays": 0})
    refused(here, "--finetuning.rays 0", TrainingConfigError)


def test_an_output_that_cannot_be_written_is_refused(balls, prior, tmp_path):
    (tmp_path / "a").write_text("")
    refused(config(balls, prior, tmp_path / "a"), "writing")


def test_two_fits_into_one_folder_are_refused(balls, prior, tmp_path):
    with only_run(tmp_path):
        refused(config(balls, prior, tmp_path), "is training into this folder")


def test_what_is_not_finite_keeps_the_last_checkpoint(balls, prior, tmp_path, monkeypatch):
    step = Trainer.step

    def poisoned(self, number, batch):
        if number == 5 and len(self.sets) > 1:
            batch = replace(batch, rgba=batch.rgba * torch.nan)
        return step(self, number, batch)

    monkeypatch.setattr(Trainer, "step", poisoned)
    refused(
        config(balls, prior, tmp_path / "a"),
        r"finetuning: step 5: loss is not finite: l1.*lower --finetuning\.rate",
        TrainingError,
    )
    kept = read_prior(tmp_path / "a")
    assert kept.step == 8
    assert all(np.isfinite(p.detach().numpy()).all() for p in kept.load_model().parameters())


def test_memory_that_runs_out_says_what_to_lower(balls, prior, tmp_path, monkeypatch):
    def out_of_memory(self, number, batch):
        raise MemoryError

    monkeypatch.setattr(Trainer, "step", out_of_memory)
    refused(
        config(balls, prior, tmp_path / "a"),
        r"inversion: step 0: memory.*--inversion\.patches 1",
        TrainingError,
    )
    none = config(balls, "none", tmp_path / "b")
    refused(none, r"finetuning: step 0: memory.*--micro-rays 256", TrainingError)


@pytest.mark.parametrize("steps", [4, 0], ids=["of a phase", "without any step"])
def test_memory_that_runs_out_in_a_preview_says_what_to_lower(balls, prior, tmp_path, monkeypatch, steps):
    def out_of_memory(self):
        raise MemoryError

    few = {"inversion": {"steps": steps, "lpips": 0.0}, "finetuning": {"steps": steps}}
    with monkeypatch.context() as patched:
        patched.setattr(Previewer, "sheet", out_of_memory)
        refused(
            config(balls, prior, tmp_path / "a", **few), r"memory ran out.*--micro-rays 256", TrainingError
        )
    assert read_prior(tmp_path / "a").step == steps
    less = config(balls, prior, tmp_path / "a", run={"micro_rays": 256}, **few)
    assert fit_head(less, quiet).status == 0
    assert read_prior(tmp_path / "a").finished
