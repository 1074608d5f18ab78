"""The networks at the limits: what is right there, against the concatenated model in float64 where there is one.

Nothing may become infinite or NaN, in values or in gradients, unless it came in so.
"""

import dataclasses
import math
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model"))

import concatenated_model

from preface.model import losses
from preface.model.configuration import ModelConfig, NetworkConfig
from preface.model.model import PriorModel, Render
from preface.model.rays import Rays

CONFIG = ModelConfig(
    latent=8,
    proposal=NetworkConfig(2, 16),
    nerf=NetworkConfig(6, 16),
    bottleneck=8,
    view_width=8,
    view_levels=2,
    levels=4,
    samples=(8, 6, 5),
    code_std=1.0,
)
PRECISIONS = pytest.mark.parametrize("matmul", ["fp32", "bf16"])


def some_rays(count: int, radius: float = 0.004, near: float = 2.0, far: float = 4.0) -> Rays:
    generator = torch.Generator().manual_seed(count)
    origins = torch.tensor([[0.3, -0.2, 3.0]]).expand(count, 3).contiguous()
    directions = (torch.rand(count, 3, generator=generator) - 0.5 - origins) / 3
    column = torch.ones(count, 1)
    viewdirs = directions / directions.norm(dim=-1, keepdim=True)
    return Rays(origins, directions, viewdirs, radius * column, near * column, far * column)


def model_of(seed: int = 1, **changes) -> PriorModel:
    torch.manual_seed(seed)
    return PriorModel(dataclasses.replace(CONFIG, **changes), 2)


def loss_of(rendered: Render, target: float = 0.5) -> torch.Tensor:
    last = rendered.levels[-1]
    loss = losses.l1(rendered.rgb, torch.full_like(rendered.rgb, target))
    loss = loss + losses.interlevel(
        last.sdist, last.weights, [(level.sdist, level.weights) for level in rendered.levels[:-1]]
    )
    if rendered.normals_pred is not None:
        loss = loss + losses.predicted_normal(last.weights, rendered.normals, rendered.normals_pred)
    return loss


def require_sound(model: PriorModel, rendered: Render, loss: torch.Tensor) -> None:
    """Finite everywhere, ascending samples, colours and opacities within their range, finite gradients."""
    model.zero_grad()
    loss.backward()
    for level in rendered.levels:
        assert level.sdist.isfinite().all()
        assert (level.sdist.diff(dim=-1) >= 0).all()
        assert level.density.isfinite().all()
        assert (level.density >= 0).all()
        assert (level.weights >= 0).all()
        assert (level.weights.sum(-1) <= 1 + 1e-5).all()
    assert ((rendered.rgb >= -0.0011) & (rendered.rgb <= 1.0011)).all()
    assert ((rendered.acc >= 0) & (rendered.acc <= 1)).all()
    assert rendered.distance_mean.isfinite().all()
    assert rendered.distance_median.isfinite().all()
    for name, parameter in model.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name


def off_from_float64(model: PriorModel, rays: Rays, rendered: Render, codes: torch.Tensor) -> float:
    double = PriorModel(dataclasses.replace(model.config, matmul="fp32"), 2).double()
    double.load_state_dict(model.state_dict())
    exact = Rays(*(x.double() for x in vars(rays).values() if x is not None))
    expected = concatenated_model.render(double, exact, codes.double())
    return float((rendered.rgb - expected["rgb"]).detach().abs().max())


# Codes ----------------------------------------------------------------------------------------------------


@PRECISIONS
@pytest.mark.parametrize("size", [0.0, 1e-38, 1e-4, 1.0, 1e2, 1e4])
def test_codes_from_nothing_to_huge(size: float, matmul: str) -> None:
    """A huge code makes walls or nothing of everything, and colours black or white, but no NaN."""
    model, rays = model_of(matmul=matmul), some_rays(6)
    codes = (size * torch.ones(2, 8)).requires_grad_()
    rendered = model(rays, codes)
    require_sound(model, rendered, loss_of(rendered))
    assert codes.grad.isfinite().all()
    if matmul == "fp32" and size <= 1e2:
        assert off_from_float64(model, rays, rendered, codes.detach().repeat_interleave(3, 0)) < 1e-4


def test_codes_that_are_not_numbers_stop_at_the_first_resampling() -> None:
    """Where the ray is: the rays of the code before are in order."""
    model, rays = model_of(), some_rays(4)
    codes = model.codes.detach().clone()
    codes[1, 3] = torch.nan
    with pytest.raises(ValueError, match=r"edges must ascend, but nan is followed by nan at \(2, 0\)"):
        model(rays, codes)


def test_codes_without_gradients_leave_those_of_others_at_zero() -> None:
    model, rays = model_of(), some_rays(4)
    loss_of(model(rays, model.codes, torch.zeros(4, dtype=torch.int64))).backward()
    assert model.codes.grad[0].any()
    assert not model.codes.grad[1].any()


# Densities and colours ------------------------------------------------------------------------------------


