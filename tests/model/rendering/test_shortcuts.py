"""Shortcuts against the full evaluation, on a model of which it is known where its matter is."""

import dataclasses

import numpy as np
import pytest
import torch

from preface.geometry import Box, Camera, Rigid
from preface.model.configuration import ModelConfig, NetworkConfig
from preface.model.coord import integrated_pos_enc
from preface.model.folded import fold
from preface.model.matmul import Route
from preface.model.metrics.image_quality import psnr
from preface.model.model import PriorModel
from preface.model.rendering import accelerated
from preface.model.rendering.image import RenderedImage, Space, render_image
from preface.model.rendering.paths import framing_camera, look_at
from preface.model.rendering.shortcuts import QUALITIES, Shortcuts, accelerate

SPACE = Space(Box(np.array([-0.2, -0.25, -0.2]), np.array([0.2, 0.25, 0.2])), 4.0)
FRONT = look_at(np.array([0.3, 0.15, 0.9]), np.zeros(3))
CAMERA = framing_camera(SPACE.box.half_sides, 0.97, 24, 32)
INSIDE = look_at(np.array([0.0, 0.05, 0.1]), np.array([0.0, 0.0, -0.2]))
GRID = Shortcuts(folded=True, occupancy=40, skipped_rounds=2)


def ball_model(
    radius: float = 0.12, normals: bool = False, samples: tuple[int, ...] = (48, 48, 32)
) -> PriorModel:
    """A model fitted to a soft ball: density by regression in closed reach, colours as initialised."""
    torch.manual_seed(0)
    config = ModelConfig(
        latent=3, proposal=NetworkConfig(2, 32), nerf=NetworkConfig(2, 32), bottleneck=16, view_width=16, levels=4,
        view_levels=1, samples=samples, predicted_normals=normals,
    )  # fmt: skip
    model = PriorModel(config, 2)
    optimizer = torch.optim.Adam(model.parameters(), 1e-2)
    for _ in range(150):
        points = (torch.rand(1024, 3) * 2 - 1) * torch.tensor([0.8, 1.0, 0.8])
        mean = points @ model.basis
        encoded = integrated_pos_enc(mean, torch.full_like(mean, 1e-4), 0, 4)
        inside = points.norm(dim=-1) < radius * SPACE.scale
        loss = torch.zeros(())
        for network in (model.proposal, model.nerf):
            biases = network.biases(model.codes[:1].detach(), None, 1)
            raw = network.raw_density(
                network.trunk(encoded, biases, model.products), biases[len(network.layers)]
            )
            loss = loss + ((raw - torch.where(inside, 60.0, -12.0)) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return model.requires_grad_(False)


@pytest.fixture(scope="module")
def ball() -> PriorModel:
    return ball_model()


def seen(
    model: PriorModel,
    shortcuts: Shortcuts,
    pose: Rigid = FRONT,
    camera: Camera = CAMERA,
    *,
    normals: bool = False,
    background: float = 0.0,
    at_a_time: int = 4096,
    code: int = 0,
) -> RenderedImage:
    render = accelerate(model, model.codes[code], SPACE, shortcuts, background=background, normals=normals)
    return render_image(render, SPACE, camera, pose, rays_at_a_time=at_a_time)


def decibels(one: RenderedImage, other: RenderedImage) -> float:
    return psnr(torch.from_numpy(one.rgb), torch.from_numpy(other.rgb))


def test_with_everything_off_the_image_is_the_model_s_own_to_the_bit(ball):
    def plain(rays):
        return ball(rays, ball.codes[:1], background=0.5, normals=True)

    own = render_image(plain, SPACE, CAMERA, FRONT, rays_at_a_time=4096)
    ours = seen(ball, QUALITIES["reference"], background=0.5, normals=True)
    for name in ("rgb", "alpha", "depth", "normals"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(own, name))


@pytest.mark.parametrize(
    ("shortcuts", "least"),
    [
        (Shortcuts(folded=True), 100),
        (Shortcuts(color_bound=1e-7), 100),
        (Shortcuts(weight_bound=1e-3), 55),
        (Shortcuts(occupancy=40), 50),
        (GRID, 45),
        (dataclasses.replace(GRID, skipped_rounds=1), 45),
        (dataclasses.replace(GRID, short_share=0.5, short=1.0), 40),
        (Shortcuts(matmul="bf16"), 40),
        (Shortcuts(levels=4), 100),
        (QUALITIES["balanced"], 40),
    ],
)
def test_each_shortcut_stays_near_the_full_evaluation(ball, shortcuts, least):
    full = seen(ball, Shortcuts(), background=1.0)
    ours = seen(ball, shortcuts, background=1.0)
    assert 0.1 < (full.alpha > 0.5).mean() < 0.9
    assert decibels(ours, full) > least
    solid = (full.alpha > 0.9) & (ours.alpha > 0.9)
    assert np.median(np.abs(ours.depth - full.depth)[solid]) < 1e-3


@pytest.mark.parametrize("pose", [INSIDE, look_at(np.array([0.3, 0.4, 100.0]), np.zeros(3))])
def test_a_camera_in_the_box_and_one_far_away_see_what_the_full_evaluation_sees(ball, pose):
    camera = CAMERA if pose is INSIDE else Camera("PINHOLE", 24, 32, [6000.0, 6000.0, 12.0, 16.0])
    full, ours = (seen(ball, shortcuts, pose, camera, background=1.0) for shortcuts in (Shortcuts(), GRID))
    assert np.abs(ours.alpha - full.alpha).mean() < 0.01
    assert decibels(ours, full) > 35


def test_no_seams_between_any_chunks(ball):
    whole = seen(ball, QUALITIES["balanced"], background=0.3)
    parts = seen(ball, QUALITIES["balanced"], background=0.3, at_a_time=17)
    # bfloat16 products of other sizes may be summed in another order.
    np.testing.assert_allclose(parts.rgb, whole.rgb, atol=2e-3)
    exact = dataclasses.replace(QUALITIES["balanced"], matmul="fp32")
    whole, parts = (seen(ball, exact, at_a_time=n) for n in (10**6, 17))
    np.testing.assert_allclose(parts.rgb, whole.rgb, atol=1e-5)


@pytest.mark.parametrize(("bias", "alpha"), [(-200.0, 0.0), (1e6, 1.0)])
def test_an_empty_and_a_solid_model(ball, bias, alpha):
    model = fold(ball, ball.codes[0])
    with torch.no_grad():
        for network in (model.proposal, model.nerf):
            network.density.weight.zero_()
            network.density.bias.fill_(bias)
    render = accelerate(model, None, SPACE, QUALITIES["balanced"], background=0.25, normals=True)
    image = render_image(render, SPACE, CAMERA, FRONT, rays_at_a_time=1000)
    full = render_image(
        accelerate(model, None, SPACE, Shortcuts(), background=0.25),
        SPACE,
        CAMERA,
        FRONT,
        rays_at_a_time=1000,
    )
    np.testing.assert_allclose(image.alpha, full.alpha, atol=1e-4)
    assert image.alpha.max() == pytest.approx(alpha)
    np.testing.assert_allclose(image.rgb[full.alpha == 0], 0.25)
    assert np.isfinite(image.rgb).all()


@pytest.mark.parametrize("quality", list(QUALITIES))
@pytest.mark.parametrize("center", [(0.3, 0.15, 0.9), (0.0, 0.1, 0.5), (-0.8, 0.3, 1.2)])
def test_what_a_model_has_put_outside_the_box_is_not_there_wherever_the_camera_is(ball, quality, center):
    """A prior with a modelled background: here a fog that fills the space, with the box cut out of it."""
    clipped = PriorModel(ball.config, 2)
    clipped.load_state_dict(ball.state_dict())
    with torch.no_grad():
        for network in (clipped.proposal, clipped.nerf):
            network.density.bias.add_(40.0)
    open_ = PriorModel(dataclasses.replace(ball.config, clip_to_box=False, background="modelled"), 2)
    open_.load_state_dict(clipped.state_dict())
    pose, camera = look_at(np.array(center), np.zeros(3)), Camera("PINHOLE", 12, 16, [7.0, 7.0, 6.0, 8.0])
    one, other = (seen(model, QUALITIES[quality], pose, camera, background=0.5) for model in (clipped, open_))
    beside = other.alpha == 0
    assert 0.05 < beside.mean() < 1
    assert (other.rgb[beside] == 0.5).all()
    np.testing.assert_allclose(other.rgb, one.rgb, atol=1e-6)
    assert (open_.config.clip_to_box, open_.config.background) == (False, "modelled"), "and stays as it was"


@pytest.fixture
def processor(monkeypatch):
    """A function that puts a processor of certain speeds in the place of this one; it returns what was tried on it."""

    def replace(bf16: float, fp32: float) -> list[str]:
        tried = []

        def choose_route(precision, device, width):
            tried.append(precision)
            return Route(precision, bf16 if precision == "bf16" else fp32, 0.0)

        monkeypatch.setattr(accelerated, "choose_route", choose_route)
        accelerated._fastest_precision.cache_clear()
        return tried

    yield replace
    accelerated._fastest_precision.cache_clear()


@pytest.mark.parametrize("quality", ["draft", "balanced"])
def test_bfloat16_is_left_to_processors_that_are_faster_with_it(ball, processor, quality):
    half = QUALITIES[quality]
    tried = processor(bf16=8.4, fp32=54.8)
    slow, exact = (seen(ball, shortcuts) for shortcuts in (half, dataclasses.replace(half, matmul="fp32")))
    np.testing.assert_array_equal(slow.rgb, exact.rgb)
    assert sorted(tried) == ["bf16", "fp32"]
    processor(bf16=460.0, fp32=230.0)
    assert not np.array_equal(seen(ball, half).rgb, exact.rgb)


def test_a_processor_is_tried_once_and_only_where_bfloat16_is_asked_for(ball, processor):
    tried = processor(bf16=1.0, fp32=2.0)
    seen(ball, Shortcuts())
    seen(ball, GRID)
    assert not tried
    for _ in range(3):
        seen(ball, QUALITIES["balanced"])
    assert len(tried) == 2


def test_one_pixel_and_rays_that_only_graze_the_box(ball):
    one = seen(ball, QUALITIES["balanced"], camera=Camera("PINHOLE", 1, 1, [2.0, 2.0, 0.5, 0.5]))
    assert one.rgb.shape == (1, 1, 3)
    assert np.isfinite(one.rgb).all()
    # A camera in the plane of the box's right face, looking along it.
    pose = look_at(np.array([0.2, 0.0, 0.8]), np.array([0.2, 0.0, 0.0]))
    grazing = seen(ball, QUALITIES["balanced"], pose, background=0.5)
    full = seen(ball, Shortcuts(), pose, background=0.5)
    assert np.isfinite(grazing.rgb).all()
    assert np.abs(grazing.alpha - full.alpha).mean() < 0.02


@pytest.mark.parametrize(("head", "predicted"), [(False, False), (True, False), (True, True)])
def test_normals_of_opaque_rays_are_those_of_the_full_evaluation(head, predicted):
    model = ball_model(normals=head)
    full = seen(model, Shortcuts(predicted_normals=predicted), normals=True)
    few = dataclasses.replace(GRID, opaque_normals=True, color_bound=1e-3, predicted_normals=predicted)
    ours = seen(model, few, normals=True)
    assert full.normals is not None
    assert ours.normals is not None
    both = np.isfinite(full.normals[..., 0]) & np.isfinite(ours.normals[..., 0])
    assert both.mean() > 0.1
    assert (np.isfinite(ours.normals[..., 0]) == (ours.alpha > 0.5)).mean() > 0.999
    assert np.median((full.normals * ours.normals).sum(-1)[both]) > 0.98


@pytest.mark.parametrize("few", [Shortcuts(), GRID])
def test_the_density_s_normals_are_shown_unless_predicted_ones_are_asked_for(few):
    """The ball's point outwards; the layer that predicts others was never trained."""
    model = ball_model(normals=True)
    ours = seen(model, few, normals=True).normals
    other = seen(model, dataclasses.replace(few, predicted_normals=True), normals=True).normals
    towards = FRONT.translation / np.linalg.norm(FRONT.translation)
    assert np.nanmean(ours @ towards) > 0.5
    assert np.nanmean((ours * other).sum(-1)) < 0.5


def test_each_code_has_its_own_grid(ball):
    moved = PriorModel(ball.config, 2)
    moved.load_state_dict(ball.state_dict())
    with torch.no_grad():  # the second code empties the head: it only acts on the densities
        for network in (moved.proposal, moved.nerf):
            for layer in network.conditioned():
                layer.code_weight.zero_()
            network.density.code_weight[:, 0] = 1
        moved.codes[0].zero_()
        moved.codes[1] = torch.tensor([-1e3, 0.0, 0.0])
    assert seen(moved, GRID, code=0).alpha.max() > 0.9
    assert seen(moved, GRID, code=1).alpha.max() < 1e-3


def test_levels_that_are_left_out_change_nothing_that_they_did_not_carry(ball):
    config = dataclasses.replace(ball.config, levels=6)
    wider = PriorModel(config, 2)
    values = dict(ball.state_dict())
    for name in ("proposal.layers.0.weight", "nerf.layers.0.weight"):
        weight = values[name].view(-1, 2, 4, 21)
        values[name] = torch.nn.functional.pad(weight, (0, 0, 0, 2)).reshape(len(weight), -1)
    wider.load_state_dict(values)
    np.testing.assert_allclose(seen(wider, Shortcuts(levels=4)).rgb, seen(ball, Shortcuts()).rgb, atol=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"occupancy": -1},
        {"skipped_rounds": 1},
        {"sample_share": 0.0},
        {"weight_bound": 1.0},
        {"short": -0.1},
        {"matmul": "fp16"},
    ],
)
def test_what_cannot_be_is_refused_by_its_field(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Shortcuts(**wrong)


@pytest.mark.parametrize("quality", list(QUALITIES))
def test_a_head_that_never_had_a_prior_is_rendered_alike(ball, quality):
    """It has a row of codes of no numbers (preface.model.fitting.heads.head_from_scratch)."""
    folded = fold(ball, ball.codes[0])
    alone = PriorModel(folded.config, 1)
    alone.load_state_dict({**folded.state_dict(), "codes": torch.zeros(1, 0)})
    render = accelerate(alone, None, SPACE, QUALITIES[quality])
    image = render_image(render, SPACE, CAMERA, FRONT, rays_at_a_time=4096)
    assert decibels(image, seen(ball, QUALITIES[quality])) > 60
