"""What is measured and what is chosen from it, on figures made up for the purpose."""

import json
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from measure_tradeoff import _state
from preface.artifacts import ArtifactError
from preface.model.configuration import preset
from preface.model.fitting.configuration import defaults
from preface.model.rendering.shortcuts import Shortcuts
from tradeoff.fitting import VARIED, Fit, fits, means, measure
from tradeoff.fitting import table as fit_table
from tradeoff.front import chosen, cost, front
from tradeoff.points import fullest, render_points
from tradeoff.report import plot, table


def point(name, seconds, psnr, to_full, group="together", prepare=0.0, model=0):
    figures = {"lowest_psnr_to_full": to_full - 1, "alpha_off": 0.0, "depth_off_median_mm": 0.1}
    figures |= {"depth_off_p95_mm": 0.2, "mflop_per_ray": 1.0, "peak_mib": 10.0, "ssim": 0.9, "lpips": 0.1}
    if group != "fullest":
        figures |= {"psnr_to_trained": to_full + 1, "lowest_psnr_to_trained": to_full}
    return {
        "name": name, "group": group, "settings": {"model": model}, "rays": 10**6, "cpu_us_per_ray": seconds,
        "prepare_cpu_s": prepare, "psnr": psnr, "psnr_to_full": to_full, **figures,
    }  # fmt: skip


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(0.1, 10), st.floats(20, 60)), min_size=1, max_size=12))
def test_a_point_is_on_the_front_if_no_other_is_both_cheaper_and_better(values):
    points = [point(str(n), seconds, 30.0, decibels) for n, (seconds, decibels) in enumerate(values)]
    names = front(points, 1, "psnr_to_full")
    for p in points:
        beaten = any(
            (o["cpu_us_per_ray"] <= p["cpu_us_per_ray"] and o["psnr_to_full"] > p["psnr_to_full"])
            or (o["cpu_us_per_ray"] < p["cpu_us_per_ray"] and o["psnr_to_full"] == p["psnr_to_full"])
            for o in points
        )
        twins = [
            o["name"] for o in points if (cost(o, 1), o["psnr_to_full"]) == (cost(p, 1), p["psnr_to_full"])
        ]
        assert any(name in names for name in twins) != beaten


def test_qualities_follow_their_rules_and_say_so_where_no_point_will_do():
    reference = point("as trained", 10.0, 30.0, 48.0, group="reference")
    points = [
        reference,
        point("fullest 0", 90.0, 30.1, 100.0, group="fullest"),
        point("too far from the photographs", 0.5, 29.6, 47.0),
        point("to look at", 0.8, 29.8, 43.0),
        point("fast enough", 1.5, 29.95, 45.5),
        point("near", 2.0, 29.95, 46.5),
        point("nearer, too slow", 2.1, 30.0, 47.0),
        point("another width", 0.5, 30.0, 49.0, model=1),
    ]
    assert chosen(points, 1) == {"draft": "to look at", "balanced": "near", "reference": "as trained"}
    assert chosen([reference], 1) == {"draft": "as trained", "balanced": None, "reference": "as trained"}
    found = table(points, 1, chosen(points, 1))
    assert "| near |" in found
    assert "| 46.50 (45.50) | 47.50 (46.50) |" in found
    assert len({line.count("|") for line in found.splitlines()}) == 1
    assert plot(points, 1, chosen(points, 1))[:8] == b"\x89PNG\r\n\x1a\n"


def test_what_is_prepared_once_counts_less_the_more_images_share_it():
    grid, none = point("grid", 1.0, 30.0, 46.0, prepare=5.0), point("none", 3.0, 30.0, 46.0)
    assert cost(grid, 1) == pytest.approx(6.0)
    assert front([grid, none], 1, "psnr_to_full") == ["none"]
    assert front([grid, none], 10, "psnr_to_full") == ["grid"]


@pytest.mark.parametrize("small", [False, True])
def test_points_differ_and_vary_every_shortcut(small):
    prior = SimpleNamespace(model=preset("small").resolved(0.01))
    points = render_points([prior, prior], small=small)
    settings_of = [json.dumps([p.group, p.settings()], sort_keys=True) for p in points]
    assert len(set(settings_of)) == len(points)
    assert len({p.name for p in points}) == len(points)
    usual = Shortcuts().__dict__
    varied = {name for p in points for name, value in p.shortcuts.__dict__.items() if value != usual[name]}
    assert small or varied == set(usual)
    assert fullest(0, prior).samples == (128, 128, 64)
    assert {p.model for p in points} == {0, 1}


