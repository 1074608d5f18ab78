"""Frustums, encodings and normals at the limits, and precision that the surroundings cannot lower.

Values and derivatives, against 60 digits or float64. Each case states what is right there.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import mpmath
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model"))

import model_oracles as oracle

from preface.model import coord, losses, stepfun, volume
from preface.model.safe_math import full_precision

BASIS = coord.icosahedron_basis()

# Frustums -------------------------------------------------------------------------------------------------

FRUSTUMS = [
    (0.0, 1.0), (0.0, 1e-30), (1e-20, 2e-20), (1e-5, 2e-5), (0.0, 0.0), (3.0, 3.0), (2.0, 2.0000002384185791),
    (2.0, 2.0078125), (1.0, 1e6), (1e-3, 1e3), (1e6, 1.0001e6), (1e8, 1e9), (1e15, 1e16),
]  # fmt: skip


@pytest.mark.parametrize("radius", [0.0, 1.5e-4, 1.0])
@pytest.mark.parametrize(("t0", "t1"), FRUSTUMS)
def test_moments_of_frustums_equal_their_integrals(t0: float, t1: float, radius: float) -> None:
    """From tiny to 1e16, from a point to a cone over all distances; 1.5e-4 is a pixel of a 4K portrait."""
    ends = torch.tensor([[t0], [t1]], requires_grad=True)
    moments = coord.frustum_moments(ends[0], ends[1], torch.tensor([radius]))
    start, end = ends.detach().flatten().tolist()
    expected = oracle.frustum_moments(start, end, float(torch.tensor(radius)))
    slopes = oracle.frustum_slopes(start, end, float(torch.tensor(radius)))
    for moment, want, slope in zip(moments, expected, slopes, strict=True):
        np.testing.assert_allclose(float(moment.detach()), want, rtol=2e-6, atol=1e-44)
        (gradient,) = torch.autograd.grad(moment.sum(), ends, retain_graph=True)
        # The variance of a frustum of 1e-20 is a denormal number, and its slope has lost digits.
        floor = 1e-5 * np.abs(slope).max() + 1e-24
        np.testing.assert_allclose(gradient.flatten(), slope, rtol=1e-5, atol=floor)


@pytest.mark.parametrize("column", [0, 3, 9, 17, 20])
@pytest.mark.parametrize("length", [1e-12, 1.0, 1e12])
def test_a_cone_along_a_basis_direction_keeps_its_small_variance(column: int, length: float) -> None:
    """r_var (1 - cos^2) cancels there to noise of 1e-7 r_var, negative as often as not."""
    direction = (BASIS[:, column] * length)[None]
    tdist = torch.tensor([[2.0, 2.001]]) / length
    radii = torch.tensor([[0.5]])
    _, var = coord.project_frustums(torch.zeros(1, 3), direction, tdist * 1.0, radii * length, BASIS)
    true = oracle.projected_gaussian(
        [0, 0, 0], direction[0], tdist[0, 0], tdist[0, 1], float(radii * length), BASIS.double()
    )[1]
    assert (var >= 0).all()
    np.testing.assert_allclose(
        var[0, 0], true, rtol=2e-3 if length == 1 else 3e-3, atol=1e-13 * float(true.max())
    )


@pytest.mark.parametrize("length", [1e-12, 1e-6, 1e6, 1e12])
def test_the_length_of_a_direction_is_only_a_unit_of_t(length: float) -> None:
    origin, direction = torch.tensor([[1.0, 2.0, -1.5]]), torch.tensor([[-0.3, -0.7, 0.5]])
    tdist, radii = torch.linspace(2, 4, 9)[None], torch.tensor([[0.01]])
    expected = coord.project_frustums(origin, direction, tdist, radii, BASIS)
    got = coord.project_frustums(origin, direction * length, tdist / length, radii * length, BASIS)
    torch.testing.assert_close(got[0], expected[0], rtol=0, atol=5e-7)
    torch.testing.assert_close(got[1], expected[1], rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("distance", [3.0, 30.0, 1e3, 1e5])
def test_means_are_as_good_from_far_cameras_as_from_near_ones(distance: float) -> None:
    """The ray parameters' own rounding is given; nothing may be lost on top of it."""
    generator = torch.Generator().manual_seed(4)
    origins = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator), dim=-1) * distance
    directions = -origins / distance + torch.randn(64, 3, generator=generator) / distance * 0.3
    tdist = distance + torch.linspace(-1, 1, 33).expand(64, -1)
    radii = torch.full((64, 1), 1e-3 / distance)
    rays = origins, directions, tdist, radii
    mean, var = coord.project_frustums(*rays, BASIS)
    true_mean, true_var = coord.project_frustums(*(x.double() for x in rays), BASIS.double())
    assert true_mean.abs().max() < 2
    torch.testing.assert_close(mean.double(), true_mean, rtol=0, atol=2.5e-7)
    torch.testing.assert_close(var.double(), true_var, rtol=1e-5, atol=1e-12)


