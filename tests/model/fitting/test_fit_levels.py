"""Levels of the encoding in a fit: views that are finer than a prior's give the head more."""

import pytest
import small_fits
from small_fits import config
from small_runs import quiet

from preface.model.configuration import carried_levels
from preface.model.fitting.observations import observe
from preface.model.fitting.run import fit_head
from preface.model.training.configuration import TrainingConfigError
from preface.model.training.prior_files import read_prior
from preface.shards import Dataset


def test_finer_views_give_the_head_more_levels_of_which_it_is_told_once(balls, prior, tmp_path):
    known = read_prior(prior).model.levels
    with Dataset(balls) as dataset:
        carried = carried_levels(observe(dataset, small_fits.UNSEEN, small_fits.VIEWS, None).smallest_radius)
    said = []
    fit_head(config(balls, prior, tmp_path / "a", finetuning={"levels": "auto"}), said.append)
    head = read_prior(tmp_path / "a")
    assert known < carried == head.model.levels
    new = head.load_model().nerf.layers[0].weight.view(-1, 2, carried, 21)[:, :, known:]
    assert new.abs().amax(dim=(0, 1, 3)).min() > 0  # each level has been learned
    assert (
        sum(f"{carried} levels of the encoding, of which the prior has {known}" in words for words in said)
        == 1
    )


def test_levels_of_the_prior_or_a_number_are_taken_as_asked_for(balls, prior, tmp_path):
    known, found = read_prior(prior).model.levels, {}
    for asked in ("prior", known + 2):
        few = {"finetuning": {"steps": 1, "levels": asked}, "inversion": {"steps": 1}}
        fit_head(config(balls, prior, tmp_path / str(asked), **few), quiet)
        found[asked] = read_prior(tmp_path / str(asked)).model.levels
    assert found == {"prior": known, known + 2: known + 2}
    fewer = config(balls, prior, tmp_path / "a", finetuning={"levels": known - 1})
    with pytest.raises(
        TrainingConfigError, match=rf"--finetuning.levels {known - 1}: .*the prior has {known}"
    ):
        fit_head(fewer, quiet)
    assert not (tmp_path / "a").exists()
