"""Strands and the ribbons that stand for them."""

import numpy as np

from synthetic_studio.strands import Strands, concatenate, resample, ribbons


def straight(count: int = 3, points: int = 5, width: float = 0.001) -> Strands:
    """Strands along y, roots on the x axis, on a skin that faces z."""
    roots = np.arange(count)[:, None, None] * np.array([0.01, 0.0, 0.0])
    along = np.linspace(0.0, 0.1, points)[None, :, None] * np.array([0.0, 1.0, 0.0])
    outward = np.tile([0.0, 0.0, 1.0], (count, 1))
    return Strands(
        roots + along, outward, np.full(count, width), np.full((count, 3), 0.5), np.ones((count, points))
    )


def test_ribbons_lie_flat_on_the_skin_with_the_strands_width_at_the_root():
    strands = straight()
    vertices, triangles = ribbons(strands)
    assert vertices.shape == (3 * 5 * 2, 3)
    assert triangles.shape == (3 * 4 * 2, 3)
    pairs = vertices.reshape(3, 5, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(pairs[:, 0, 1] - pairs[:, 0, 0], axis=-1), 0.001)
    np.testing.assert_allclose(pairs.mean(axis=2), strands.points, atol=1e-15)
    assert np.ptp(vertices[:, 2]) == 0.0


def test_ribbons_taper_towards_the_tip():
    pairs = ribbons(straight())[0].reshape(3, 5, 2, 3)
    width = np.linalg.norm(pairs[:, :, 1] - pairs[:, :, 0], axis=-1)
    assert (np.diff(width, axis=1) <= 1e-15).all()
    assert (width[:, -1] < 0.5 * width[:, 0]).all()


def test_no_triangle_joins_two_strands():
    _, triangles = ribbons(straight(count=4, points=6))
    assert (np.ptp(triangles // (6 * 2), axis=1) == 0).all()


def test_resampling_keeps_ends_and_reproduces_cubics():
    t = np.linspace(0.0, 1.0, 9)
    curve = np.stack([t, t**2, t**3], axis=-1)[None]
    fine = resample(curve, 25)
    s = np.linspace(0.0, 1.0, 25)
    np.testing.assert_allclose(fine[0], np.stack([s, s**2, s**3], axis=-1), atol=1e-12)


def test_concatenation_keeps_every_strand_in_order():
    both = concatenate([straight(2), straight(3, width=0.002)])
    assert len(both) == 5
    assert both.width.tolist() == [0.001] * 2 + [0.002] * 3
