import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from preface.capture.preparation.filters import axis
from preface.capture.preparation.separable import Separable
from preface.capture.preparation.transfer import as_they_are

FILTERS = ["area", "lanczos", "bilinear"]


@st.composite
def lines(draw, longest=60):
    """A line's length, the part of it, and the number of result pixels."""
    length = draw(st.integers(1, longest))
    span = draw(st.floats(1, length))
    start = draw(st.floats(0, 1)) * (length - span)
    return length, start, span, draw(st.integers(1, int(span)))


def dense(filter, length, start, span, count):
    made = axis(filter, length, start, span, count)
    matrix = np.zeros((count, length))
    for row, (first, weights) in enumerate(zip(made.first, made.weights, strict=True)):
        for tap, weight in enumerate(weights):
            if weight != 0:
                matrix[row, first + tap] += weight
    return matrix


def covered(pixel, low, high):
    """How much of [pixel, pixel + 1) lies in [low, high)."""
    return max(0.0, min(pixel + 1, high) - max(pixel, low))


@settings(max_examples=200, deadline=None)
@given(lines())
def test_area_weights_are_the_covered_parts_of_pixels(line):
    length, start, span, count = line
    ratio = span / count
    wanted = [
        [covered(p, start + i * ratio, start + (i + 1) * ratio) / ratio for p in range(length)]
        for i in range(count)
    ]
    np.testing.assert_allclose(dense("area", *line), wanted, atol=1e-12)


@settings(max_examples=200, deadline=None)
@given(lines())
def test_area_neither_loses_nor_adds_light(line):
    length, start, span, count = line
    given_out = dense("area", *line).sum(0) * span / count
    np.testing.assert_allclose(
        given_out, [covered(p, start, start + span) for p in range(length)], atol=1e-11
    )


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(FILTERS), lines())
def test_weights_add_up_to_one_and_turn_with_the_line(filter, line):
    length, start, span, count = line
    weights = dense(filter, *line)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    turned = dense(filter, length, length - start - span, span, count)
    np.testing.assert_allclose(turned[::-1, ::-1], weights, atol=1e-9)


@pytest.mark.parametrize("filter", FILTERS)
def test_at_full_size_every_filter_keeps_every_pixel(filter):
    np.testing.assert_allclose(dense(filter, 9, 0.0, 9.0, 9), np.eye(9), atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(st.integers(40, 200), st.integers(1, 12))
def test_a_straight_slope_keeps_its_values_away_from_the_ends(length, count):
    """These filters are symmetric about the result pixel's centre, where the slope has its mean."""
    slope = np.arange(length) + 0.5
    ratio = length / count
    centers = (np.arange(count) + 0.5) * ratio
    for filter, reach in (("bilinear", 1 / ratio), ("lanczos", 3.0)):
        inner = (centers >= reach * ratio) & (centers <= length - reach * ratio)
        # Lanczos, sampled at pixels, has its mean there only on average.
        loose = 0.02 * ratio if filter == "lanczos" else 1e-9 * length
        found = dense(filter, length, 0.0, float(length), count) @ slope
        np.testing.assert_allclose(found[inner], centers[inner], atol=loose)


def test_lanczos_takes_the_kernel_of_the_book():
    ratio, center = 4.0, 30.0
    row = dense("lanczos", 60, 0.0, 60.0, 15)[7]
    place = (np.arange(60) + 0.5 - center) / ratio
    kernel = np.array([np.sinc(t) * np.sinc(t / 3) if abs(t) < 3 else 0.0 for t in place])
    np.testing.assert_allclose(row, kernel / kernel.sum(), atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(FILTERS),
    lines(400),
    lines(100),
    st.sampled_from([1, 3]),
    st.sampled_from([2**12, 2**20]),
)
def test_two_axes_at_once_equal_their_full_matrices(filter, down, across, channels, step):
    source = np.random.default_rng(0).uniform(0, 1, (down[0], across[0], channels)).astype(np.float32)
    wanted = np.einsum(
        "ih,hwc,jw->ijc",
        dense(filter, *down),
        source.astype(np.float64),
        dense(filter, *across),
        optimize=True,
    )
    with pytest.MonkeyPatch.context() as patch:  # small steps: rows that are added up over many of them
        patch.setattr("preface.capture.preparation.separable._STEP_BYTES", step)
        found = Separable(axis(filter, *down), axis(filter, *across))(as_they_are, source)
    np.testing.assert_allclose(found, wanted, atol=3e-6)


def test_every_row_is_read_once_for_filters_that_reach_far():
    rows_read = []

    def read(rows, out):
        rows_read.append(len(rows))
        np.copyto(out, rows)

    source = np.zeros((900, 4000, 3), np.float32)
    Separable(axis("lanczos", 900, 0.0, 900.0, 30), axis("lanczos", 4000, 0.0, 4000.0, 100))(read, source)
    assert sum(rows_read) == 900
    assert max(rows_read) * 4000 * 3 * 4 <= 2**20  # and only a few at a time
