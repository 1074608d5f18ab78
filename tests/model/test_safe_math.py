"""The named operations on their stated domains."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from preface.model import safe_math


@given(st.integers(0, 10**6), st.integers(2, 40))
@settings(max_examples=50, deadline=None)
def test_interpolation_is_numpy_s_row_by_row(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    xp, fp = np.sort(rng.uniform(0, 1, (3, n))), np.sort(rng.uniform(-5, 5, (3, n)))
    x = rng.uniform(-0.2, 1.2, (3, 17))
    got = safe_math.interpolate_sorted(*(torch.tensor(a) for a in (x, xp, fp)))
    np.testing.assert_allclose(got, [np.interp(*rows) for rows in zip(x, xp, fp, strict=True)], atol=1e-12)


def test_interpolation_never_passes_the_end_of_an_interval() -> None:
    """A rounding past it would put a sample before the one that follows."""
    rng = np.random.default_rng(0)
    xp, fp = (torch.tensor(np.sort(rng.uniform(0, 1, (2000, 3))), dtype=torch.float32) for _ in range(2))
    just_before = torch.nextafter(xp[:, 1:2], torch.tensor(0.0))
    at = xp[:, 1:2]
    before, after = (safe_math.interpolate_sorted(x, xp, fp) for x in (just_before, at))
    assert (before <= fp[:, 1:2]).all()
    assert torch.equal(after, fp[:, 1:2])


def test_interpolation_takes_the_value_after_a_jump() -> None:
    table = torch.tensor([0.0, 0.5, 0.5, 0.5, 1.0]), torch.tensor([0.0, 1.0, 2.0, 3.0, 4.0])
    assert safe_math.interpolate_sorted(torch.tensor([0.5]), *table).item() == 3.0


def test_enclosing_indices_outside_the_edges_are_the_ends() -> None:
    edges = torch.tensor([0.0, 1.0, 2.0])
    low, high = safe_math.enclosing_indices(edges, torch.tensor([-1.0, 0.0, 1.5, 2.0, 3.0]))
    assert low.tolist() == [0, 0, 1, 2, 2]
    assert high.tolist() == [0, 1, 2, 2, 2]


def test_log_of_weight_has_no_infinite_derivative() -> None:
    weights = torch.tensor([0.0, 0.5, 1.0], requires_grad=True)
    logs = safe_math.log_of_weight(weights)
    assert logs.tolist() == [-np.inf, np.float32(np.log(0.5)), 0.0]
    torch.exp(logs).sum().backward()
    assert weights.grad.tolist() == [0.0, 1.0, 1.0]


def test_normalize_has_the_first_and_second_derivatives_of_its_definition() -> None:
    vectors = torch.tensor([[3.0, -4, 12], [1e-5, 2e-5, 0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(safe_math.normalize, vectors, eps=1e-8)
    assert torch.autograd.gradgradcheck(safe_math.normalize, vectors, eps=1e-8)
