"""Rays against boxes, held against sampling along the ray."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from preface.geometry import Box, GeometryError

BOX = Box([-1, -2, -3], [1, 2, 3])
# Coordinates that fall on faces, on edges, inside and outside, and directions with zero components.
COORDINATES = st.sampled_from([-5.0, -3, -2, -1, -0.5, 0, 0.25, 1, 1.5, 2, 3, 7])
SLOPES = st.sampled_from([-2.0, -1, -1e-3, -0.0, 0.0, 1e-3, 0.5, 1])
RAYS = st.tuples(st.tuples(*[COORDINATES] * 3), st.tuples(*[SLOPES] * 3))


@given(RAYS)
def test_the_interval_is_exactly_the_part_of_the_ray_in_the_box(ray: tuple) -> None:
    origin, direction = np.array(ray[0]), np.array(ray[1])
    near, far, hit = BOX.intersect(origin, direction)
    if hit:
        assert 0 <= near < far < np.inf
        inside = origin + np.linspace(near, far, 33)[1:-1, None] * direction
        assert BOX.contains(inside).all()
        assert not BOX.contains(origin + far * (1 + 1e-9) * direction + 1e-12 * np.sign(direction))
        assert near == 0 or not BOX.contains(
            origin + near * (1 - 1e-9) * direction - 1e-12 * np.sign(direction)
        )
    else:
        assert np.isnan(near)
        assert np.isnan(far)
        if direction.any():
            t = np.concatenate([np.linspace(0, 20, 2001), np.linspace(0, 20000, 2001)])
            touched = np.unique(
                (origin + t[:, None] * direction)[BOX.contains(origin + t[:, None] * direction)], axis=0
            )
            assert len(touched) <= 1


@pytest.mark.parametrize(
    ("origin", "direction", "near", "far"),
    [
        ((0, 0, -10), (0, 0, 1), 7, 13),
        ((0, 0, -10), (0, 0, 2), 3.5, 6.5),
        ((0, 0, 0), (0, 0, -1), 0, 3),
        ((0, 0, 0), (1, 1, 1), 0, 1),
        ((1, 0, -10), (0, 0, 1), 7, 13),  # in the plane of a face
        ((1, 2, -10), (0, -0.0, 1), 7, 13),  # along an edge
        ((-1, 0, 0), (1, 0, 0), 0, 2),  # starts on a face
    ],
)
def test_rays_that_hit(origin: tuple, direction: tuple, near: float, far: float) -> None:
    assert BOX.intersect(origin, direction) == (near, far, True)


@pytest.mark.parametrize(
    ("origin", "direction"),
    [
        ((1.5, 0, -10), (0, 0, 1)),  # parallel, beside
        ((0, 0, 10), (0, 0, 1)),  # behind the origin
        ((5, 5, 5), (1, -1, 0)),
        ((2, 1, 0), (-1, 1, 0)),  # touches an edge
        ((1, 0, 0), (1, 0, 0)),  # starts on a face and leaves
        ((0, 0, 0), (0, 0, 0)),  # no direction
        ((np.nan, 0, 0), (1, 0, 0)),
        ((0, 0, 0), (np.nan, 1, 0)),
    ],
)
def test_rays_that_miss_are_nan(origin: tuple, direction: tuple) -> None:
    near, far, hit = BOX.intersect(origin, direction)
    assert not hit
    assert np.isnan([near, far]).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torch_runs_the_same_formulas(dtype: torch.dtype) -> None:
    rng = np.random.default_rng(0)
    origins, directions = 4 * rng.normal(size=(500, 3)), rng.normal(size=(500, 3))
    directions[:100, 0] = 0
    expected = BOX.intersect(origins, directions)
    found = BOX.intersect(torch.tensor(origins, dtype=dtype), torch.tensor(directions, dtype=dtype))
    assert found[0].dtype == dtype
    assert 50 < expected[2].sum() < 450
    np.testing.assert_array_equal(found[2], expected[2])
    for i in range(2):
        np.testing.assert_allclose(found[i], expected[i], rtol=1e3 * torch.finfo(dtype).eps)


def test_a_box_knows_its_centre_and_half_sides() -> None:
    box = Box([0, 0, 0], [1, 2, 4])
    assert box.center.tolist() == [0.5, 1, 2]
    assert box.half_sides.tolist() == [0.5, 1, 2]
    assert box.contains([[0.5, 1, 2], [0, 0, 0], [1, 2, 4.1]]).tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("minimum", "maximum", "message"),
    [
        ([0, 0, 0], [1, 0, 1], "maximum: the box is empty along y, from 0.0 to 0.0"),
        ([0, 0, 2], [1, 1, 1], "empty along z"),
        ([0, 0, np.nan], [1, 1, 1], "minimum: .* is not three finite numbers"),
        ([0, 0, 0], [1, 1, np.inf], "maximum: .* is not three finite numbers"),
        ([0, 0], [1, 1], "minimum: .* is not three finite numbers"),
    ],
)
def test_empty_boxes_are_refused(minimum: list, maximum: list, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        Box(minimum, maximum)