def test_fits_vary_one_thing_at_a_time_and_none_is_longer_than_asked(tmp_path):
    options = SimpleNamespace(
        shards=tmp_path, output=tmp_path / "out", prior=tmp_path / "prior", views=["a", "b"], quality="balanced",
        resolutions=[], most_steps=500, vary=VARIED,
    )  # fmt: skip
    found = list(fits(options, "someone"))
    assert len({fit.config.output for fit in found}) == len(found)
    usual = found[0].config.to_dict()
    for fit in found[1:]:
        now = fit.config.to_dict()
        changed = [
            (part, key)
            for part in ("inversion", "finetuning")
            for key in now[part]
            if now[part][key] != usual[part][key]
        ]
        assert len(changed) <= 1
        assert fit.config.finetuning.steps <= max(500, found[0].config.finetuning.steps)
        assert fit.config.identity == "someone"
    assert {fit.group for fit in found} == {"as it is", "steps", "inversion", "rays"}


def test_qualities_are_fitted_as_they_are(tmp_path):
    import ball_heads

    ball_heads.write_dataset(tmp_path)
    options = SimpleNamespace(
        shards=tmp_path, output=tmp_path / "out", prior=tmp_path / "prior", views=["a", "b"],
        quality="draft", resolutions=[], most_steps=10**6, vary=["quality"],
    )  # fmt: skip
    found = list(fits(options, "someone"))
    assert [fit.config.quality for fit in found] == ["draft", "balanced", "reference", "paper"]
    for fit in found:
        quality = fit.config.quality
        assert fit.name == f"quality {quality}"
        assert (fit.config.inversion, fit.config.finetuning, fit.config.run) == defaults(quality)
    assert len({fit.config.output for fit in found}) == 4
    options.most_steps = found[1].config.finetuning.steps
    assert [fit.config.quality for fit in fits(options, "someone")][:2] == ["draft", "balanced"]
    options.most_steps = found[0].config.finetuning.steps
    assert "balanced" not in [fit.config.quality for fit in fits(options, "someone")]


def test_a_fit_is_on_the_front_of_a_figure_if_nothing_cheaper_is_better_by_it():
    rows = [("a", 1.0, 30.0, 0.3), ("b", 2.0, 29.0, 0.2), ("c", 3.0, 29.5, 0.25)]
    points = [
        {
            "name": n,
            "group": "",
            "person": "x",
            "cpu_s": s,
            "psnr": p,
            "lpips": d,
            "view_cpu_s": 1.0,
            "peak_mib": 1.0,
        }
        for n, s, p, d in rows
    ]
    assert [row["front"] for row in means(points)] == [["psnr", "lpips"], ["lpips"], []]


def test_a_sweep_goes_on_only_with_the_views_that_it_began_with(tmp_path: Path):
    file = tmp_path / "render.json"
    state = _state(file, {"views": [["a", "b"]]})
    assert state["points"] == {}
    file.write_text(json.dumps({**state, "points": {"x": np.pi}}))
    assert _state(file, {"views": [["a", "b"]]})["points"] == {"x": np.pi}
    with pytest.raises(ArtifactError, match="another sweep"):
        _state(file, {"views": [["a", "c"]]})


def test_a_fit_is_measured_at_the_views_that_it_was_not_fitted_to(tmp_path):
    import ball_heads
    import small_fits

    ball_heads.write_dataset(tmp_path)
    with threads(1):
        config = small_fits.config(tmp_path, "none", tmp_path / "head")
        found = measure(Fit("steps 8", "steps", config, tmp_path))
        held_out = small_fits.held_out_psnr(tmp_path, tmp_path / "head")
    assert {"ssim", "lpips", "psnr_face", "cpu_s", "view_cpu_s", "peak_mib"} <= set(found)
    # A mean of decibels in place of decibels of a mean: near, and not the same.
    assert found["psnr"] == pytest.approx(held_out, abs=1.0)
    (row,) = means([{"name": "x", "group": "y", "person": "z", **found}])
    assert row["view_cpu_s"] == found["view_cpu_s"] > 0
    assert "| x | 1 |" in fit_table([row])


@contextmanager
def threads(count: int):
    """The tests' workers use every core already."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    yield
    torch.set_num_threads(before)
