"""Contact sheets, heat maps and overlays, judged by the pixels that they draw."""

import numpy as np
import pytest

from preface.reports import (
    colorize,
    contact_sheet,
    finite_range,
    gradient,
    heat_map,
    legend,
    overlay_mask_edges,
    overlay_points,
    with_legend,
)
from preface.reports.pictures import GREEN, SHEET_BACKGROUND, TILE_BACKGROUND, as_picture

RED = (255, 0, 0)
BLUE = (0, 0, 255)


def plain(color, height, width):
    return np.full((height, width, 3), color, np.uint8)


def share_of(picture, color):
    return float((picture == np.array(color)).all(-1).mean())


def box_of(picture, color):
    """Left, top, right, bottom of the pixels of one colour."""
    y, x = np.nonzero((picture == np.array(color)).all(-1))
    return x.min(), y.min(), x.max() + 1, y.max() + 1


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (np.array([[True, False]]), [[255, 0]]),
        (np.array([[0, 200]], np.uint8), [[0, 200]]),
        (np.array([[0, 257 * 31, 65535]], np.uint16), [[0, 31, 255]]),
        (np.array([[-1.0, 0.0, 0.2, 1.0, 7.0]]), [[0, 0, 51, 255, 255]]),
        (np.array([[[0.2]]], np.float16), [[51]]),
    ],
)
def test_every_usual_kind_of_grey_image_becomes_srgb_bytes(image, expected):
    picture = as_picture(image)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, np.repeat(np.array(expected)[:, :, None], 3, 2))


def test_transparency_is_shown_on_a_checker_board():
    image = np.zeros((64, 64, 4), np.uint8)
    image[:, :32, 3] = 255
    picture = as_picture(image)
    assert (picture[:, :32] == 0).all()
    assert len(np.unique(picture[:, 32:])) == 2


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4, 2)),
        np.zeros(4),
        np.zeros((0, 4, 3)),
        np.zeros((4, 4), np.int64),
        np.full((4, 4), np.nan),
        np.full((4, 4), np.inf),
    ],
)
def test_what_is_not_an_image_is_refused(image):
    with pytest.raises(ValueError, match="image"):
        as_picture(image)


def test_tiles_are_laid_out_in_reading_order():
    colors = [(10 * i + 40, 0, 200) for i in range(5)]
    sheet = contact_sheet([(plain(c, 20, 20), "") for c in colors], columns=3, tile_size=(20, 20))
    boxes = [box_of(sheet, c) for c in colors]
    assert [b[1] for b in boxes[:3]] == [boxes[0][1]] * 3
    assert boxes[0][0] < boxes[1][0] < boxes[2][0]
    assert boxes[3][0] == boxes[0][0]
    assert boxes[3][1] > boxes[0][3]


@pytest.mark.parametrize("size", [(400, 40), (40, 400), (5, 1)])
def test_letterboxing_keeps_the_proportions_and_fills_one_side(size):
    width, height = size
    sheet = contact_sheet([(plain(RED, height, width), "")], columns=1, tile_size=(100, 100))
    left, top, right, bottom = box_of(sheet, RED)
    assert max(right - left, bottom - top) == 100
    assert (right - left) / (bottom - top) == pytest.approx(width / height, rel=0.06)
    assert share_of(sheet, TILE_BACKGROUND) > 0.5


def test_enlarging_invents_no_colours_and_reducing_averages():
    pixels = np.array([[RED, BLUE], [BLUE, RED]], np.uint8)
    large = contact_sheet([(pixels, "")], columns=1, tile_size=(64, 64))
    assert {tuple(c) for c in large.reshape(-1, 3).tolist()} == {RED, BLUE, SHEET_BACKGROUND}
    small = contact_sheet([(np.tile(pixels, (32, 32, 1)), "")], columns=1, tile_size=(8, 8))
    left, top, right, bottom = box_of(small, (128, 0, 128))
    assert (right - left, bottom - top) == (8, 8)


