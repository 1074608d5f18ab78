"""Sheets and the page: the pictures are those of the views, and the page holds every figure."""

import json

import numpy as np
import pytest

from preface.artifacts import read_artifact
from preface.geometry import Rigid
from preface.model.evaluation.evaluate import EvaluatedView, ViewFigures
from preface.model.evaluation.metrics_file import Measured
from preface.model.evaluation.options import EvaluationOptions
from preface.model.evaluation.page import HeadResult, evaluation_page
from preface.model.evaluation.sheets import (
    DEPTH_SHOWN,
    ERROR_SHOWN,
    comparison_sheet,
    face_sheet,
    sheet,
    view_pictures,
)
from preface.model.evaluation.views import Square
from preface.model.rendering.showing import depth_entry, error_entry, normals_entry
from preface.model.training.prior_files import read_prior

SQUARE = Square(5, 10, 20)


def a_view(
    name="cam00", psnr=20.0, height=40, width=30, square: Square | None = SQUARE, **changes
) -> EvaluatedView:
    """Red photograph, green render; depth one metre, which is that of the origin; normals out of the face."""
    face = {"psnr_face": psnr + 1} if square else {}
    figures = ViewFigures(
        name=name,
        fitted=False,
        degrees_from_fitted=changes.pop("degrees", 10.0),
        values={"psnr": psnr, "ssim": 0.5, **face},
        left_out={} if square else {"psnr_face": "the face's middle is not in the image"},
        face=square,
        canonical_from_camera=Rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0])),
    )
    images = {
        "truth": np.zeros((height, width, 3), np.float32) + np.array([1, 0, 0], np.float32),
        "rgb": np.zeros((height, width, 3), np.float32) + np.array([0, 1, 0], np.float32),
        "mask": np.ones((height, width), np.float32),
        "alpha": np.full((height, width), 0.5, np.float32),
        "depth": np.ones((height, width), np.float32),
        "normals": np.zeros((height, width, 3), np.float32) + np.array([0, 0, 1], np.float32),
    }
    return EvaluatedView(figures, **images | changes)


def test_pictures_are_of_the_view_and_its_face():
    found = view_pictures(a_view())
    assert (found.truth == [255, 0, 0]).all()
    assert (found.rgb == [0, 255, 0]).all()
    assert (found.normals == [128, 128, 255]).all()
    assert found.face_truth.shape == (20, 20, 3)
    assert found.truth.shape == (40, 30, 3)
    # An error of 2/3 is beyond the bright end; a depth in the middle of its range is neither end's colour.
    assert found.error[0, 0].astype(int).sum() > 500
    assert len(np.unique(found.depth.reshape(-1, 3), axis=0)) == 1


def test_depth_gets_brighter_away_from_the_camera_and_is_a_checker_board_where_there_is_none():
    depth = np.full((40, 30), np.nan, np.float32)
    depth[:20] = np.linspace(1 - DEPTH_SHOWN, 1 + DEPTH_SHOWN, 20, dtype=np.float32)[:, None]
    picture = view_pictures(a_view(depth=depth)).depth.astype(int)
    brightness = picture[:20, 0] @ [30, 59, 11]
    assert (np.diff(brightness) > 0).all()
    assert set(np.unique(picture[20:])) == {108, 148}


def test_large_views_are_reduced_and_small_ones_enlarged_by_whole_factors():
    large = view_pictures(a_view(height=1200, width=900, square=Square(0, 0, 800)))
    assert large.truth.shape[0] == large.error.shape[0] == large.depth.shape[0] == 480
    assert large.face_truth.shape == (360, 360, 3)
    small = sheet([view_pictures(a_view())])
    # Six tiles of 30x40 five times as large; the pure red of the photograph fills the first one.
    red = (small == [255, 0, 0]).all(axis=-1)
    assert red.sum() == 150 * 200


def test_a_sheet_without_normals_has_a_column_less():
    shown, plain = view_pictures(a_view()), view_pictures(a_view(normals=None))
    assert sheet([plain, plain]).shape[1] < sheet([shown, shown]).shape[1]
    # Colours that no other tile has: normals out of the face, and the opacity to their right.
    for picture, has in ((shown, True), (plain, False)):
        whole = sheet([picture, picture])
        assert (whole == [128, 128, 255]).all(axis=-1).any() == has
        assert (whole == [128, 128, 128]).all(axis=-1).sum() >= 2 * 150 * 200


