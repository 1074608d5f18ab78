"""Samples encoded by themselves against the definition of the encoding in float64."""

import torch

from preface.model import coord
from preface.model.rays import Rays
from preface.model.rendering.samples import encode_points, encode_samples

LEVELS = 10


def some_rays(count: int) -> Rays:
    torch.manual_seed(3)
    origins = torch.randn(count, 3) * 2
    directions = torch.randn(count, 3)
    near = torch.rand(count, 1)
    viewdirs = directions / directions.norm(dim=-1, keepdim=True)
    return Rays(origins, directions, viewdirs, torch.full((count, 1), 2e-3), near, near + 1.5)


def test_chosen_samples_are_encoded_as_all_would_be():
    rays, basis = some_rays(40), coord.icosahedron_basis()
    tdist = rays.near + torch.sort(torch.rand(40, 8))[0] * 1.5
    chosen = torch.randperm(40 * 7)[:100]
    exact = (x.double() for x in (rays.origins, rays.directions, tdist, rays.radii, basis))
    mean, variance = coord.project_frustums(*exact)
    wanted = coord.integrated_pos_enc(mean, variance, 0, LEVELS).flatten(0, 1)[chosen]
    found = encode_samples(rays, tdist, chosen, basis, LEVELS)
    torch.testing.assert_close(found.double(), wanted, atol=1e-4, rtol=0)
    assert encode_samples(rays, tdist, chosen[:0], basis, LEVELS).shape == (0, 2 * LEVELS * 21)


def test_points_are_gaussians_of_one_variance():
    points, basis = torch.rand(30, 3) * 2 - 1, coord.icosahedron_basis()
    covariance = 1e-4 * torch.eye(3, dtype=torch.float64).expand(30, 1, 3, 3)
    mean, variance = coord.lift_and_diagonalize(points.double()[:, None], covariance, basis.double())
    wanted = coord.integrated_pos_enc(mean, variance, 0, LEVELS)[:, 0]
    torch.testing.assert_close(encode_points(points, 1e-4, basis, LEVELS).double(), wanted, atol=1e-4, rtol=0)
