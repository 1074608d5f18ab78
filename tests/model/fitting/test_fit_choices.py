"""What can be chosen for a fit: the paper's steps, the qualities, and what is refused."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from preface.model.fitting.configuration import (
    PAPER_STEPS,
    QUALITIES,
    FinetuningConfig,
    FitConfig,
    FitRunConfig,
    InversionConfig,
    check,
    finetuning_levels,
    finetuning_steps,
)
from preface.model.training.configuration import TrainingConfigError

AUTO = FinetuningConfig(levels="auto")


@pytest.mark.parametrize(("side", "steps"), PAPER_STEPS)
def test_the_papers_resolutions_get_its_steps(side, steps):
    assert finetuning_steps(AUTO, side, side) == steps


def test_steps_grow_with_the_resolution_and_depend_on_its_area_alone():
    found = [finetuning_steps(AUTO, side, side) for side in (1, 16, 96, 256, 300, 512, 700, 2048, 3000, 4096)]
    assert found == sorted(found)
    assert found[0] >= 1
    assert finetuning_steps(AUTO, 8192, 8192) == 300_000
    assert finetuning_steps(AUTO, 256, 1024) == 50_000
    assert finetuning_steps(replace(AUTO, steps=7), 512, 512) == 7


@pytest.mark.parametrize(
    ("asked", "known", "levels"),
    [("auto", 4, 9), ("auto", 9, 9), ("auto", 12, 12), ("prior", 4, 4), (12, 11, 12), (11, 11, 11)],
)
def test_levels_are_what_the_views_carry_and_never_fewer_than_the_priors(asked, known, levels):
    """A cone of radius 0.02 has averaged the wave of level 9 to 0.01 % of its height and that of level 8 to 5 %."""
    heights = [math.exp(-(4**level) * 0.02**2 / 8) for level in (8, 9)]
    assert heights[0] > 0.01 > heights[1]
    assert finetuning_levels(replace(AUTO, levels=asked), known, 0.02) == levels


def test_cameras_within_the_box_leave_the_levels_as_they_are():
    assert finetuning_levels(AUTO, 7, 0.0) == 7


def config(**changed) -> FitConfig:
    return FitConfig(Path("shards"), views=("cam01", "cam02"), **changed)


def test_every_quality_can_work_and_paper_is_the_papers():
    for inversion, finetuning, run in QUALITIES.values():
        check(config(inversion=inversion, finetuning=finetuning, run=run))
    inversion, finetuning, _ = QUALITIES["paper"]
    assert (inversion.steps, inversion.patches, inversion.patch, inversion.rate) == (1500, 8, 32, 1e-3)
    assert (inversion.lpips, inversion.start) == (0.2, "zeros")
    assert (finetuning.rays, finetuning.rate, finetuning.rate_last, finetuning.clip) == (
        8192,
        1e-3,
        2e-5,
        1e-3,
    )
    assert (finetuning.normals, finetuning.view_weights, finetuning.interlevel) == (1e-3, 1e-4, 1)
    assert (finetuning.foreground_share, finetuning.frozen_latent) == (0, False)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"inversion": InversionConfig(steps=-1)}, "--inversion.steps -1"),
        ({"inversion": InversionConfig(patch=8)}, "--inversion.patch 8: .* 16 or more"),
        ({"inversion": InversionConfig(patch=30, network="alex")}, "31 or more"),
        ({"inversion": InversionConfig(rate=0.0)}, "--inversion.rate 0"),
        ({"inversion": InversionConfig(lpips=float("nan"))}, "--inversion.lpips nan"),
        ({"finetuning": FinetuningConfig(rays=0)}, "--finetuning.rays 0"),
        ({"finetuning": FinetuningConfig(rate_last=float("inf"))}, "--finetuning.rate-last inf"),
        ({"finetuning": FinetuningConfig(view_weights=-1e-4)}, "--finetuning.view-weights"),
        ({"finetuning": FinetuningConfig(foreground_share=1.5)}, "--finetuning.foreground-share 1.5"),
        ({"finetuning": FinetuningConfig(orientation=-0.1)}, "--finetuning.orientation -0.1"),
        ({"finetuning": FinetuningConfig(levels=17)}, "--finetuning.levels 17: .* 0 to 16, auto or prior"),
        ({"run": FitRunConfig(micro_rays=0)}, "--micro-rays 0"),
        ({"seed": -1}, "--seed -1"),
        ({"like": Path("other")}, "--like other: .*with --prior none only"),
    ],
)
def test_values_that_cannot_work_are_refused_by_flag(changed, words):
    with pytest.raises(TrainingConfigError, match=words):
        check(config(**changed))


@pytest.mark.parametrize(
    ("views", "words"),
    [
        ((), "0 cameras; name one to seven"),
        (tuple(f"cam{n}" for n in range(8)), "8 cameras"),
        (("cam01", "cam01"), "cam01: is there twice"),
    ],
)
def test_one_to_seven_different_views_are_asked_for(views, words):
    with pytest.raises(TrainingConfigError, match=words):
        check(replace(config(), views=views))


def test_a_patch_of_any_size_will_do_without_lpips():
    check(config(inversion=InversionConfig(patch=1, lpips=0.0)))


def test_reading_the_configuration_does_not_wait_for_torch():
    code = "import sys, preface.model.fitting.configuration; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
