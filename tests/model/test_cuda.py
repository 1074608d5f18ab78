"""What a processor computes, a CUDA device computes too: values, gradients, a step, a render and LPIPS.

Each test holds a device against the CPU, and is there twice: with CUDA, where there is some, and with the CPU itself,
which shows that the test does what it says.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from test_model import SMALL, model_of, some_rays

from preface.geometry import Box
from preface.model import losses
from preface.model.metrics.lpips_weights import load_lpips
from preface.model.rendering.image import Space, render_image
from preface.model.rendering.paths import framing_camera, look_at
from preface.model.rendering.shortcuts import Shortcuts, accelerate
from preface.model.training.logs import read_log

sys.path[:0] = [str(Path(__file__).parent / "training")]

CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
DEVICES = ["cpu", pytest.param("cuda", marks=CUDA)]
SPACE = Space(Box(np.array([-0.2, -0.25, -0.2]), np.array([0.2, 0.25, 0.2])), 4.0)
GRID = Shortcuts(folded=True, occupancy=24, skipped_rounds=2, sample_share=0.75, opaque_normals=True)


def loss_of(rendered):
    """Something of everything that a render gives."""
    last = rendered.levels[-1]
    proposals = [(level.sdist, level.weights) for level in rendered.levels[:-1]]
    total = losses.l1(rendered.rgb, torch.full_like(rendered.rgb, 0.7)) + rendered.acc.mean()
    total = total + losses.interlevel(last.sdist, last.weights, proposals)
    if rendered.normals is not None:
        total = total + losses.predicted_normal(last.weights, rendered.normals, rendered.normals_pred)
    return total


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("device", DEVICES)
def test_values_and_gradients_are_those_of_the_cpu(device, normals):
    config = dataclasses.replace(SMALL, predicted_normals=normals)
    hit = torch.arange(96)[:, None] % 5 > 0
    jitter = torch.rand(96, len(config.samples), generator=torch.Generator().manual_seed(3))
    found = []
    for place in ("cpu", device):
        model = model_of(config).to(place)
        rendered = model(
            some_rays(96, hit=hit).to(place),
            model.codes[:3],
            train_frac=0.5,
            jitter=jitter.to(place),
            normals=normals,
        )
        loss_of(rendered).backward()
        assert rendered.rgb.device.type == place
        found.append((rendered, {name: p.grad.cpu() for name, p in model.named_parameters()}))
    (ours, gradients), (theirs, same) = found
    for name in ("rgb", "acc", "distance_mean", *(("normals", "normals_pred") if normals else ())):
        there = getattr(theirs, name).cpu()
        torch.testing.assert_close(getattr(ours, name), there, rtol=1e-3, atol=1e-4)
    for name, gradient in gradients.items():
        off = float((gradient - same[name]).norm() / gradient.norm())
        assert gradient.any(), name
        assert off < 1e-3, name


@pytest.mark.parametrize("device", DEVICES)
def test_a_run_takes_the_steps_of_the_cpu(device, tmp_path):
    """From shards to the checkpoint: batches, two steps, and validation."""
    import ball_heads
    from small_runs import config, quiet

    from preface.model.training.prior import train_prior
    from preface.model.training.prior_files import read_prior

    (tmp_path / "balls").mkdir()
    ball_heads.write_dataset(tmp_path / "balls")
    logs, quality = [], []
    for number, place in enumerate(("cpu", device)):
        run = {"device": place, "log_every": 1, "products": "auto", "validate_views": 1, "final_views": 1}
        output = tmp_path / f"{number}"
        train_prior(config(tmp_path / "balls", output, {"steps": 2}, run), quiet)
        logs.append(read_log(output / "log.jsonl", "train"))
        quality.append(read_prior(output).validation["psnr"])
    assert [entry["step"] for entry in logs[1]] == [1, 2]
    for ours, theirs in zip(*logs, strict=True):
        for term in ("loss", "l1", "interlevel"):
            assert theirs[term] == pytest.approx(ours[term], rel=2e-3), term
        assert theirs["gradient_norm"] == pytest.approx(ours["gradient_norm"], rel=1e-2)
    assert quality[1] == pytest.approx(quality[0], abs=0.05)


@pytest.mark.parametrize("shortcuts", [Shortcuts(), GRID], ids=["whole", "accelerated"])
@pytest.mark.parametrize("device", DEVICES)
def test_an_image_is_that_of_the_cpu(device, shortcuts):
    camera, pose = (
        framing_camera(SPACE.box.half_sides, 0.97, 24, 32),
        look_at(np.array([0.3, 0.15, 0.9]), np.zeros(3)),
    )
    images = []
    for place in ("cpu", device):
        model = model_of().to(place)
        with torch.no_grad():
            model.nerf.density.weight.mul_(10)
        rays = accelerate(model, model.codes[0].detach(), SPACE, shortcuts, normals=True)
        images.append(render_image(rays, SPACE, camera, pose, rays_at_a_time=512, device=place))
    ours, theirs = images
    assert ours.alpha.max() > 0.5
    for name in ("rgb", "alpha"):
        off = np.abs(getattr(ours, name) - getattr(theirs, name))
        assert off.mean() < 1e-4, name  # a sample that just counts on one of them may not on the other
        assert np.quantile(off, 0.99) < 1e-3, name


@pytest.mark.parametrize("network", ["vgg", "alex"])
@pytest.mark.parametrize("device", DEVICES)
def test_lpips_and_its_gradient_are_those_of_the_cpu(device, network):
    """To the digits of TF32, which convolutions have on CUDA unless it is switched off."""
    numbers = torch.Generator().manual_seed(1)
    truth = torch.rand(2, 3, 64, 48, generator=numbers)
    image = (truth + 0.2 * torch.rand(truth.shape, generator=numbers)).clamp(0, 1)
    found = []
    for place in ("cpu", device):
        there = image.detach().to(place).requires_grad_()
        distance = load_lpips(network).to(place)(there, truth.to(place))
        (gradient,) = torch.autograd.grad(distance.sum(), there)
        found.append((distance.detach().cpu(), gradient.cpu()))
    (ours, gradient), (theirs, same) = found
    assert (ours > 0.01).all()
    torch.testing.assert_close(theirs, ours, rtol=1e-2, atol=1e-4)
    assert float((same - gradient).norm() / gradient.norm()) < 5e-2