# Encodings ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("var", [0.0, 1e-38, 1e-8, 1e-2, 1e10, 1e38, torch.inf])
@pytest.mark.parametrize("levels", [1, 4, 12, 16])
def test_integrated_encoding_and_derivatives_equal_the_expectation(levels: int, var: float) -> None:
    """At every level, up to angles of 3e5: scaling by two is exact, so a level adds no error."""
    means = [-9.7, -1.3, -1e-30, 0.0, 1e-6, 0.3, 3.1415927, 9.9]
    mean = torch.tensor(means, requires_grad=True)
    variance = torch.full((8,), var, requires_grad=True)
    encoded = coord.integrated_pos_enc(mean[:, None], variance[:, None], levels - 1, levels)
    waves = np.array(
        [oracle.expected_waves(m, float(variance[0].detach()), levels - 1) for m in mean.tolist()]
    )
    np.testing.assert_allclose(encoded.detach(), waves, rtol=0, atol=3e-7)
    encoded[:, 0].sum().backward()  # of the sine: 2^l times the cosine, and -4^l/2 times itself
    scale = 2.0 ** (levels - 1)
    np.testing.assert_allclose(mean.grad / scale, waves[:, 1], rtol=0, atol=3e-7)
    np.testing.assert_allclose(variance.grad / scale**2, -waves[:, 0] / 2, rtol=0, atol=3e-7)


@pytest.mark.parametrize("levels", [4, 10, 12, 16])
def test_encoding_from_rays_is_bounded_by_the_rounding_of_the_mean(levels: int) -> None:
    """Half an ulp of a position in [-2, 2], a few times, times 2^level: a stated bound, kept."""
    generator = torch.Generator().manual_seed(5)
    origins = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator), dim=-1) * 3
    rays = origins, -origins / 3, torch.linspace(2, 4, 65).expand(64, -1), torch.full((64, 1), 1e-5)
    mean, var = coord.project_frustums(*rays, BASIS)
    true_mean, true_var = coord.project_frustums(*(x.double() for x in rays), BASIS.double())
    encoded = coord.integrated_pos_enc(mean, var, 0, levels).double()
    expected = coord.integrated_pos_enc(true_mean, true_var, 0, levels)
    assert float((encoded - expected).abs().max()) < 2.0 ** (levels - 1) * 2.0**-23 * 1.5 + 3e-7


@pytest.mark.parametrize("scale", [1e-30, 1e-4, 1.0, 1e4])
def test_direction_encoding_of_any_length(scale: float) -> None:
    x = (torch.tensor([0.6, 0.0, -0.8]) * scale).requires_grad_()
    encoded = coord.pos_enc(x, 0, 4)
    angles = [[mpmath.mpf(v) * 2**level for v in x.tolist()] for level in range(4)]
    sines = [float(mpmath.sin(a)) for row in angles for a in row]
    cosines = [float(mpmath.cos(a)) for row in angles for a in row]
    np.testing.assert_allclose(encoded.detach(), x.tolist() + sines + cosines, rtol=0, atol=2e-7)
    encoded[3:15].sum().backward()
    slopes = np.array(cosines).reshape(4, 3) * (2.0 ** np.arange(4))[:, None]
    np.testing.assert_allclose(x.grad, slopes.sum(axis=0), rtol=0, atol=4e-6)


