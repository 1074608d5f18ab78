"""What tables and statements say of results that were made up to agree, to contradict, or to say nothing."""

import math

import pytest

from ablation.cells import Result, difference, spread
from ablation.design import tables
from ablation.paper import METRICS
from ablation.report import markdown, markdown_table, pairs, payload, statement

TABLES = tables((4, 15, 30, 60), (96, 144))
PEOPLE = ("anna", "bert", "cleo")


def results(values, noise=0.0):
    """A figure per row of a table; people differ by a decibel, and rows of a person by noise that sums to nothing."""
    found = {}
    for number, (variant, psnr) in enumerate(values.items()):
        found[variant] = {
            (who, seed): Result(
                {
                    "psnr_face": psnr + person + noise * math.sin(7 * (person + 3 * seed) + 5 * number),
                    "ssim_face": 0.02 * psnr,
                    "lpips_face": 1 - 0.02 * psnr,
                },
                seconds=10.0,
                rays=1000.0,
            )
            for person, who in enumerate(PEOPLE)
            for seed in (0, 1)
        }
    return found


REGULARISERS = ("no-regularisers", "normals-only", "view-weights-only", "full")


def test_rows_in_the_papers_order_are_said_to_agree():
    found = results(dict(zip(REGULARISERS, (20.0, 21.0, 22.0, 23.0), strict=True)))
    for metric in METRICS:
        words = statement(TABLES["regularisers"], found, metric)
        assert "the order of the rows is the paper's" in words
        assert "Best is both, as in the paper" in words
        assert (
            "Of 6 pairs of rows, 6 are as in the paper beyond the spread, 0 within it, 0 the other" in words
        )


def test_a_row_that_is_ahead_against_the_paper_is_named_with_its_margin():
    found = results(dict(zip(REGULARISERS, (20.0, 21.0, 23.5, 23.0), strict=True)))
    words = statement(TABLES["regularisers"], found, "psnr")
    assert "the order of the rows is none < normals < both < view weights, and in the paper" in words
    assert "Best is view weights, in the paper both" in words
    assert "1 the other way round: view weights is ahead of both by 0.50 ± 0.00 dB." in words
    # A lower LPIPS is ahead, too.
    assert "view weights is ahead of both by 0.0100" in statement(TABLES["regularisers"], found, "lpips")


def test_differences_within_two_standard_errors_say_nothing():
    found = results(dict(zip(REGULARISERS, (20.0, 20.01, 20.02, 20.03), strict=True)), noise=1.0)
    verdicts = {pair.verdict for pair in pairs(TABLES["regularisers"], found, "psnr")}
    assert verdicts == {"within the spread"}


def test_differences_are_taken_person_by_person():
    found = results({"full": 23.0, "frozen-latent": 22.0})
    gap = difference(found, "full", "frozen-latent", "psnr")
    assert gap.mean == pytest.approx(1.0)
    assert gap.deviation == pytest.approx(0.0, abs=1e-12)  # though people differ by a decibel
    assert gap.count == 6
    del found["full"]["anna", 0]
    assert difference(found, "full", "frozen-latent", "psnr").count == 5


def test_one_fit_has_no_spread_and_decides_nothing():
    found = {
        name: {("anna", 0): cells["anna", 0]}
        for name, cells in results({"full": 23.0, "frozen-latent": 9.0}).items()
    }
    assert "1 within it" in statement(TABLES["frozen-latent"], found, "psnr")
    assert "±" not in markdown_table(TABLES["frozen-latent"], found)
    assert spread([]) is None
    assert math.isinf(spread([1.0]).error)


def test_rows_that_are_not_done_are_left_open():
    found = results({"full": 23.0, "views-1": 20.0})
    table = markdown_table(TABLES["views"], found).splitlines()
    assert table[2].startswith("| 1 | 6 | 20.99 ± ") or table[2].startswith("| 1 | 6 | 21.00 ± ")
    assert table[4].startswith("| 3 | 0 | – | 27.16 |")
    assert "not enough was measured" in statement(TABLES["resolution"], found, "psnr")
    assert "Best is 2, as in the paper" in statement(TABLES["views"], found, "psnr")


def test_figures_that_could_not_be_measured_are_left_out_and_not_taken_for_zero():
    found = results({"full": 23.0, "frozen-latent": 22.0})
    for cells in found.values():
        for cell in cells.values():
            del cell.figures["lpips_face"]
    assert "not enough" in statement(TABLES["frozen-latent"], found, "lpips")
    assert "| – | 0.1905 |" in markdown_table(TABLES["frozen-latent"], found)


def test_the_report_has_every_table_beside_the_papers_and_its_json_the_same():
    found = results(dict(zip(REGULARISERS, (20.0, 21.0, 22.0, 23.0), strict=True)))
    chosen = [TABLES["regularisers"], TABLES["resolution"]]
    text = markdown(chosen, found, ["made up"])
    assert text.count("\n## ") == 2
    assert "| view weights | 6 | 23.00 ± " in text
    assert "| 48x72 (the paper: 256x384) | 0 |" in text
    first = payload(chosen, found)[0]
    assert first["rows"][2]["ours"]["psnr"]["mean"] == pytest.approx(23.0)
    assert first["rows"][2]["paper"] == {
        "row": "view weights",
        "psnr": 25.53,
        "ssim": 0.7996,
        "lpips": 0.1963,
    }
    assert {pair["verdict"] for pair in first["pairs"]["psnr"]} == {"agrees"}
