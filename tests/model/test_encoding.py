"""Derivatives by position that are read off the encoding, against automatic differentiation in float64."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from preface.model import coord, encoding

BASIS = coord.icosahedron_basis(torch.float64)


def encoded_at(positions: torch.Tensor, variance: float, levels: int) -> torch.Tensor:
    """The encoding [p, 42 levels] of positions [p, 3] with one variance along every direction."""
    mean = positions @ BASIS
    return coord.integrated_pos_enc(mean, torch.full_like(mean, variance), 0, levels)


def some_function(generator: torch.Generator, features: int) -> torch.nn.Module:
    """A network from encodings to a number whose second derivatives by its weights are not zero."""
    network = torch.nn.Sequential(
        torch.nn.Linear(features, 7), torch.nn.Tanh(), torch.nn.Linear(7, 1)
    ).double()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64) / 3)
    return network


@given(
    seed=st.integers(0, 10_000),
    levels=st.integers(0, 12),
    variance=st.floats(0.0, 10.0),
    count=st.integers(0, 5),
)
def test_the_slope_in_space_and_its_derivatives_are_those_of_the_encoding(seed, levels, variance, count):
    generator = torch.Generator().manual_seed(seed)
    positions = torch.randn(count, 3, generator=generator, dtype=torch.float64).requires_grad_()
    network = some_function(generator, 42 * levels)
    expected = torch.autograd.grad(
        network(encoded_at(positions, variance, levels)).sum(), positions, create_graph=True
    )[0]
    encoded = encoded_at(positions.detach(), variance, levels).requires_grad_()
    (slope,) = torch.autograd.grad(network(encoded).sum(), encoded, create_graph=True)
    found = encoding.slope_in_space(encoded.detach(), slope, BASIS, levels)
    assert torch.allclose(found, expected, rtol=1e-10, atol=1e-10 * 2**levels)
    weights = list(network.parameters())[:1]
    ours = torch.autograd.grad(found.square().sum(), weights)
    theirs = torch.autograd.grad(expected.square().sum(), weights)
    assert torch.allclose(ours[0], theirs[0], rtol=1e-9, atol=1e-9 * 4**levels)


def test_slopes_reach_positions_through_an_encoding_that_moves():
    generator = torch.Generator().manual_seed(1)
    positions = torch.randn(4, 3, generator=generator, dtype=torch.float64).requires_grad_()
    network = some_function(generator, 42 * 3)
    encoded = encoded_at(positions, 0.01, 3)
    value = network(encoded).sum()
    (direct,) = torch.autograd.grad(value, positions, create_graph=True)
    (slope,) = torch.autograd.grad(value, encoded, create_graph=True)
    found = encoding.slope_in_space(encoded, slope, BASIS, 3)
    (ours,) = torch.autograd.grad(found[:, 0].sum(), positions, retain_graph=True)
    (theirs,) = torch.autograd.grad(direct[:, 0].sum(), positions)
    assert torch.allclose(ours, theirs, rtol=1e-9, atol=1e-9)
