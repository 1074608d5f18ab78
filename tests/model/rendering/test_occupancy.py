"""The grid against brute force: what it calls empty is empty, and its bounds bound the weights of rays."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from preface.geometry import Box
from preface.model.rays import Rays
from preface.model.rendering.image import Space
from preface.model.rendering.occupancy import learn_occupancy

SPACE = Space(Box(np.array([-0.2, -0.25, -0.15]), np.array([0.2, 0.25, 0.15])), 4.0)
CUBES = 20
SIDE = 0.5 * 4.0 / CUBES


def blobs(centers, peaks, width):
    """Balls of density without an edge: Gaussians [n] at centers [n, 3] with a width in scene units."""

    def density(points):
        squared = ((points[:, None].double() - centers) ** 2).sum(-1)
        return (peaks * torch.exp(-squared / (2 * width**2))).sum(-1).float()

    return density


def some_rays(count, seed, center=None):
    """Rays from around the box, or from a point, to places in it."""
    rng = np.random.default_rng(seed)
    toward = rng.uniform(SPACE.box.minimum, SPACE.box.maximum, (count, 3))
    origins = rng.normal(size=(count, 3)) if center is None else np.broadcast_to(center, (count, 3)).copy()
    directions = (toward - origins) * rng.uniform(0.5, 2, (count, 1))
    near, far, hit = SPACE.box.intersect(origins, directions)
    assert hit.all()
    values = [origins * 4, directions, directions / np.linalg.norm(directions, axis=1, keepdims=True)]
    # t times the direction is in scene units, so that directions stay while t grows with the scene.
    values += [np.full((count, 1), 1e-3), near[:, None] * 4, far[:, None] * 4]
    return Rays(*(torch.from_numpy(v.astype(np.float32)) for v in values))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**20),
    count=st.integers(1, 4),
    peak=st.floats(0.01, 1e4),
    threshold=st.sampled_from([0.0, 0.01, 0.2]),
)
def test_no_place_with_the_stated_alpha_is_dropped(seed, count, peak, threshold):
    rng = np.random.default_rng(seed)
    low, high = SPACE.box.minimum * 4, SPACE.box.maximum * 4
    centers = torch.from_numpy(rng.uniform(low, high, (count, 3)))
    density = blobs(centers, torch.from_numpy(rng.uniform(0.1, 1, count) * peak), 1.2 * SIDE)
    grid = learn_occupancy(density, SPACE, CUBES, threshold)
    points = torch.from_numpy(rng.uniform(low, high, (20_000, 3))).float()
    alpha = 1 - np.exp(-density(points).double().numpy() * math.sqrt(3) * SIDE)
    place = np.minimum(((points.numpy() - low) / SIDE).astype(int), np.array(grid.occupied.shape) - 1)
    dropped = ~grid.occupied.numpy()[tuple(place.T)]
    assert not (dropped & (alpha > threshold + 1e-6)).any()


@pytest.mark.parametrize("center", [None, [0.0, 0.0, 0.05]])
def test_pieces_outside_occupied_cubes_touch_no_matter_and_bounds_hold(center):
    centers = torch.tensor([[0.2, 0.3, 0.1], [-0.3, -0.5, -0.2]], dtype=torch.float64)
    density = blobs(centers, torch.tensor([300.0, 8.0], dtype=torch.float64), 1.5 * SIDE)
    grid = learn_occupancy(density, SPACE, CUBES, 0.02)
    assert 0.05 < grid.share < 0.9
    rays = some_rays(300, 3, center)
    cubes = grid.cubes(rays)
    occupied, bounds = grid.meets(cubes), grid.weight_bounds(rays, cubes)
    # Brute force: 20 densities per piece, in float64.
    fine = torch.arange(20 * grid.steps + 1, dtype=torch.float64) / (20 * grid.steps)
    t = rays.near.double() + (fine[1:] + fine[:-1]) / 2 * (rays.far - rays.near).double()
    points = rays.origins.double()[:, None] + t[..., None] * rays.directions.double()[:, None]
    found = density(points.reshape(-1, 3).float()).double().view(t.shape)
    length = (
        (rays.far - rays.near).double() / t.shape[1] * rays.directions.double().norm(dim=-1, keepdim=True)
    )
    alpha = -torch.expm1(-found * math.sqrt(3) * SIDE).view(300, grid.steps, 20).amax(-1)
    assert (alpha[~occupied] <= 0.02).all()
    before = torch.cumsum(found * length, dim=1) - found * length
    weights = (-torch.expm1(-found * length) * torch.exp(-before)).view(300, grid.steps, 20).sum(-1)
    # A bound by corners: a blob's middle between corners may exceed it by what its curvature allows.
    assert (weights[occupied] <= 1.35 * bounds[occupied] + 1e-3).all()
    assert (bounds[~occupied] == 0).all()


def test_grazing_an_edge_hides_nothing_of_what_is_behind():
    def density(points):  # a dense half space below a plane that cuts cubes in half, and a wall behind
        return torch.where((points[:, 1] < 0.05 * SIDE) & (points[:, 2] > 0), 1e3, 0.0) + torch.where(
            points[:, 2] < -0.3, 50.0, 0.0
        )

    grid = learn_occupancy(density, SPACE, CUBES, 0.01)
    height = 0.5 * SIDE  # above the plane, within the cubes that it cuts
    rays = Rays(
        torch.tensor([[0.05, height, 2.0]]),
        torch.tensor([[0.0, 0.0, -1.0]]),
        torch.tensor([[0.0, 0.0, -1.0]]),
        torch.tensor([[1e-3]]),
        torch.tensor([[1.4]]),
        torch.tensor([[2.6]]),
    )
    bounds = grid.weight_bounds(rays, grid.cubes(rays))[0]
    t = 1.4 + 1.2 * (torch.arange(grid.steps) + 0.5) / grid.steps
    assert bounds[t > 2.3].sum() > 0.9


@pytest.mark.parametrize(("value", "share"), [(0.0, 0.0), (1e9, 1.0)])
def test_an_empty_model_has_no_occupied_cube_and_a_full_one_no_other(value, share):
    grid = learn_occupancy(lambda points: torch.full((len(points),), value), SPACE, 7, 0.01)
    assert grid.share == share


def test_what_cannot_be_a_grid_is_refused():
    for cubes, alpha in ((0, 0.1), (4, 1.0), (4, -0.1)):
        with pytest.raises(ValueError, match="occupancy"):
            learn_occupancy(lambda points: points[:, 0], SPACE, cubes, alpha)