def test_a_sheet_says_what_its_colours_mean():
    """Below the tiles are the bars of depth and error, whole, and the ball of normals only where there are normals."""

    def colours(picture):
        return {tuple(color) for color in picture.reshape(-1, 3).tolist()}

    shown, plain = view_pictures(a_view()), view_pictures(a_view(normals=None))
    assert shown.depths == pytest.approx((1 - DEPTH_SHOWN, 1 + DEPTH_SHOWN))
    for entry in (depth_entry("", ""), error_entry()):
        assert colours(entry[1]) <= colours(sheet([shown])) & colours(sheet([plain]))
    ball = colours(normals_entry()[1])
    assert ball <= colours(sheet([shown]))
    assert not ball <= colours(sheet([plain]))


def test_a_view_without_a_face_has_no_tile_on_the_sheet_of_faces():
    with_face, without = view_pictures(a_view()), view_pictures(a_view("cam01", square=None))
    assert face_sheet([without]) is None
    assert face_sheet([with_face, without]).shape == face_sheet([with_face]).shape


def test_a_comparison_has_a_photograph_and_two_tiles_per_head_in_every_row():
    views = [view_pictures(a_view(name)) for name in ("cam00", "cam01")]
    picture = comparison_sheet([("one", views), ("two", views)])
    red, green = ((picture == color).all(axis=-1) for color in ([255, 0, 0], [0, 255, 0]))
    assert red.sum() == 2 * 150 * 200
    assert green.sum() == 2 * red.sum()


@pytest.fixture
def result(head):
    known = read_prior(head("fitted", ["camera0"]))

    def make(name: str, views) -> HeadResult:
        measured = Measured(name, known, "id0000", tuple(view.figures for view in views))
        photographs = ((np.zeros((40, 30, 3), np.float32), "camera0"),)
        return HeadResult(measured, ("camera0",), photographs, tuple(view_pictures(view) for view in views))

    return make


def test_the_page_holds_every_figure_and_needs_nothing_else(result, tmp_path):
    heads = [
        result("one", [a_view("cam00", 20.125), a_view("cam01", 30.5, degrees=25.0)]),
        result("two", [a_view("cam00", 22.0), a_view("cam01", 19.0, square=None)]),
    ]
    page = evaluation_page(heads, EvaluationOptions(), (30, 40), {"seed": None}).write(tmp_path / "r.html")
    text = page.read_text()
    twin = read_artifact(tmp_path / "r.json", "preface/report")
    headings = [section["heading"] for section in twin["sections"]]
    assert headings[:4] == ["Result", "id0000: heads beside each other", "one", "two"]
    tables = {
        (section["heading"], block["caption"]): block["rows"]
        for section in twin["sections"]
        for block in section["blocks"]
        if block["kind"] == "table"
    }
    means = tables["Result", "The whole frame, and the foreground, means over views"]
    assert [row["frame PSNR"] for row in means] == [25.3125, 20.5]
    worst = tables["two", "The whole frame, and the foreground, worst first"]
    assert [row["camera"] for row in worst] == ["cam01", "cam00"]
    assert "the face&#39;s middle is not in the image" in text
    assert 'src="http' not in text
    assert json.dumps(twin).count('"kind": "picture"') >= 6


def test_one_head_has_key_figures_and_says_what_it_was_fitted_to(result):
    twin = evaluation_page([result("one", [a_view()])], EvaluationOptions(), (30, 40), {}).twin()
    first, second = twin["sections"][0]["blocks"][:2]
    assert "have seen none" in first["paragraphs"][0]
    assert {f["name"]: f["value"] for f in second["figures"]}["PSNR of the face"] == 21.0
    assert "Fitted without a prior to 1 photograph of id0000 (camera0) at 24x32 pixels." in json.dumps(twin)


def test_errors_are_on_a_scale_that_the_page_states(result):
    twin = evaluation_page([result("one", [a_view()])], EvaluationOptions(), (30, 40), {}).twin()
    assert f"{ERROR_SHOWN} of full scale" in json.dumps(twin)
