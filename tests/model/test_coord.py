"""Frustums, projection and encodings, against integrals and matrices at 60 digits."""

import model_oracles as oracle
import numpy as np
import pytest
import torch

from preface.model import coord


@pytest.fixture
def rays() -> tuple[torch.Tensor, ...]:
    """Five cones that pass the origin at a distance of about 3, in 6 intervals each."""
    generator = torch.Generator().manual_seed(3)
    origins = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator), dim=-1) * 3
    directions = -origins / 3 + 0.2 * torch.randn(5, 3, generator=generator)
    tdist = torch.sort(2 + 2 * torch.rand(5, 7, generator=generator)).values
    return origins, directions, tdist, torch.full((5, 1), 2e-3)


def test_basis_is_unit_isotropic_and_without_opposites() -> None:
    basis = coord.icosahedron_basis(torch.float64)
    cosines = basis.T @ basis
    assert basis.shape == (3, 21)
    torch.testing.assert_close(cosines.diagonal(), torch.ones(21, dtype=torch.float64), rtol=0, atol=1e-15)
    torch.testing.assert_close(basis @ basis.T, 7 * torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-13)
    assert (
        float((cosines - torch.eye(21)).abs().max()) < 0.86
    )  # the nearest neighbours are 31.7 degrees apart


def test_projection_without_covariances_equals_the_definition(rays) -> None:
    origins, directions, tdist, radii = rays
    basis = coord.icosahedron_basis()
    mean, var = coord.project_frustums(origins, directions, tdist, radii, basis)
    for i in range(5):
        for j in range(6):
            true_mean, true_var = oracle.projected_gaussian(
                origins[i], directions[i], tdist[i, j], tdist[i, j + 1], radii[i, 0], basis
            )
            np.testing.assert_allclose(mean[i, j], true_mean, rtol=0, atol=6e-7)
            np.testing.assert_allclose(var[i, j], true_var, rtol=1e-5, atol=1e-13)


def test_projection_without_covariances_has_the_derivatives_of_the_two_step_route(rays) -> None:
    origins, directions, tdist, radii = (x.double().requires_grad_() for x in rays)
    basis = coord.icosahedron_basis(torch.float64)
    mean, cov = coord.conical_frustum_to_gaussian(directions, tdist[:, :-1], tdist[:, 1:], radii)
    two_step = coord.lift_and_diagonalize(mean + origins[:, None], cov, basis)
    one_step = coord.project_frustums(origins, directions, tdist, radii, basis)
    cost = torch.linspace(-1, 1, 5 * 6 * 21, dtype=torch.float64).reshape(5, 6, 21)
    for ours, reference in zip(one_step, two_step, strict=True):
        inputs = [directions, tdist]
        got = torch.autograd.grad((cost * ours).sum(), inputs, retain_graph=True)
        want = torch.autograd.grad((cost * reference).sum(), inputs, retain_graph=True)
        for a, b in zip(got, want, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


def test_diagonal_of_the_covariance(rays) -> None:
    _, directions, tdist, radii = rays
    arguments = directions, tdist[:, :-1], tdist[:, 1:], radii
    _, cov = coord.conical_frustum_to_gaussian(*arguments)
    _, diagonal = coord.conical_frustum_to_gaussian(*arguments, diag=True)
    torch.testing.assert_close(diagonal, cov.diagonal(dim1=-2, dim2=-1), rtol=1e-5, atol=1e-12)


def test_encoding_is_ordered_by_wave_then_level_then_direction() -> None:
    x, var = torch.tensor([[0.3, -1.1]]), torch.tensor([[0.01, 0.2]])
    encoded = coord.integrated_pos_enc(x, var, 1, 4)[0]
    waves = [
        [oracle.expected_waves(float(x[0, b]), float(var[0, b]), k) for b in range(2)] for k in (1, 2, 3)
    ]
    expected = [waves[k][b][wave] for wave in range(2) for k in range(3) for b in range(2)]
    np.testing.assert_allclose(encoded, expected, rtol=0, atol=1e-6)


def test_encoding_of_a_gaussian_is_the_mean_over_its_samples() -> None:
    generator = torch.Generator().manual_seed(1)
    samples = 0.7 + 0.3 * torch.randn(400_000, 1, generator=generator)
    sampled = coord.pos_enc(samples, 0, 4, append_identity=False).mean(dim=0)
    encoded = coord.integrated_pos_enc(torch.tensor([0.7]), torch.tensor([0.09]), 0, 4)
    torch.testing.assert_close(encoded, sampled, rtol=0, atol=5e-3)


def test_direction_encoding_puts_the_direction_first() -> None:
    x = torch.tensor([[0.6, 0.0, 0.8]])
    encoded = coord.pos_enc(x, 0, 4)
    assert encoded.shape == (1, 27)
    torch.testing.assert_close(encoded[:, :3], x, rtol=0, atol=0)
    torch.testing.assert_close(encoded[:, 3:], coord.pos_enc(x, 0, 4, append_identity=False), rtol=0, atol=0)


def test_no_levels_encode_nothing() -> None:
    assert coord.integrated_pos_enc(torch.ones(2, 21), torch.ones(2, 21), 3, 3).shape == (2, 0)


@pytest.mark.parametrize("basis", [torch.ones(21, 3), torch.ones(2, 21)])
def test_a_transposed_basis_is_refused(basis: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=r"\[3, directions\]"):
        coord.lift_and_diagonalize(torch.ones(4, 3), torch.ones(4, 3, 3), basis)


@pytest.mark.parametrize("levels", [(4, 2), (-1, 3)])
def test_levels_in_the_wrong_order_or_below_zero_are_refused(levels: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="min_deg: levels from"):
        coord.integrated_pos_enc(torch.ones(1), torch.ones(1), *levels)
