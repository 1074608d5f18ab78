"""Step functions against walks and loops over their definitions, on random histograms."""

import model_oracles as oracle
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from preface.model import stepfun


def histogram(seed: int, intervals: int, zeros: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Edges in [0, 1] and weights that sum to one, of one ray; a share of the weights is zero."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, 1, intervals + 1))
    w = rng.exponential(size=intervals) ** 3 * (rng.uniform(size=intervals) >= zeros)
    w[rng.integers(intervals)] += 0.1
    return torch.tensor(t[None]), torch.tensor(w[None] / w.sum())


@given(st.integers(0, 10**6), st.integers(1, 40), st.integers(2, 70), st.sampled_from([0.0, 0.6]))
@settings(max_examples=60, deadline=None)
def test_resampling_equals_a_walk_along_the_mass(seed: int, n: int, samples: int, zeros: float) -> None:
    t, w = histogram(seed, n, zeros)
    drawn = stepfun.sample_intervals(t, stepfun.resampling_logits(t, w), samples, domain=(0.0, 1.0))
    expected = oracle.intervals(t[0].numpy(), w[0].numpy(), samples, (0.0, 1.0))
    np.testing.assert_allclose(drawn[0], expected, rtol=0, atol=1e-9)


@given(st.integers(0, 10**6), st.integers(1, 70), st.floats(0, 0.3), st.sampled_from([0.0, 0.6]))
@settings(max_examples=60, deadline=None)
def test_dilation_equals_comparing_all_with_all(seed: int, n: int, dilation: float, zeros: float) -> None:
    t, w = histogram(seed, n, zeros)
    edges, weights = stepfun.max_dilate_weights(t, w, dilation, domain=(0.0, 1.0))
    expected_edges, expected_weights = oracle.dilated(t[0].numpy(), w[0].numpy(), dilation, (0.0, 1.0))
    np.testing.assert_array_equal(edges[0], expected_edges)
    np.testing.assert_allclose(weights[0], expected_weights, rtol=1e-12, atol=0)


@given(st.integers(0, 10**6), st.integers(1, 30), st.integers(1, 30))
@settings(max_examples=60, deadline=None)
def test_interlevel_loss_equals_collecting_overlaps(seed: int, n: int, m: int) -> None:
    (t, w), (t_env, w_env) = histogram(seed, n), histogram(seed + 1, m, zeros=0.3)
    loss = stepfun.lossfun_outer(t, w, t_env, w_env, eps=1e-7)
    expected = oracle.outer_loss(t[0], w[0], t_env[0], w_env[0], 1e-7)
    np.testing.assert_allclose(loss[0], expected, rtol=1e-9, atol=1e-15)


def test_dilation_bounds_every_weight_it_was_given() -> None:
    t, w = histogram(5, 32)
    edges, weights = stepfun.max_dilate_weights(t, w, 0.02)
    torch.testing.assert_close(stepfun.lossfun_outer(t, w, edges, weights), torch.zeros_like(w))


def test_dilation_renormalised_sums_to_one() -> None:
    t, w = histogram(6, 32)
    _, weights = stepfun.max_dilate_weights(t, w, 0.1, domain=(0.0, 1.0), renormalize=True)
    torch.testing.assert_close(weights.sum(dim=-1), torch.ones(1, dtype=torch.float64))


def test_a_histogram_bounds_itself() -> None:
    t, w = histogram(7, 20)
    torch.testing.assert_close(stepfun.lossfun_outer(t, w, t, w), torch.zeros_like(w), rtol=0, atol=1e-24)


def test_one_jitter_per_ray_shifts_all_shares_alike() -> None:
    t, w = torch.tensor([[0.0, 1.0]]), torch.zeros(1, 1)
    middle = stepfun.sample_intervals(t, w, 8)
    shifted = stepfun.sample_intervals(t, w, 8, jitter=torch.tensor([[0.75]]))
    torch.testing.assert_close(shifted, middle + 0.25 / 8)


def test_jittered_points_fall_as_often_as_the_weights_say() -> None:
    t, w = torch.tensor([0.0, 0.2, 0.5, 1.0]), torch.tensor([0.5, 0.1, 0.4])
    jitter = torch.rand(20_000, 8, generator=torch.Generator().manual_seed(2))
    u = (torch.arange(8) + jitter) / 8
    points = stepfun.invert_cdf(u, t.expand(20_000, -1), w.log().expand(20_000, -1))
    counts = torch.histogram(points.flatten(), bins=t).hist / points.numel()
    torch.testing.assert_close(counts, w, rtol=0, atol=3e-3)


@pytest.mark.parametrize(("train_frac", "exponent"), [(0.0, 0.0), (0.3, 3 / 3.7), (1.0, 1.0)])
def test_annealing_is_schlick_s_bias(train_frac: float, exponent: float) -> None:
    assert stepfun.anneal_exponent(train_frac) == pytest.approx(exponent, abs=1e-15)
    assert stepfun.anneal_exponent(train_frac, slope=0) == 1.0


def test_annealing_flattens_the_histogram() -> None:
    t, w = torch.linspace(0, 1, 5)[None], torch.tensor([[0.7, 0.1, 0.1, 0.1]])
    shares = [torch.softmax(stepfun.resampling_logits(t, w, a), -1)[0, 0].item() for a in (0.0, 0.3, 1.0)]
    assert shares == pytest.approx([0.25, 0.7**0.3 / (0.7**0.3 + 3 * 0.1**0.3), 0.7], abs=1e-6)


def test_no_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="num_samples: 0"):
        stepfun.sample_intervals(torch.tensor([0.0, 1.0]), torch.zeros(1), 0)
