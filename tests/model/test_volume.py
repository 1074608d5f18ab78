"""Volume rendering against closed forms and derivatives by hand."""

import model_oracles as oracle
import numpy as np
import torch

from preface.model import volume


def test_uniform_fog_attenuates_exponentially() -> None:
    tdist = torch.linspace(1, 3, 65)[None]
    weights, _, trans = volume.compute_alpha_weights(
        torch.full((1, 64), 0.7), tdist, torch.tensor([[0.0, 0.0, 2.0]])
    )
    torch.testing.assert_close(trans, torch.exp(-1.4 * (tdist[:, :-1] - 1)), rtol=1e-5, atol=0)
    torch.testing.assert_close(weights.sum(), 1 - torch.exp(torch.tensor(-2.8)))


def test_weights_and_their_derivatives_equal_the_definition() -> None:
    generator = torch.Generator().manual_seed(0)
    density = (8 * torch.rand(12, generator=generator)).requires_grad_()
    tdist, cost = torch.linspace(0, 2, 13), torch.randn(12, generator=generator)
    weights, alpha, trans = volume.compute_alpha_weights(density, tdist, torch.tensor([1.0, 0, 0]))
    (cost * weights).sum().backward()
    expected, gradient = oracle.alpha_weights(density.tolist(), tdist.diff().tolist(), cost.tolist())
    np.testing.assert_allclose(weights.detach(), expected, rtol=3e-6, atol=1e-12)
    np.testing.assert_allclose(density.grad, gradient, rtol=0, atol=1e-7)
    torch.testing.assert_close(weights, alpha * trans)


def test_what_is_not_met_shows_the_background() -> None:
    weights = torch.tensor([[0.25, 0.5], [0.0, 0.0], [0.0, 1.0]])
    colors = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]).expand(3, 2, 3)
    over_blue = volume.composite(weights, colors, torch.tensor([0.0, 0, 1]))
    expected = torch.tensor([[0.25, 0.5, 0.25], [0, 0, 1], [0, 1, 0]])
    torch.testing.assert_close(over_blue, expected)
    torch.testing.assert_close(volume.composite(weights, colors)[:, 2], torch.zeros(3))


def test_depth_of_a_thin_wall_is_where_it_stands() -> None:
    tdist = torch.linspace(2, 4, 201)[None]
    density = torch.where((tdist[:, :-1] > 2.995) & (tdist[:, :-1] < 3.005), 1e6, 0.0)
    weights = volume.compute_alpha_weights(density, tdist, torch.tensor([[0.0, 0, 1]]))[0]
    torch.testing.assert_close(volume.depth_mean(weights, tdist), torch.tensor([3.005]), rtol=1e-5, atol=0)
    median = volume.depth_median(weights, tdist, torch.tensor([[4.0]]))
    torch.testing.assert_close(median, torch.tensor([3.005]), rtol=1e-5, atol=0)


def test_median_depth_is_where_half_of_the_light_is_lost() -> None:
    tdist = torch.linspace(0, 4, 4001)[None]
    weights = volume.compute_alpha_weights(torch.ones(1, 4000), tdist, torch.tensor([[0.0, 0, 1]]))[0]
    median = volume.depth_median(weights, tdist, torch.tensor([[4.0]]))
    torch.testing.assert_close(median, torch.tensor([np.log(2)], dtype=torch.float32), rtol=1e-4, atol=0)


def test_activations_are_the_paper_s() -> None:
    torch.testing.assert_close(
        volume.density_from_raw(torch.tensor([1.0])), torch.log(torch.tensor([2.0])), rtol=1e-6, atol=0
    )
    torch.testing.assert_close(
        volume.color_from_raw(torch.tensor([-50.0, 0.0, 50.0])), torch.tensor([-0.001, 0.5, 1.001])
    )