@PRECISIONS
@pytest.mark.parametrize("raw", [-110.0, -104.0, -87.0, -14.0, 0.0, 20.0, 110.0, 1e4])
def test_raw_densities(raw: float, matmul: str) -> None:
    model, rays = model_of(matmul=matmul), some_rays(6)
    for network in (model.proposal, model.nerf):
        network.density.weight.data.mul_(0.01)
        network.density.bias.data.fill_(raw)
    rendered = model(rays, model.codes)
    require_sound(model, rendered, loss_of(rendered))
    if raw <= -14:
        assert (rendered.acc < 1e-4).all()
        assert (rendered.levels[-1].density > 0).all() or raw < -100
    if raw >= 20:
        # Not quite 1: the last round looks where the light is lost, and ends where next to none is left.
        assert (rendered.acc > 0.9).all()


@pytest.mark.parametrize(("raw", "color"), [(-200.0, -0.001), (200.0, 1.001)])
def test_saturated_colours_are_the_ends_of_the_padded_range(raw: float, color: float) -> None:
    model, rays = model_of(), some_rays(4)
    model.nerf.density.bias.data.fill_(200.0)
    model.nerf.color.bias.data.fill_(raw)
    rendered = model(rays, model.codes)
    torch.testing.assert_close(rendered.rgb, torch.full((4, 3), color), rtol=0, atol=1e-5)
    require_sound(model, rendered, loss_of(rendered, target=0.0))


@pytest.mark.parametrize("target", [0.0, 1.0])
def test_constant_images_are_learned_without_leaving_the_numbers(target: float) -> None:
    model, rays = model_of(), some_rays(32)
    found = []
    for _ in range(8):
        rendered = model(rays, model.codes)
        found.append(float(losses.l1(rendered.rgb, torch.full((32, 3), target)).detach()))
        require_sound(model, rendered, loss_of(rendered, target))
        for parameter in model.parameters():
            parameter.data.sub_(0.02 * parameter.grad.sign())
    assert found[-1] < 0.7 * found[0]


# Rays -----------------------------------------------------------------------------------------------------


@PRECISIONS
@pytest.mark.parametrize("radius", [0.0, 1e-38, 1e-6, 1e-4, 0.01, 1.0])
def test_radii_from_nothing_to_the_whole_scene(radius: float, matmul: str) -> None:
    model, rays = model_of(matmul=matmul), some_rays(6, radius=radius)
    rendered = model(rays, model.codes)
    require_sound(model, rendered, loss_of(rendered))
    if matmul == "fp32":
        codes = model.codes.detach().repeat_interleave(3, 0)
        assert off_from_float64(model, rays, rendered, codes) < 1e-4


@pytest.mark.parametrize(
    ("near", "far"), [(3.0, 3.0), (0.0, 0.0), (0.0, 1e-30), (1e-3, 1e3), (0.0, 4.0), (1e6, 1e6 + 1)]
)
def test_depths(near: float, far: float) -> None:
    """Near = far gives a ray without length, which sees the background."""
    model, rays = model_of(), some_rays(4, near=near, far=far)
    rendered = model(rays, model.codes, background=0.25)
    require_sound(model, rendered, loss_of(rendered))
    if near == far:
        torch.testing.assert_close(rendered.rgb, torch.full((4, 3), 0.25), rtol=0, atol=1e-6)
        assert (rendered.distance_mean == near).all()


@pytest.mark.parametrize("near", [1e-3, 2.0, 5.2954859, 1e6])
@pytest.mark.parametrize("roundings", [1, 2, 3, 10])
def test_rays_that_graze_the_box_have_ascending_depths(near: float, roundings: int) -> None:
    """Where near and far are a few roundings apart, interpolating carelessly makes negative weights and NaN."""
    start = torch.tensor(near)
    end = start
    for _ in range(roundings):
        end = torch.nextafter(end, torch.tensor(torch.inf))
    model, rays = model_of(samples=(24, 16, 12)), some_rays(4, near=near, far=float(end))
    for seed in range(3):
        jitter = torch.rand(4, 3, generator=torch.Generator().manual_seed(seed))
        rendered = model(rays, model.codes, train_frac=0.5, jitter=jitter)
        require_sound(model, rendered, loss_of(rendered))
        for level in rendered.levels:
            assert (level.tdist.diff(dim=-1) >= 0).all()
            assert (level.tdist >= start).all()
            assert (level.tdist <= end).all()


@PRECISIONS
@pytest.mark.parametrize("train_frac", [0.0, 1.0])
@pytest.mark.parametrize("samples", [(1, 1, 1), (1, 1, 5), (8, 1, 1), (1,), (5,), (2, 2, 2, 2), (3, 65, 2)])
def test_numbers_of_rounds_and_samples(samples: tuple[int, ...], train_frac: float, matmul: str) -> None:
    model, rays = model_of(samples=samples, matmul=matmul), some_rays(4)
    jitter = torch.rand(4, len(samples))
    rendered = model(rays, model.codes, train_frac=train_frac, jitter=jitter)
    assert [level.weights.shape for level in rendered.levels] == [(4, n) for n in samples]
    require_sound(model, rendered, loss_of(rendered))