# Normals and losses ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("magnitude", [0.0, 1e-45, 1e-30, 1e-7, 3.4e-4, 3.5e-4, 1.0, 1e19, 1e38])
def test_normals_of_gradients_of_every_magnitude(magnitude: float) -> None:
    """Unit above sqrt(eps) = 3.45e-4, in proportion below, zero at zero; no derivative above 1/sqrt(eps)."""
    gradient = (torch.tensor([[0.36, -0.48, 0.8]]) * magnitude).requires_grad_()
    normal = losses.normals_from_density_gradient(gradient)
    vector = gradient.detach()[0].double()
    expected = -vector / max(float(vector.norm()), 2.0**-11.5)
    torch.testing.assert_close(normal[0].double(), expected, rtol=1e-6, atol=1e-44)
    (first,) = torch.autograd.grad(normal.sum(), gradient, create_graph=True)
    assert float(first.detach().abs().max()) <= 2.0**11.5 * 3**0.5
    (second,) = torch.autograd.grad(first.sum(), gradient)
    assert second.isfinite().all()


def test_predicted_normal_loss_of_a_flat_density_has_finite_second_order_gradients() -> None:
    density = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.ReLU(), torch.nn.Linear(8, 1))
    torch.nn.init.zeros_(density[2].weight)
    points = torch.ones(4, 2, 3, requires_grad=True)
    (gradient,) = torch.autograd.grad(density(points).sum(), points, create_graph=True)
    predicted = losses.normals_from_density_gradient(torch.zeros(4, 2, 3))
    loss = losses.predicted_normal(
        torch.ones(4, 2), losses.normals_from_density_gradient(gradient), predicted
    )
    assert loss.item() == 2  # no normal at all counts as a right angle
    loss.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in density.parameters())


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_constant_image_met_exactly_costs_nothing_and_pulls_nowhere(value: float) -> None:
    rendered = torch.full((5, 3), value, requires_grad=True)
    loss = losses.l1(rendered, torch.full((5, 3), value))
    loss.backward()
    assert loss.item() == 0
    assert not rendered.grad.any()


@pytest.mark.parametrize("size", [1e-30, 1e15])
def test_view_penalty_of_tiny_and_huge_weights(size: float) -> None:
    weight = torch.full((2, 30), size, dtype=torch.float32, requires_grad=True)
    penalty = losses.view_weight_penalty(weight)
    penalty.backward()
    np.testing.assert_allclose(penalty.item(), 54 * size**2, rtol=1e-6, atol=1e-44)
    np.testing.assert_allclose(weight.grad[:, 3:], 2 * size, rtol=1e-6)


# Precision and batches ------------------------------------------------------------------------------------


def cases(rays: int, intervals: int = 8) -> dict[str, Callable[[], torch.Tensor]]:
    """Every function of the model's mathematics, on the same made-up rays."""
    generator = torch.Generator().manual_seed(6)
    position = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
    tdist = torch.sort(2 + 2 * torch.rand(rays, intervals + 1, generator=generator)).values
    t, radii = (tdist - 2) / 2, torch.full((rays, 1), 2e-3)
    density = 3 * torch.rand(rays, intervals, generator=generator)
    normals = torch.nn.functional.normalize(torch.randn(rays, intervals, 3, generator=generator), dim=-1)
    w = density / 12 / intervals
    mean, cov = position[:, None] * t[:, 1:, None], 1e-3 * torch.eye(3).expand(rays, intervals, 3, 3)

    def encoded() -> torch.Tensor:
        return coord.integrated_pos_enc(
            *coord.project_frustums(3 * position, -position, tdist, radii, BASIS), 0, 12
        )

    return {
        "encoding": encoded,
        "covariance": lambda: coord.conical_frustum_to_gaussian(position, t[:, :-1], t[:, 1:], radii)[1],
        "projection": lambda: coord.lift_and_diagonalize(mean, cov, BASIS)[1],
        "directions": lambda: coord.pos_enc(position, 0, 4),
        "weights": lambda: volume.compute_alpha_weights(density, tdist, position)[0],
        "colour": lambda: volume.composite(w, volume.color_from_raw(normals)),
        "depth": lambda: volume.depth_mean(w, tdist) + volume.depth_median(w, tdist, tdist[:, -1:]),
        "resampling": lambda: stepfun.sample_intervals(t, stepfun.resampling_logits(t, w), 8),
        "dilation": lambda: stepfun.max_dilate_weights(t, w, 0.05, (0.0, 1.0), renormalize=True)[1],
        "interlevel": lambda: losses.interlevel(t, w, [(t, w / 2)]),
        "normals": lambda: losses.predicted_normal_per_ray(w, normals, normals.flip(0)),
        "orientation": lambda: losses.orientation(w, normals, position),
    }


