"""A prior's run on a machine with too little memory to look at it, or with too many processes."""

import contextlib

import pytest
import torch
from small_runs import config, quiet

from preface.model.training import prior as prior_module
from preface.model.training.configuration import TrainingConfigError
from preface.model.training.prior import TrainingError, train_prior
from preface.model.training.prior_files import read_prior
from preface.model.training.ranks import Ranks
from preface.model.training.validation import Viewer


def test_memory_that_runs_out_in_a_validation_says_what_to_lower_and_what_is_kept(
    balls, tmp_path, monkeypatch
):
    here = config(balls, tmp_path / "a")

    def out_of_memory(self, pairs):
        raise torch.OutOfMemoryError("CUDA out of memory")

    with monkeypatch.context() as patched:
        patched.setattr(Viewer, "render", out_of_memory)
        with pytest.raises(TrainingError, match=r"memory ran out; the checkpoint in .*--micro-rays 32"):
            train_prior(here, quiet)
    assert read_prior(tmp_path / "a").step == 20
    assert train_prior(config(balls, tmp_path / "a", run={"micro_rays": 32}), quiet).status == 0
    assert read_prior(tmp_path / "a").validation["step"] == 20


@pytest.mark.parametrize(("world", "possible"), [(7, False), (6, True)])
def test_more_processes_than_a_step_has_views_are_refused_with_what_to_change(
    balls, tmp_path, monkeypatch, world, possible
):
    """Before anything is written, by each of them; no other process is needed to see it."""

    @contextlib.contextmanager
    def joined(device):
        yield Ranks(0, world)

    monkeypatch.setattr(prior_module, "joined_ranks", joined)
    here = config(balls, tmp_path / "a", run={"dry_run": True})
    if possible:
        assert train_prior(here, quiet).status == 0
    else:
        with pytest.raises(
            TrainingConfigError, match=r"--identities 3 --views 2: the 6 views .* 7 processes.* start 6"
        ):
            train_prior(here, quiet)
    assert not (tmp_path / "a").exists()
