"""Rendering and step functions at the limits: values and derivatives, against 60 digits or float64 walks.

Each case states what is right there. Nothing may become infinite or NaN unless it came in so.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model"))

import model_oracles as oracle

from preface.model import losses, stepfun, volume

DENORMAL = 2.0**-149
AXIS = torch.tensor([[0.0, 0.0, 1.0]])


def weights_of(density: torch.Tensor, tdist: torch.Tensor) -> torch.Tensor:
    return volume.compute_alpha_weights(density, tdist, AXIS)[0]


# Densities and lengths ------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [0.0, DENORMAL, 1e-6, 1.0, 1e3])
@pytest.mark.parametrize("density", [0.0, 1e-38, 1e-10, 1.0, 1e10, 1e38, torch.inf])
def test_weights_and_derivatives_hold_for_every_density_and_length(density: float, length: float) -> None:
    """The extreme interval stands between ordinary ones, which must go on as if it were none or a wall."""
    # The edges start at zero: only there does an interval of 1e-45 exist in float32.
    tdist = torch.tensor([0.0, length, length + 1, length + 3])[None]
    densities = torch.tensor([[density, 0.4, 0.9]], requires_grad=True)
    cost = torch.tensor([0.7, -1.3, 2.1])
    weights = weights_of(densities, tdist)
    (cost * weights).sum().backward()
    expected, gradient = oracle.alpha_weights(densities[0].tolist(), tdist[0].diff().tolist(), cost.tolist())
    np.testing.assert_allclose(weights[0].detach(), expected, rtol=2e-6, atol=1e-37)
    np.testing.assert_allclose(densities.grad[0], gradient, rtol=2e-6, atol=3e-7 * max(length, 1e-37))


@pytest.mark.parametrize("density", [1e38, torch.inf])
def test_a_wall_behind_zero_length_intervals_is_seen_once(density: float) -> None:
    tdist = torch.tensor([[2.0, 2.0, 2.0, 3.0, 3.0, 4.0]])
    weights = weights_of(torch.full((1, 5), density), tdist)
    assert weights.tolist() == [[0.0, 0.0, 1.0, 0.0, 0.0]]


@pytest.mark.parametrize("density", [1e38, torch.inf])
def test_edges_of_a_wall_have_finite_derivatives(density: float) -> None:
    tdist = torch.tensor([[2.0, 2.0, 3.0, 4.0]], requires_grad=True)
    weights_of(torch.tensor([[density, density, 0.5]]), tdist)[0, 1:].sum().backward()
    assert tdist.grad.isfinite().all()


@pytest.mark.parametrize("raw", [-110.0, -104.0, -100.0, -87.0, -14.0, 0.0, 1.0, 11.5, 20.0, 41.0, 110.0])
def test_raw_densities_keep_their_value_and_derivative(raw: float) -> None:
    """Down to where float32 ends, a density of 1e-40 is not zero, and its weight is density times length."""
    tensor = torch.full((16,), raw, requires_grad=True)  # long enough for the vectorised path
    density = volume.density_from_raw(tensor)
    density.sum().backward()
    value, slope = oracle.density(raw)
    np.testing.assert_allclose(density.detach(), np.full(16, value), rtol=3e-7, atol=2 * DENORMAL)
    np.testing.assert_allclose(tensor.grad, np.full(16, slope), rtol=3e-7, atol=2 * DENORMAL)
    tdist = torch.linspace(2, 2.5, 17)[None]
    weights = weights_of(density.detach()[None], tdist)
    expected, _ = oracle.alpha_weights([value] * 16, tdist[0].diff().tolist(), [0.0] * 16)
    np.testing.assert_allclose(weights[0], expected, rtol=1e-4, atol=2 * DENORMAL)


@pytest.mark.parametrize("raw", [-110.0, -14.0, 1.0, 41.0, 110.0])
def test_second_derivatives_of_raw_densities_are_finite(raw: float) -> None:
    tensor = torch.full((4,), raw, requires_grad=True)
    (first,) = torch.autograd.grad(volume.density_from_raw(tensor).sum(), tensor, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), tensor)
    slope = oracle.density(raw)[1]
    np.testing.assert_allclose(
        second, np.full(4, slope * (1 - slope)), rtol=1e-5, atol=2e-7 * (raw > 0) + 1e-44
    )


@pytest.mark.parametrize(
    ("raw", "color"), [(-1e4, -0.001), (1e4, 1.001), (-torch.inf, -0.001), (torch.inf, 1.001)]
)
def test_saturated_colours_stay_at_their_ends_without_gradient(raw: float, color: float) -> None:
    tensor = torch.full((3,), raw, requires_grad=True)
    rgb = volume.color_from_raw(tensor)
    rgb.sum().backward()
    assert rgb.tolist() == pytest.approx([color] * 3, abs=1e-7)
    assert tensor.grad.tolist() == [0.0] * 3


# Opacity and depth ----------------------------------------------------------------------------------------


def test_opacity_never_exceeds_one_nor_the_background_falls_below_none() -> None:
    density = 40 * torch.rand(20_000, 128, generator=torch.Generator().manual_seed(0))
    weights = weights_of(density, torch.linspace(2, 4, 129))
    assert weights.sum(dim=-1).max() > 1  # what the clamp is there for
    assert volume.accumulated_alpha(weights).max() == 1
    shown = volume.composite(weights, torch.zeros(20_000, 128, 1), torch.ones(1))
    assert shown.min() >= 0


@pytest.mark.parametrize("intervals", [1, 2, 128])
def test_an_empty_ray_shows_the_background_and_lies_far_away(intervals: int) -> None:
    tdist = torch.linspace(2, 4, intervals + 1)[None]
    density = torch.zeros(1, intervals, requires_grad=True)
    weights = weights_of(density, tdist)
    assert not weights.any()
    assert volume.accumulated_alpha(weights).item() == 0
    assert volume.composite(weights, torch.ones(1, intervals, 3), 0.25).tolist() == [[0.25] * 3]
    depth = volume.depth_mean(weights, tdist)
    assert depth.item() == pytest.approx(4.0, rel=1e-6)
    assert volume.depth_median(weights, tdist, tdist[:, -1:]).item() == 4.0
    depth.sum().backward()
    assert density.grad.isfinite().all()


@pytest.mark.parametrize("density", [1e10, 1e38, torch.inf])
def test_an_opaque_first_sample_hides_all_others(density: float) -> None:
    tdist = torch.linspace(2, 4, 17)[None]
    densities = torch.full((1, 16), 3.0)
    densities[0, 0] = density
    weights = weights_of(densities, tdist)
    assert weights[0].tolist() == [1.0] + [0.0] * 15
    assert 2 <= volume.depth_median(weights, tdist, tdist[:, -1:]).item() <= 2.125
    assert volume.depth_mean(weights, tdist).item() == pytest.approx(2.0625, rel=1e-6)


@pytest.mark.parametrize(
    ("near", "far"), [(0.0, 0.0), (3.0, 3.0), (0.0, 1.0), (1e-3, 1e3), (1.0, 1e6), (1e8, 1e9)]
)
def test_depth_lies_between_near_and_far(near: float, far: float) -> None:
    tdist = torch.linspace(near, far, 33)[None]
    weights = torch.full((1, 32), 1 / 32)
    middles = np.maximum((tdist[0, 1:] + tdist[0, :-1]).double().numpy() / 2, np.finfo(np.float32).tiny)
    mean = np.clip(np.exp(np.log(middles).mean()), near, far)
    assert volume.depth_mean(weights, tdist).item() == pytest.approx(mean, rel=1e-5)
    median = volume.depth_median(weights, tdist, tdist[:, -1:]).item()
    assert median == pytest.approx((near + far) / 2, rel=1e-5)


# Resampling -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("anneal", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("samples", [1, 2, 24, 256])
def test_an_empty_ray_is_sampled_uniformly_at_every_level(samples: int, anneal: float) -> None:
    """Not at its near end, not in its last interval, not NaN: nothing is known of it yet."""
    t = torch.tensor([[0.0, 0.1, 0.1, 0.7, 1.0]])
    logits = stepfun.resampling_logits(t, torch.zeros(1, 4), anneal)
    drawn = stepfun.sample_intervals(t, logits, samples, domain=(0.0, 1.0))
    torch.testing.assert_close(drawn, torch.linspace(0, 1, samples + 1)[None], rtol=0, atol=1e-6)


def test_an_empty_ray_stays_uniform_through_dilation() -> None:
    t, w = torch.linspace(0, 1, 25)[None], torch.zeros(1, 24)
    edges, weights = stepfun.max_dilate_weights(t, w, 0.02, domain=(0.0, 1.0), renormalize=True)
    assert not weights.any()
    drawn = stepfun.sample_intervals(edges, stepfun.resampling_logits(edges, weights), 16, domain=(0.0, 1.0))
    torch.testing.assert_close(drawn, torch.linspace(0, 1, 17)[None], rtol=0, atol=1e-6)


@pytest.mark.parametrize("anneal", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("place", [0, 11, 23])
def test_a_one_hot_histogram_puts_every_sample_into_its_interval(place: int, anneal: float) -> None:
    t = torch.linspace(0, 1, 25)[None]
    w = torch.zeros(1, 24)
    w[0, place] = 1
    drawn = stepfun.sample_intervals(t, stepfun.resampling_logits(t, w, anneal), 256, domain=(0.0, 1.0))
    expected = torch.linspace(place / 24, (place + 1) / 24, 257)[None]
    torch.testing.assert_close(drawn, expected, rtol=0, atol=1e-6)
    assert (drawn.diff() >= 0).all()


@pytest.mark.parametrize("intervals", [1, 3, 256])
@pytest.mark.parametrize("samples", [1, 2, 128])
def test_an_all_equal_histogram_is_sampled_evenly(intervals: int, samples: int) -> None:
    t = torch.linspace(0, 1, intervals + 1)[None]
    drawn = stepfun.sample_intervals(t, torch.zeros(1, intervals), samples, domain=(0.0, 1.0))
    torch.testing.assert_close(drawn, torch.linspace(0, 1, samples + 1)[None], rtol=0, atol=1e-6)


@pytest.mark.parametrize("samples", [1, 2, 64])
def test_where_near_equals_far_every_edge_lies_there(samples: int) -> None:
    t = torch.full((1, 9), 0.25)
    for w in (torch.zeros(1, 8), torch.full((1, 8), 0.125)):
        drawn = stepfun.sample_intervals(t, stepfun.resampling_logits(t, w), samples, domain=(0.0, 1.0))
        assert drawn.tolist() == [[0.25] * (samples + 1)]


@pytest.mark.parametrize("exponent", [-38, -20, -8, -3])
def test_weights_of_many_magnitudes_are_resampled_as_in_float64(exponent: int) -> None:
    rng = np.random.default_rng(-exponent)
    w = torch.tensor(10.0 ** rng.uniform(exponent, 0, (1, 64)), dtype=torch.float32)
    t = torch.linspace(0, 1, 65)[None]
    drawn = stepfun.sample_intervals(t, stepfun.resampling_logits(t, w), 48, domain=(0.0, 1.0))
    expected = oracle.intervals(t[0].double().numpy(), w[0].double().numpy(), 48, (0.0, 1.0))
    np.testing.assert_allclose(drawn[0], expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("jitter", [0.0, 0.5, 1 - 2.0**-24])
def test_jitter_keeps_to_intervals_that_have_mass(jitter: float) -> None:
    """Also at the last float below one, which sums of float32 weights often do not reach."""
    t = torch.linspace(0, 1, 201).expand(64, -1)
    w = torch.rand(64, 200, generator=torch.Generator().manual_seed(9))
    w[:, :5] = w[:, 105:] = 0
    u = ((torch.arange(512) + jitter) / 512).clamp_max(1 - 2.0**-24).expand(64, -1)
    drawn = stepfun.invert_cdf(u, t, w.log())
    assert drawn.min() >= t[0, 5]
    assert drawn.max() <= t[0, 105]
    assert (drawn.diff() >= 0).all()


def test_256_intervals_in_bfloat16_surroundings_keep_257_distinct_edges() -> None:
    t = torch.tensor([[2.0, 4.0]], dtype=torch.bfloat16)
    drawn = stepfun.sample_intervals(t, torch.zeros(1, 1, dtype=torch.bfloat16), 256)
    assert drawn.dtype == torch.float32
    assert drawn.unique().numel() == 257


@pytest.mark.parametrize("anneal", [0.0, 0.3, 1.0])
def test_resampling_has_finite_derivatives_at_zero_weights(anneal: float) -> None:
    t = torch.linspace(0, 1, 9)[None].requires_grad_()
    w = torch.tensor([[0.0, 0, 1, 0, 0, 1e-38, 0.5, 0]], requires_grad=True)
    stepfun.sample_intervals(t, stepfun.resampling_logits(t, w, anneal), 8).square().sum().backward()
    assert t.grad.isfinite().all()
    assert w.grad[w > 1e-30].isfinite().all()
    assert not w.grad[w == 0].any()


@pytest.mark.parametrize("bad", [torch.nan, -0.5])
def test_a_weight_that_is_none_is_seen_in_its_ray_and_in_no_other(bad: float) -> None:
    t = torch.linspace(0, 1, 9).expand(3, -1)
    w = torch.ones(3, 8)
    w[1, 4] = bad
    drawn = stepfun.sample_intervals(t, stepfun.resampling_logits(t, w), 8, domain=(0.0, 1.0))
    assert drawn[1].isnan().any()
    assert drawn[[0, 2]].isfinite().all()


@pytest.mark.parametrize("bad", [[0.0, 0.6, 0.5, 1.0], [0.0, torch.nan, 0.5, 1.0], [1.0, 0.7, 0.3, 0.0]])
@pytest.mark.parametrize("function", ["resampling", "dilation", "interlevel", "envelope"])
def test_unsorted_edges_are_refused_by_name_and_place(function: str, bad: list[float]) -> None:
    t, good, w = (
        torch.tensor([[0.0, 0.1, 0.2, 0.3], bad]),
        torch.linspace(0, 1, 4).expand(2, -1),
        torch.ones(2, 3),
    )
    calls = {
        "resampling": lambda: stepfun.sample_intervals(t, w, 4),
        "dilation": lambda: stepfun.max_dilate_weights(t, w, 0.1),
        "interlevel": lambda: stepfun.lossfun_outer(t, w, good, w),
        "envelope": lambda: stepfun.lossfun_outer(good, w, t, w),
    }
    with pytest.raises(ValueError, match=r"t(_env)?: edges must ascend, but .* at \(1, [01]\)"):
        calls[function]()


# Dilation and the interlevel loss -------------------------------------------------------------------------


@pytest.mark.parametrize("width", [0.0, DENORMAL, 1e-30, 1e-12, 1e-3])
@pytest.mark.parametrize("dilation", [0.0, 0.0025, 0.5])
def test_dilation_of_narrow_spikes_equals_the_definition(width: float, dilation: float) -> None:
    t = torch.tensor([[0.0, width, 0.25, 0.5, 0.5, 1.0]])
    w = torch.tensor([[0.9 if width else 0.0, 0.05, 1e-30, 0.0, 0.05]], requires_grad=True)
    edges, weights = stepfun.max_dilate_weights(t, w, dilation, domain=(0.0, 1.0))
    # The same places in both: float64 edges would fall between those of float32.
    dilation32 = float(torch.tensor(dilation))
    expected_edges, expected = oracle.dilated(
        t[0].double().numpy(), w[0].detach().double().numpy(), dilation32, (0, 1)
    )
    np.testing.assert_allclose(edges[0], expected_edges, rtol=0, atol=6e-8)
    largest = expected.max()
    np.testing.assert_allclose(weights[0].detach().sum(), expected.sum(), rtol=1e-4, atol=1e-6 * largest)
    weights.sum().backward()
    assert w.grad.isfinite().all()
    _, renormalised = stepfun.max_dilate_weights(t, w, dilation, domain=(0.0, 1.0), renormalize=True)
    assert float(renormalised.detach().sum()) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("exponent", [-100, -44, -20, 0])
def test_interlevel_loss_and_its_pull_on_the_envelope_are_finite_for_all_weights(exponent: int) -> None:
    """d loss / d envelope = -2 excess / (w + eps), between -2 and 0: constant where the envelope is nothing."""
    w = torch.full((1, 16), float(np.exp(exponent)) / 16)
    t = torch.linspace(0, 1, 17)[None]
    t_env = torch.linspace(0, 1, 5)[None]
    w_env = torch.zeros(1, 4, requires_grad=True)
    loss = stepfun.lossfun_outer(t, w, t_env, w_env)
    expected = oracle.outer_loss(t[0], w[0].double(), t_env[0], [0.0] * 4, 2.0**-23)
    np.testing.assert_allclose(loss[0].detach(), expected, rtol=1e-5, atol=1e-44)
    loss.sum().backward()
    assert w_env.grad.isfinite().all()
    assert (w_env.grad <= 0).all()
    assert (
        w_env.grad.min() >= -2 * 5 * 1.0001
    )  # four intervals lie in each of the envelope's, one more touches


@pytest.mark.parametrize("place", [0, 7, 15])
def test_interlevel_loss_of_an_opaque_sample_under_an_empty_proposal(place: int) -> None:
    w = torch.zeros(1, 16)
    w[0, place] = 1
    sdist = torch.linspace(0, 1, 17)[None]
    w_env = torch.zeros(1, 16, requires_grad=True)
    loss = losses.interlevel(sdist, w, [(sdist, w_env)])
    loss.backward()
    assert loss.item() == pytest.approx(1 / 16, rel=1e-6)
    assert w_env.grad[0, place].item() == pytest.approx(-2 / 16, rel=1e-6)
    assert w_env.grad.isfinite().all()
