"""The paper's figures agree with each other, and each row differs from the full method in what it is about."""

import itertools

import numpy as np
import pytest

from ablation.design import FULL, USUAL_VIEWS, Base, cells_of, tables, view_sets
from ablation.paper import METRICS, PAPER
from preface.model.fitting.configuration import FitConfig, defaults

COUNTS, SIZE = (4, 15, 30, 60), (96, 144)
# The row of the full method, 1450 people at 512x768 and two views, in each table of the paper.
FULL_ROWS = {
    "initialisation": "inversion",
    "regularisers": "both",
    "views": "2",
    "frozen-latent": "optimised",
    "identities": "1450",
    "resolution": "512x768",
}


@pytest.mark.parametrize("metric", METRICS)
def test_the_full_method_has_one_figure_in_all_of_the_papers_tables(metric):
    figures = {name: PAPER[name].rows[row][metric] for name, row in FULL_ROWS.items()}
    # One of them is a mean over subjects of rounded figures.
    assert max(figures.values()) - min(figures.values()) < (0.006 if metric == "psnr" else 2e-4), figures


def test_every_table_has_as_many_rows_as_the_papers_and_the_full_method_among_them():
    for name, table in tables(COUNTS, SIZE).items():
        assert [row.paper for row in table.rows] == list(PAPER[name].rows)
        assert [row.paper for row in table.rows if row.variant == FULL] == [FULL_ROWS[name]]


def test_fits_that_tables_share_are_made_once_and_a_seed_is_finished_before_the_next():
    chosen = list(tables(COUNTS, SIZE).values())
    cells = cells_of(chosen, ["anna", "bert", "cleo"], [0, 1])
    assert len(cells) == len({cell.name for cell in cells}) == 18 * 3 * 2
    assert [cell.seed for cell in cells] == sorted(cell.seed for cell in cells)
    # Rows that are called alike are fitted alike.
    for cell in cells:
        assert sum(c.variant.name == cell.variant.name and c != cell for c in cells) == 5


def difference(one: FitConfig, other: FitConfig) -> dict:
    found = {}
    for part in ("inversion", "finetuning"):
        ours, theirs = vars(getattr(one, part)), vars(getattr(other, part))
        found |= {name: ours[name] for name in ours if ours[name] != theirs[name]}
    return found


@pytest.mark.parametrize(
    ("variant", "expected"),
    [
        ("start-zeros", {"steps": 0}),
        ("start-nearest", {"steps": 0, "start": "nearest"}),
        ("no-regularisers", {"normals": 0.0, "view_weights": 0.0}),
        ("normals-only", {"view_weights": 0.0}),
        ("view-weights-only", {"normals": 0.0}),
        ("frozen-latent", {"frozen_latent": True}),
        ("identities-15", {}),
    ],
)
def test_a_row_differs_from_the_full_method_in_one_thing(variant, expected, tmp_path):
    base = Base(tmp_path, "paper", *defaults("paper"))
    cells = {cell.variant.name: cell for cell in cells_of(list(tables(COUNTS, SIZE).values()), ["anna"], [3])}
    full = base.fit(cells["full"], tmp_path / "prior", ["a", "b"], tmp_path / "head")
    fit = base.fit(cells[variant], tmp_path / "prior", ["a", "b"], tmp_path / "head")
    assert difference(fit, full) == expected
    assert fit.seed == 3
    assert cells[variant].variant.views == USUAL_VIEWS


def directions(azimuths, elevations):
    a, e = np.radians(azimuths), np.radians(elevations)
    return np.stack([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)], axis=1)


def test_views_are_spread_about_the_front_and_all_sets_leave_the_same_views():
    # A studio of thirteen: front, two pairs beside it, above and below, profiles.
    azimuths = [2, -47, 51, 1, -23, 25, -33, 34, -28, 31, 3, -85, 85]
    elevations = [9, 7, 11, 41, 3, 6, 30, 34, -18, -17, -20, 5, 8]
    sets = view_sets(directions(azimuths, elevations) * np.linspace(0.8, 1.2, 13)[:, None])
    assert sets == {1: (0,), 2: (4, 5), 3: (1, 0, 2), 5: (1, 4, 0, 5, 2), 7: (1, 4, 0, 5, 2, 11, 12)}


@pytest.mark.parametrize("count", [6, 7, 8, 30])
def test_sets_lie_in_one_another_and_leave_a_view_whatever_the_rig(count):
    rng = np.random.default_rng(count)
    sets = view_sets(directions(rng.uniform(-180, 180, count), rng.uniform(-60, 60, count)))
    assert list(sets) == [1, 2, 3, 5, *([7] if count > 7 else [])]
    largest = set(sets[max(sets)])
    assert all(set(views) <= largest and len(set(views)) == n for n, views in sets.items())
    assert len(largest) < count


def test_five_cameras_leave_nothing_to_evaluate():
    with pytest.raises(ValueError, match="at least one to evaluate"):
        view_sets(directions([-50, -25, 0, 25, 50], [0] * 5))


def test_fewer_numbers_of_people_stand_beside_the_papers_largest():
    rows = tables((2, 3), SIZE)["identities"].rows
    assert [(row.name, row.paper) for row in rows] == [("2", "750"), ("3", "1450")]
    assert all(a != b for a, b in itertools.pairwise(row.variant.prior for row in rows))