@pytest.mark.parametrize("jitter", [0.0, 1 - 2.0**-24])
def test_jitter_at_its_ends(jitter: float) -> None:
    model, rays = model_of(), some_rays(4)
    rendered = model(rays, model.codes, jitter=torch.full((4, 3), jitter))
    require_sound(model, rendered, loss_of(rendered))


@PRECISIONS
@pytest.mark.parametrize("count", [0, 1, 2, 127, 4096, 65536])
def test_numbers_of_rays(count: int, matmul: str) -> None:
    """From none to the paper's batch, in one call; a sample of them against the same rays alone."""
    model = model_of(samples=(3, 2), nerf=NetworkConfig(2, 8), levels=2, matmul=matmul)
    rays, group = some_rays(count), torch.arange(count) % 2
    rendered = model(rays, model.codes, group)
    assert rendered.rgb.shape == (count, 3)
    require_sound(model, rendered, loss_of(rendered))
    if count:
        last = model(rays[count - 1 :], model.codes[group[-1:]])
        torch.testing.assert_close(
            rendered.rgb[-1:], last.rgb, rtol=0, atol=1e-6 if matmul == "fp32" else 1e-2
        )


@PRECISIONS
@pytest.mark.parametrize("normals", [False, True])
def test_rays_that_all_miss_the_box(normals: bool, matmul: str) -> None:
    model = model_of(predicted_normals=normals, matmul=matmul)
    rays = dataclasses.replace(some_rays(4), hit=torch.zeros(4, 1, dtype=torch.bool))
    rendered = model(rays, model.codes, background=1.0, normals=normals)
    assert (rendered.rgb == 1).all()
    assert (rendered.acc == 0).all()
    assert rendered.share == 0
    loss = loss_of(rendered)
    require_sound(model, rendered, loss)
    assert all(p.grad is None or not p.grad.any() for p in model.parameters())


# Encodings and normals ------------------------------------------------------------------------------------


@PRECISIONS
@pytest.mark.parametrize("levels", [0, 1, 8, 12, 16])
def test_levels_of_the_encoding(levels: int, matmul: str) -> None:
    """float32 positions of the scene give angles that are 2^l roundings off: 1e-7 at the first, 4e-3 at 2^15."""
    model, rays = model_of(levels=levels, matmul=matmul), some_rays(6, radius=1e-6)
    rendered = model(rays, model.codes)
    require_sound(model, rendered, loss_of(rendered))
    if matmul == "fp32":
        codes = model.codes.detach().repeat_interleave(3, 0)
        allowed = 1e-5 + 2e-7 * 2.0**levels
        assert off_from_float64(model, rays, rendered, codes) < allowed


@pytest.mark.parametrize("levels", [1, 8, 12])
def test_the_fast_encoding_is_that_of_the_definition(levels: int) -> None:
    from preface.model import coord, encoding

    rays, basis = some_rays(16, radius=1e-3), coord.icosahedron_basis()
    tdist = torch.linspace(2, 4, 9).expand(16, -1).contiguous()
    arguments = rays.origins, rays.directions, tdist, rays.radii, basis
    fast = encoding.encode_intervals(*arguments, levels)
    mean, var = coord.project_frustums(*arguments)
    expected = coord.integrated_pos_enc(mean, var, 0, levels).flatten(0, 1)
    torch.testing.assert_close(fast, expected, rtol=0, atol=2e-7 * 2.0**levels)


@PRECISIONS
@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("raw", [-110.0, 0.0, 110.0])
def test_normals_of_any_density_have_finite_second_derivatives(raw: float, flat: bool, matmul: str) -> None:
    """Also of one that is constant: its gradient is zero everywhere, and so are its normals."""
    model, rays = model_of(predicted_normals=True, matmul=matmul), some_rays(4)
    model.nerf.density.bias.data.fill_(raw)
    if flat:
        model.nerf.density.weight.data.zero_()
    rendered = model(rays, model.codes, normals=True)
    require_sound(model, rendered, loss_of(rendered))
    length = rendered.normals.norm(dim=-1)
    assert (length <= 1 + 1e-5).all()
    if flat:
        assert (length == 0).all()


def test_gradients_survive_clipping_to_a_thousandth() -> None:
    """multinerf clips each network by itself: with a norm of 1e-3, directions stay and lengths are equal."""
    model, rays = model_of(), some_rays(8)
    rendered = model(rays, model.codes)
    loss_of(rendered).backward()
    for name, group in model.parameter_groups().items():
        norm = float(torch.nn.utils.clip_grad_norm_(group, 1e-3))
        clipped = math.sqrt(sum(float((p.grad.double() ** 2).sum()) for p in group if p.grad is not None))
        assert clipped <= 1e-3 * (1 + 1e-5), name
        assert clipped == pytest.approx(min(norm, 1e-3), rel=1e-3), name