def test_a_caption_is_drawn_below_its_own_tile_only():
    without = contact_sheet([(plain(RED, 60, 90), ""), (plain(RED, 60, 90), " ")], 2, (90, 60))
    with_one = contact_sheet([(plain(RED, 60, 90), ""), (plain(RED, 60, 90), "C07 12.5 px")], 2, (90, 60))
    assert with_one.shape[0] >= without.shape[0]
    ink = np.abs(with_one.astype(int) - np.array(SHEET_BACKGROUND)).sum(-1) > 100
    caption_rows = ink[box_of(with_one, RED)[3] :]
    assert caption_rows[:, with_one.shape[1] // 2 :].any()
    assert not caption_rows[:, : with_one.shape[1] // 2].any()


def test_a_long_caption_stays_inside_its_tile():
    tiles = [(plain(RED, 60, 80), "a caption that is much wider than its tile"), (plain(RED, 60, 80), "")]
    sheet = contact_sheet(tiles, columns=2, tile_size=(80, 60))
    ink = np.abs(sheet[box_of(sheet, RED)[3] :].astype(int) - np.array(SHEET_BACKGROUND)).sum(-1) > 60
    columns = np.nonzero(ink.any(0))[0]
    tile_left = box_of(sheet, RED)[0]
    assert columns.min() >= tile_left
    assert columns.max() < tile_left + 80


def test_a_caption_that_is_too_wide_for_one_line_goes_on_below():
    def rows_of_ink(caption):
        sheet = contact_sheet([(plain(RED, 60, 90), caption)], 1, (90, 60))
        ink = np.abs(sheet[box_of(sheet, RED)[3] :].astype(int) - np.array(SHEET_BACKGROUND)).sum(-1) > 100
        return ink.any(1).sum()

    assert rows_of_ink("id0002 cam01 11.6 % disagrees") > 1.5 * rows_of_ink("id0002 cam01")


def test_a_missing_image_leaves_a_marked_place():
    sheet = contact_sheet([(None, ""), (plain(RED, 30, 30), "")], columns=2, tile_size=(30, 30))
    left = sheet[:, : sheet.shape[1] // 2]
    assert share_of(left, RED) == 0
    assert share_of(left, TILE_BACKGROUND) > 0.4
    assert len(np.unique(left.reshape(-1, 3), axis=0)) > 2  # the cross


@pytest.mark.parametrize(
    ("tiles", "columns", "size"),
    [([], 1, (8, 8)), ([(None, "")], 0, (8, 8)), ([(None, "")], 1, (0, 8)), ([(None, "")], 1, (8, -1))],
)
def test_an_impossible_sheet_is_refused(tiles, columns, size):
    with pytest.raises(ValueError, match="contact sheet"):
        contact_sheet(tiles, columns, size)


def test_a_colour_map_runs_from_low_to_high_and_is_clipped_outside():
    values = np.array([[-9.0, 0.0, 0.5, 1.0, 9.0, np.inf, -np.inf]])
    grey = colorize(values, 0, 1, "gray")[0, :, 0]
    np.testing.assert_array_equal(grey[[0, 1, 3, 4, 5, 6]], [0, 0, 255, 255, 255, 0])
    assert 120 <= grey[2] <= 135


@pytest.mark.parametrize("colormap", ["viridis", "inferno", "coolwarm"])
def test_what_is_not_a_number_looks_like_no_number(colormap):
    gaps = colorize(np.full((32, 32), np.nan), 0, 1, colormap).reshape(-1, 3)
    colours = colorize(np.linspace(0, 1, 1024).reshape(32, 32), 0, 1, colormap).reshape(-1, 3)
    distance = np.abs(gaps[:, None].astype(int) - colours[None]).sum(-1).min(1)
    assert len(np.unique(gaps, axis=0)) == 2
    # A checker of two greys cannot be mistaken even where one of them comes near a colour of the map.
    assert distance.max() > 20


@pytest.mark.parametrize(("low", "high"), [(1, 1), (2, 1), (np.nan, 1), (0, np.inf)])
def test_a_range_that_is_no_range_is_refused(low, high):
    with pytest.raises(ValueError, match="range"):
        colorize(np.zeros((2, 2)), low, high, "viridis")


def test_a_heat_map_keeps_its_values_and_adds_a_bar_with_both_ends():
    values = np.linspace(0, 3, 120 * 200).reshape(120, 200)
    picture = heat_map(values, 0, 3, "viridis", "mm")
    np.testing.assert_array_equal(picture[:, :200], colorize(values, 0, 3, "viridis"))
    bar = picture[:, 200:]
    ends = colorize(np.array([[0.0, 3.0]]), 0, 3, "viridis")[0]
    low_rows = np.nonzero((bar == ends[0]).all(-1).any(1))[0]
    high_rows = np.nonzero((bar == ends[1]).all(-1).any(1))[0]
    assert high_rows.min() == 0
    assert low_rows.max() == 119
    assert high_rows.max() < low_rows.min()


def test_a_small_field_is_enlarged_by_whole_pixels_until_the_labels_fit():
    values = np.array([[0.0, 1.0], [1.0, 0.0]])
    picture = heat_map(values, 0, 1, "gray", "")
    side = picture.shape[0]
    assert side >= 96
    np.testing.assert_array_equal(
        picture[:, :side, 0] > 127, np.kron(values, np.ones((side // 2,) * 2)) > 0.5
    )


def test_the_range_of_a_map_ignores_gaps_and_never_collapses():
    assert finite_range(np.array([np.nan, 0.0, 10.0, np.inf]), 0, 100) == (0, 10)
    assert finite_range(np.array([np.nan, 3.0]), 1, 99) == (2.5, 3.5)
    assert finite_range(np.array([np.nan]), 1, 99) == (0, 1)


def test_a_circle_is_centred_on_its_point_under_the_half_pixel_convention():
    black = np.zeros((41, 61, 3), np.uint8)
    drawn = overlay_points(black, np.array([[30.5, 20.5]]), None, 6, GREEN)
    weight = drawn[:, :, 1].astype(float)
    y, x = np.mgrid[:41, :61] + 0.5
    np.testing.assert_allclose(
        [(x * weight).sum(), (y * weight).sum()] / weight.sum(), [30.5, 20.5], atol=0.05
    )
    assert drawn[20, 36, 1] > 100  # one radius to the right of the centre of pixel (30, 20)
    assert (drawn[20, 30] == 0).all()


def test_points_that_are_unknown_or_outside_are_left_out():
    image = np.random.default_rng(1).integers(0, 255, (30, 40, 3), np.uint8)
    points = np.array([[np.nan, 3], [-1, 5], [5, 31], [41, 5]])
    np.testing.assert_array_equal(overlay_points(image, points, ["a", "b", "c", "d"], 3, GREEN), image)


@pytest.mark.parametrize("point", [(0, 0), (199.9, 0), (0, 99.9), (199.9, 99.9), (100, 50)])
def test_a_label_stays_inside_the_image(point):
    black = np.zeros((100, 200, 3), np.uint8)
    bare = overlay_points(black, np.array([point]), None, 4, GREEN)
    labelled = overlay_points(black, np.array([point]), ["nose_tip"], 4, GREEN)
    ink = (labelled != bare).any(-1)
    reference = (overlay_points(black, np.array([[100.0, 50.0]]), ["nose_tip"], 4, GREEN) != 0).any(-1)
    assert np.ptp(np.nonzero(ink.any(0))[0]) >= 0.8 * np.ptp(np.nonzero(reference.any(0))[0])


def test_labels_and_points_must_pair_up():
    with pytest.raises(ValueError, match="labels"):
        overlay_points(np.zeros((9, 9)), np.zeros((2, 2)), ["only one"], 2, GREEN)
    with pytest.raises(ValueError, match=r"\[N, 2\]"):
        overlay_points(np.zeros((9, 9)), np.zeros((2, 3)), None, 2, GREEN)


def test_the_edge_of_a_mask_is_a_closed_line_inside_it():
    mask = np.zeros((40, 50))
    mask[10:30, 10:40] = 1
    mask[9, :] = 0.49  # thin coverage stays outside
    edge = (overlay_mask_edges(np.zeros((40, 50)), mask, 2, RED) == np.array(RED)).all(-1)
    expected = mask >= 0.5
    expected[12:28, 12:38] = False
    np.testing.assert_array_equal(edge, expected)


def test_a_mask_at_the_image_border_has_no_edge_there():
    drawn = overlay_mask_edges(np.zeros((20, 20)), np.ones((20, 20), bool), 2, RED)
    assert share_of(drawn, RED) == 0


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(ValueError, match="same size"):
        overlay_mask_edges(np.zeros((20, 20)), np.ones((20, 21)), 1, RED)


def test_drawing_leaves_the_given_image_alone():
    image = np.full((40, 40, 3), 9, np.uint8)
    overlay_points(image, np.array([[20.0, 20.0]]), ["x"], 4, GREEN)
    overlay_mask_edges(image, np.eye(40), 1, RED)
    assert (image == 9).all()


def test_a_legend_shows_its_samples_as_they_are_between_their_words():
    sample = plain(RED, 20, 30)
    drawn = legend([("near", sample, "far"), ("", plain(BLUE, 10, 10), "b")], 400)
    left, top, right, bottom = box_of(drawn, RED)
    assert (right - left, bottom - top) == (30, 20)
    assert drawn.shape[1] == 400
    ink = (np.abs(drawn.astype(int) - np.array(SHEET_BACKGROUND)).sum(-1) > 100).any(0)
    assert ink[:left].any()
    assert ink[right : box_of(drawn, BLUE)[0]].any()


def test_entries_of_a_legend_go_on_below_where_they_are_too_wide_and_none_is_cut():
    entry = ("before", plain(RED, 10, 40), "after")
    one, two = legend([entry], 400), legend([entry, ("before", plain(BLUE, 10, 40), "after")], 260)
    assert box_of(two, BLUE)[1] > box_of(two, RED)[3]
    assert two.shape[0] == 2 * one.shape[0]
    narrow = legend([entry], 5)
    assert narrow.shape[1] > 40
    assert (narrow == np.array(RED)).all(-1).sum() == 400


def test_a_sheet_with_a_legend_is_the_sheet_above_it():
    sheet = plain(BLUE, 30, 20)
    both = with_legend(sheet, [("words", plain(RED, 10, 10), "")])
    np.testing.assert_array_equal(both[:30, :20], sheet)
    assert box_of(both, RED)[1] > 30
    assert share_of(both[:30, 20:], SHEET_BACKGROUND) == 1


def test_a_gradient_is_the_colour_map_from_its_low_end_to_its_high_end():
    bar = gradient("viridis", 50, 3)
    np.testing.assert_array_equal(bar, colorize(np.linspace(2, 4, 50)[None].repeat(3, 0), 2, 4, "viridis"))
