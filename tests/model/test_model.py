"""The prior model: the factored code against the concatenated one, and what is evaluated for which rays."""

import dataclasses

import concatenated_model
import pytest
import torch

from preface.model import losses
from preface.model.configuration import PRESETS, ConfigurationError, ModelConfig, NetworkConfig
from preface.model.folded import fold
from preface.model.model import PriorModel, Render
from preface.model.rays import Rays

SMALL = ModelConfig(
    latent=12,
    proposal=NetworkConfig(2, 24),
    nerf=NetworkConfig(6, 32),  # as in the paper, one layer after the skip and more behind it
    bottleneck=16,
    view_width=12,
    levels=6,
    samples=(12, 10, 8),
    code_std=1.0,
)


def some_rays(count: int, seed: int = 0, hit: torch.Tensor | None = None) -> Rays:
    """Rays of a camera at distance 3 towards the unit box."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.tensor([[0.3, -0.2, 3.0]]).expand(count, 3).contiguous()
    aims = torch.rand(count, 3, generator=generator) - 0.5
    directions = (aims - origins) / 3
    column = torch.ones(count, 1)
    viewdirs = directions / directions.norm(dim=-1, keepdim=True)
    return Rays(origins, directions, viewdirs, 0.004 * column, 2 * column, 4 * column, hit)


def model_of(config: ModelConfig = SMALL, identities: int = 4, seed: int = 1) -> PriorModel:
    torch.manual_seed(seed)
    return PriorModel(config, identities)


def prior_loss(rgb: torch.Tensor, levels: list[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
    (sdist, weights), proposals = levels[-1], levels[:-1]
    return losses.l1(rgb, torch.full_like(rgb, 0.7)) + losses.interlevel(sdist, weights, proposals)


def gradients(model: PriorModel, loss: torch.Tensor) -> dict[str, torch.Tensor]:
    model.zero_grad()
    loss.backward()
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


def steps(rendered: Render) -> list[tuple[torch.Tensor, torch.Tensor]]:
    return [(level.sdist, level.weights) for level in rendered.levels]


@pytest.mark.parametrize(
    ("codes", "count"), [(1450, 14_600_581), (0, 9_007_493)], ids=["paper", "unconditioned"]
)
def test_the_paper_preset_has_the_papers_number_of_parameters(codes: int, count: int) -> None:
    config = PRESETS["paper"] if codes else dataclasses.replace(PRESETS["paper"], latent=0)
    with torch.device("meta"):
        model = PriorModel(config, codes)
    assert sum(p.numel() for p in model.parameters()) == count


def test_every_parameter_is_in_one_group() -> None:
    model = model_of()
    grouped = [id(p) for group in model.parameter_groups().values() for p in group]
    assert sorted(grouped) == sorted(id(p) for p in model.parameters())


@pytest.mark.parametrize("train_frac", [1.0, 0.3])
@pytest.mark.parametrize("jittered", [False, True])
def test_factored_and_concatenated_codes_give_the_same_colours_and_gradients(
    train_frac: float, jittered: bool
) -> None:
    model, rays = model_of(), some_rays(32)
    jitter = torch.rand(32, 3, generator=torch.Generator().manual_seed(5)) if jittered else None
    codes = model.codes.repeat_interleave(8, dim=0)
    expected = concatenated_model.render(model, rays, codes, train_frac, jitter)
    slow = gradients(model, prior_loss(expected["rgb"], expected["levels"]))
    rendered = model(rays, model.codes, train_frac=train_frac, jitter=jitter)
    fast = gradients(model, prior_loss(rendered.rgb, steps(rendered)))
    assert float((rendered.rgb - expected["rgb"]).detach().abs().max()) < 1e-6
    assert fast.keys() == slow.keys()
    for name in slow:
        assert float((fast[name] - slow[name]).norm() / slow[name].norm()) < 1e-5, name


def test_in_float64_the_two_forms_are_one() -> None:
    model = model_of().double()
    rays = Rays(*(x.double() for x in vars(some_rays(16)).values() if x is not None))
    expected = concatenated_model.render(model, rays, model.codes.repeat_interleave(4, dim=0))
    rendered = model(rays, model.codes, normals=True)
    assert rendered.rgb.dtype == torch.float64
    assert float((rendered.rgb - expected["rgb"]).detach().abs().max()) < 1e-13
    assert float((rendered.normals - expected["normals"]).detach().abs().max()) < 1e-9


def test_normals_reach_the_density_as_in_the_concatenated_form() -> None:
    model = model_of(dataclasses.replace(SMALL, predicted_normals=True, levels=4))
    rays, codes = some_rays(8), model.codes.repeat_interleave(2, dim=0)

    def loss(weights: torch.Tensor, normals: torch.Tensor, predicted: torch.Tensor) -> torch.Tensor:
        return losses.predicted_normal(weights, normals, predicted)

    expected = concatenated_model.render(model, rays, codes)
    slow = gradients(model, loss(expected["levels"][-1][1], expected["normals"], expected["normals_pred"]))
    rendered = model(rays, model.codes, normals=True)
    fast = gradients(model, loss(rendered.levels[-1].weights, rendered.normals, rendered.normals_pred))
    assert "nerf.normals.weight" in fast
    assert float(fast["nerf.layers.0.weight"].norm()) > 0
    for name, gradient in slow.items():
        assert float((fast[name] - gradient).norm()) < 1e-4 * float(gradient.norm()) + 1e-9, name


def test_a_layer_that_predicts_normals_costs_nothing_until_they_are_asked_for(monkeypatch) -> None:
    model, rays = model_of(dataclasses.replace(SMALL, predicted_normals=True)), some_rays(8)
    shown = model(rays, model.codes, normals=True)

    def refused(*_, **__):
        raise AssertionError("a derivative was taken")

    monkeypatch.setattr(torch.autograd, "grad", refused)
    plain = model(rays, model.codes)
    assert (plain.normals, plain.normals_pred) == (None, None)
    torch.testing.assert_close(plain.rgb, shown.rgb, rtol=0, atol=1e-6)


def test_groups_may_be_said_in_any_order() -> None:
    model, rays = model_of(), some_rays(12)
    group = torch.tensor([3, 0, 0, 2, 1, 1, 3, 0, 2, 2, 1, 0])
    together = model(rays, model.codes, group).rgb
    for ray in range(12):
        alone = model(rays[ray : ray + 1], model.codes[group[ray : ray + 1]]).rgb
        torch.testing.assert_close(together[ray : ray + 1], alone, rtol=0, atol=1e-6)


def test_a_folded_code_renders_the_same_without_a_code() -> None:
    model, rays = model_of(dataclasses.replace(SMALL, predicted_normals=True)), some_rays(9)
    folded = fold(model, model.codes[2].detach())
    ours, theirs = folded(rays, normals=True), model(rays, model.codes[2:3], normals=True)
    assert float((ours.rgb - theirs.rgb).detach().abs().max()) < 1e-6
    assert float((ours.normals_pred - theirs.normals_pred).detach().abs().max()) < 1e-5
    folded.nerf.layers[0].weight.data.zero_()
    assert model.nerf.layers[0].weight.any(), "the copy is independent"


def test_folding_refuses_a_code_of_another_length() -> None:
    with pytest.raises(ValueError, match=r"\[13\] where \[12\]"):
        fold(model_of(), torch.zeros(13))


# Which rays are evaluated ---------------------------------------------------------------------------------


def test_rays_that_miss_the_box_see_the_background_and_cost_nothing() -> None:
    hit = torch.tensor([[True], [False], [True], [False]])
    model, rays = model_of(), some_rays(4, hit=hit)
    behind = torch.tensor([[0.1, 0.2, 0.3]]).expand(4, 3)
    rendered = model(rays, model.codes, background=behind)
    assert rendered.evaluated.tolist() == [0, 2]
    assert rendered.share == 0.5
    assert len(rendered.levels[0].weights) == 2
    torch.testing.assert_close(rendered.rgb[~hit[:, 0]], behind[:2], rtol=0, atol=0)
    assert rendered.acc[1] == rendered.acc[3] == 0
    assert rendered.distance_mean[1] == rendered.distance_median[1] == 4
    alone = model(some_rays(4)[torch.tensor([0, 2])], model.codes[[0, 2]], background=behind[:2])
    torch.testing.assert_close(rendered.rgb[hit[:, 0]], alone.rgb, rtol=0, atol=1e-6)


def test_the_paper_mode_evaluates_every_ray() -> None:
    config = dataclasses.replace(SMALL, clip_to_box=False, background="modelled")
    model = model_of(config)
    rendered = model(some_rays(4, hit=torch.zeros(4, 1, dtype=torch.bool)), model.codes)
    assert rendered.evaluated is None
    assert (rendered.acc > 0).all()


def test_background_is_blended_by_what_the_model_leaves_free() -> None:
    model, rays = model_of(), some_rays(8)
    black, white = (model(rays, model.codes, background=b) for b in (0.0, 1.0))
    torch.testing.assert_close(white.rgb - black.rgb, (1 - black.acc)[:, None].expand(8, 3))


def test_only_density_is_computed_in_proposal_rounds() -> None:
    model, rays = model_of(), some_rays(8)
    seen = []
    original = model.nerf.raw_color
    model.nerf.raw_color = lambda features, *rest: (seen.append(len(features)), original(features, *rest))[1]
    model(rays, model.codes)
    assert seen == [8 * SMALL.samples[-1]]


def test_interlevel_loss_trains_the_proposal_and_colours_train_the_rest() -> None:
    model, rays = model_of(), some_rays(8)
    by_colour = gradients(model, losses.l1(model(rays, model.codes).rgb, torch.zeros(8, 3)))
    assert not any(name.startswith("proposal") for name in by_colour)
    rendered = model(rays, model.codes)
    (sdist, weights), proposals = steps(rendered)[-1], steps(rendered)[:-1]
    by_bound = gradients(model, losses.interlevel(sdist, weights * 3, proposals))
    assert all(name.startswith("proposal") or name == "codes" for name in by_bound)


def test_near_annealing_begins_at_the_far_end() -> None:
    config = dataclasses.replace(SMALL, near_anneal_rate=0.5)
    model, rays = model_of(config), some_rays(4)
    nearest = [float(model(rays, model.codes, train_frac=f).levels[-1].sdist.min()) for f in (0.0, 0.25, 0.5)]
    assert nearest[0] >= 0.95
    assert 0.5 <= nearest[1] < 0.95
    assert nearest[2] < 0.5


def test_bf16_products_leave_the_rest_in_float32_and_stay_close() -> None:
    model, rays = model_of(), some_rays(32)
    reduced = model_of(dataclasses.replace(SMALL, matmul="bf16"))
    reduced.load_state_dict(model.state_dict())
    ours, exact = reduced(rays, reduced.codes), model(rays, model.codes)
    assert ours.rgb.dtype == ours.levels[-1].weights.dtype == ours.levels[0].sdist.dtype == torch.float32
    assert float((ours.rgb - exact.rgb).detach().abs().max()) < 0.02
    gradient = gradients(reduced, prior_loss(ours.rgb, steps(ours)))
    assert all(g.dtype == torch.float32 and g.isfinite().all() for g in gradient.values())


def test_autocast_around_the_model_changes_nothing_but_the_products() -> None:
    model, rays = model_of(), some_rays(8)
    plain = model(rays, model.codes)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        around = model(rays, model.codes)
    assert around.levels[0].sdist.dtype == torch.float32
    torch.testing.assert_close(around.levels[0].sdist, plain.levels[0].sdist, rtol=0, atol=0)
    assert float((around.rgb - plain.rgb).detach().abs().max()) < 0.02


# Refusals -------------------------------------------------------------------------------------------------


def test_levels_have_to_be_known_before_a_model_is_made() -> None:
    with pytest.raises(ConfigurationError, match="resolved"):
        PriorModel(PRESETS["small"], 4)


@pytest.mark.parametrize(
    ("rays", "code", "group", "message"),
    [
        (8, None, None, "latent 12 was given none"),
        (8, torch.zeros(12), None, r"single code is code\[None\]"),
        (8, torch.zeros(2, 11), None, r"\[identities, 12\]"),
        (8, torch.zeros(3, 12), None, "8 rays are not 3 equal runs"),
        (8, torch.zeros(3, 12), torch.zeros(7, dtype=torch.int64), "for 8 rays"),
    ],
)
def test_codes_that_do_not_fit_are_refused(rays, code, group, message) -> None:
    with pytest.raises(ValueError, match=message):
        model_of()(some_rays(rays), code, group)
