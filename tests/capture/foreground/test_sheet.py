"""The report on masks: order and content."""

import json

import numpy as np
import pytest
from drawn_person import person, photograph, screen

from preface.capture.foreground import Hints, MaskFigures, make_segmenter, mask_report, worst_first


def figures(camera="left", share=0.4, soft=0.02, **others):
    return MaskFigures("anna", camera, "black", share, soft, **others)


def test_contradictions_come_first_then_remarks_then_the_unusual():
    usual = [figures() for _ in range(5)]
    flagged, remark = figures(flagged=True), figures(notes=("no person",))
    unusual, soft, off = figures(share=0.1), figures(soft=0.2), figures(disagreement=0.4)
    ordered = worst_first([*usual, soft, remark, off, flagged, unusual])
    assert ordered[:5] == [flagged, remark, off, unusual, soft]


def test_masks_that_nothing_else_tells_apart_come_by_what_their_captions_say():
    known = [figures(disagreement=share, soft=0.1 * (1 - share)) for share in (0.16, 0.18, 0.11, 0.07, 0.12)]
    ordered = worst_first([*known, figures(share=0.9)])
    assert [one.disagreement for one in ordered[:5]] == [0.18, 0.16, 0.12, 0.11, 0.07]


def test_the_report_shows_the_worst_and_loads_no_more_than_it_shows(tmp_path):
    alpha, light = person()
    pixels = photograph(alpha, light, screen(240, 160, 0.1))
    found = make_segmenter("green")(pixels, Hints())
    masks = [MaskFigures.of("anna", f"cam{i:02d}", found, 0.01 * i, i == 3) for i in range(50)]
    loaded = []

    def load(identity, camera):
        loaded.append(camera)
        return found.pixels, found.alpha

    report = mask_report(masks, load, {"monday": "green: the take says so"}, {"seed": 0})
    path = report.write(tmp_path / "masks.html")
    assert loaded[0] == "cam03"
    assert len(loaded) == 36
    twin = json.loads(path.with_suffix(".json").read_text())
    assert twin["title"] == "Foreground of 50 photographs"
    tiles = {figure["name"]: figure for figure in twin["sections"][0]["blocks"][0]["figures"]}
    assert tiles["Off the hull, median"]["value"] == pytest.approx(24.5)
    assert tiles["Off the hull, median"]["unit"] == "%"
    rows = twin["sections"][1]["blocks"][-1]["rows"]
    assert [round(row["off the hull"]) for row in rows[:3]] == [3, 49, 48]
    assert "green: the take says so" in path.read_text()
    assert "cam03" in path.read_text()


def test_figures_of_a_mask():
    found = make_segmenter("given")(np.zeros((2, 4, 3), np.uint8), Hints(mask=np.array([[0, 0, 0.5, 1]] * 2)))
    measured = MaskFigures.of("anna", "left", found)
    assert measured.share == pytest.approx(0.375)
    assert measured.soft == pytest.approx(0.25 / 0.375)
    assert np.isnan(measured.disagreement)


def test_an_empty_list_is_refused():
    with pytest.raises(ValueError, match="no mask"):
        mask_report([], lambda *_: None, {}, {})
