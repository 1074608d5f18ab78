"""Losses against hand-made figures, and what may and may not receive their gradients."""

import pytest
import torch
from torch import nn

from preface.model import losses


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 16), nn.Softplus(), nn.Linear(16, 1)).double()


def normals_of(density: nn.Module, points: torch.Tensor) -> torch.Tensor:
    points = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(density(points).sum(), points, create_graph=True)
    return losses.normals_from_density_gradient(gradient)


def test_l1_is_the_mean_over_rays_and_channels() -> None:
    rendered, target = (
        torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]),
        torch.tensor([[0.2, 0.2, 0.0], [0, 0, 1]]),
    )
    assert losses.l1(rendered, target).item() == pytest.approx((0.1 + 0.3 + 1) / 6)


def test_interlevel_loss_trains_the_proposals_only() -> None:
    sdist = torch.linspace(0, 1, 5)[None].requires_grad_()
    weights = torch.tensor([[0.1, 0.6, 0.2, 0.1]], requires_grad=True)
    coarse = (
        torch.tensor([[0.0, 0.3, 1.0]], requires_grad=True),
        torch.tensor([[0.2, 0.3]], requires_grad=True),
    )
    fine = sdist.detach(), torch.tensor([[0.1, 0.1, 0.1, 0.1]], requires_grad=True)
    loss = losses.interlevel(sdist, weights, [coarse, fine])
    loss.backward()
    # Coarse: only the second interval, 0.6, exceeds its envelope, 0.2 + 0.3. Fine: an interval that ends on
    # an edge sees the next one too: envelopes 0.2, 0.2, 0.2, 0.1.
    assert loss.item() == pytest.approx((0.1**2 / 0.6 + 0.4**2 / 0.6) / 4, rel=1e-5)
    assert coarse[1].grad.tolist()[0] == pytest.approx([-2 * 0.1 / 0.6 / 4] * 2, rel=1e-4)
    assert sdist.grad is None
    assert weights.grad is None
    assert coarse[0].grad is None


def test_normals_point_out_of_the_density() -> None:
    points = torch.tensor([[0.3, 0.0, 0.4]], dtype=torch.float64)
    normals = normals_of(lambda x: -(x * x).sum(dim=-1), points)  # densest at the origin
    torch.testing.assert_close(normals, points / 0.5)


def test_predicted_normals_agree_disagree_and_oppose() -> None:
    up = torch.tensor([0.0, 0, 1])
    predicted = torch.stack([up, torch.tensor([1.0, 0, 0]), -up])[None]
    per_ray = losses.predicted_normal_per_ray(torch.tensor([[0.5, 0.2, 0.1]]), up.expand(1, 3, 3), predicted)
    assert per_ray.tolist() == pytest.approx([0.5 * 0 + 0.2 * 1 + 0.1 * 2])


def test_predicted_normal_loss_moves_the_density_by_its_second_derivatives() -> None:
    """By central differences of the whole loss, which knows nothing of second-order graphs."""
    density, points = network(), torch.linspace(-1, 1, 18, dtype=torch.float64).reshape(2, 3, 3)
    predicted = torch.nn.functional.normalize(torch.ones(2, 3, 3, dtype=torch.float64), dim=-1)
    weights = torch.full((2, 3), 0.3, dtype=torch.float64)

    def loss() -> torch.Tensor:
        return losses.predicted_normal(weights, normals_of(density, points), predicted)

    loss().backward()
    first = density[0].weight
    for row, column in [(0, 0), (5, 1), (15, 2)]:
        shifted = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                first[row, column] += step
            shifted.append(loss().item())
            with torch.no_grad():
                first[row, column] -= step
        difference = (shifted[0] - shifted[1]) / 2e-5
        assert abs(difference) > 1e-6
        assert first.grad[row, column].item() == pytest.approx(difference, rel=1e-5)


def test_predicted_normal_loss_reaches_the_prediction_and_the_weights() -> None:
    weights = torch.tensor([[0.5]], requires_grad=True)
    predicted = torch.tensor([[[0.0, 0.6, 0.8]]], requires_grad=True)
    losses.predicted_normal(weights, torch.tensor([[[0.0, 0, 1]]]), predicted).backward()
    assert weights.grad.item() == pytest.approx(0.2)
    assert predicted.grad.flatten().tolist() == pytest.approx([0, 0, -0.5])


def test_orientation_counts_only_normals_that_face_away() -> None:
    normals = torch.tensor([[[0.0, 0, 1], [0, 0, -1], [0, 0.8, 0.6]]])
    loss = losses.orientation(torch.tensor([[0.5, 0.3, 0.2]]), normals, torch.tensor([[0.0, 0, 1]]))
    assert loss.item() == pytest.approx(0.5 * 1 + 0.2 * 0.36)


def test_view_penalty_is_of_the_direction_s_columns_alone() -> None:
    weight = torch.randn(128, 256 + 27, requires_grad=True)
    losses.view_weight_penalty(weight).backward()
    assert not weight.grad[:, :256].any()
    torch.testing.assert_close(weight.grad[:, 256:], 2 * weight.detach()[:, 256:])


@pytest.mark.parametrize("inputs", [26, 3])
def test_view_penalty_refuses_a_layer_without_those_columns(inputs: int) -> None:
    with pytest.raises(ValueError, match=f"a layer with {inputs}"):
        losses.view_weight_penalty(torch.ones(16, inputs))