@contextlib.contextmanager
def surroundings(name: str) -> Iterator[None]:
    """Settings under which matrix products, and under autocast most operations, lose digits."""
    before, before_cpu = torch.get_float32_matmul_precision(), torch.backends.mkldnn.matmul.fp32_precision
    try:
        if name == "TF32 and bf16 matmuls":
            torch.set_float32_matmul_precision("medium")
            torch.backends.mkldnn.matmul.fp32_precision = "bf16"
            yield
        else:
            with torch.autocast("cpu", dtype={"bf16": torch.bfloat16, "f16": torch.float16}[name]):
                yield
    finally:
        torch.set_float32_matmul_precision(before)
        torch.backends.mkldnn.matmul.fp32_precision = before_cpu


@pytest.mark.parametrize("setting", ["bf16", "f16", "TF32 and bf16 matmuls"])
@pytest.mark.parametrize("name", cases(1))
def test_surroundings_change_no_bit(name: str, setting: str) -> None:
    function = cases(16)[name]
    expected = function()
    with surroundings(setting):
        got = function()
    assert got.dtype == torch.float32
    assert torch.equal(got, expected)


def test_what_is_marked_as_full_precision_is_so_under_autocast_and_from_half_arguments() -> None:
    a, b = torch.rand(4, 4, generator=torch.Generator().manual_seed(0)).bfloat16(), torch.full((4, 4), 1 / 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        product = full_precision(torch.mm)(a, mat2=b)
        lowered = torch.mm(a, b)
    assert product.dtype == torch.float32
    assert torch.equal(product, a.float() @ b)
    assert lowered.dtype == torch.bfloat16  # what the surroundings would have made of it


def test_float64_stays_float64() -> None:
    double = torch.tensor([1.0], dtype=torch.float64)
    assert volume.density_from_raw(double).dtype == torch.float64
    assert abs(float(volume.density_from_raw(double)) - np.log(2)) < 1e-15


class NoMatrixProducts(TorchDispatchMode):
    """Fails at the first operation that TF32 or a reduced matmul precision could reach."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert not any(word in str(func) for word in ("mm", "matmul", "einsum", "linear.", "conv")), func
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", cases(1))
def test_no_matrix_product_is_used_that_a_gpu_would_round_to_tf32(name: str) -> None:
    function = cases(16)[name]
    with NoMatrixProducts():
        function()


@pytest.mark.parametrize("name", cases(1))
def test_no_ray_gives_no_result_and_one_ray_that_of_itself(name: str) -> None:
    none, one = cases(0)[name](), cases(1)[name]()
    assert none.shape[:1] in ((0,), ())
    assert none.isfinite().all()
    assert one.isfinite().all()
    if none.ndim == 0:
        assert none.item() == 0  # a mean over no rays costs nothing


@pytest.mark.parametrize("rays", [4097, 65536])
def test_a_ray_s_result_does_not_depend_on_its_batch(rays: int) -> None:
    generator = torch.Generator().manual_seed(8)
    t = torch.sort(torch.rand(rays, 7, generator=generator)).values
    w = torch.rand(rays, 6, generator=generator) ** 4

    def level(t: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
        edges, dilated = stepfun.max_dilate_weights(t, w, 0.01, (0.0, 1.0), renormalize=True)
        drawn = stepfun.sample_intervals(
            edges, stepfun.resampling_logits(edges, dilated), 5, domain=(0.0, 1.0)
        )
        return volume.compute_alpha_weights(dilated[:, :5], drawn, torch.ones(len(t), 3))[0]

    whole = level(t, w)
    for rows in (slice(0, 1), slice(rays // 2, rays // 2 + 3), slice(rays - 1, rays)):
        torch.testing.assert_close(whole[rows], level(t[rows], w[rows]), rtol=0, atol=1e-7)
