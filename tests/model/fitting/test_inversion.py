"""Inversion: patches where they should be, codes where they start, and networks that stay as they are."""

from dataclasses import replace

import ball_heads
import pytest
import small_fits
import torch

from preface.artifacts import ArtifactError
from preface.model.fitting.configuration import LEAST_PATCH
from preface.model.fitting.heads import head_of_prior
from preface.model.fitting.inversion import inversion_trainer, patch_size
from preface.model.fitting.observations import grids, observe
from preface.model.fitting.starts import start_code
from preface.model.metrics.lpips import LEAST
from preface.model.training.prior_files import read_prior
from preface.shards import Dataset

CPU = torch.device("cpu")


@pytest.fixture
def data(balls, prior):
    with Dataset(balls) as dataset:
        yield observe(dataset, small_fits.UNSEEN, small_fits.VIEWS, read_prior(prior))


@pytest.fixture
def networks(prior):
    return read_prior(prior).load_model()


# ----------------------------------------------------------------------------------------- patches


def test_the_least_patches_are_what_lpips_takes():
    assert LEAST_PATCH == LEAST


def test_views_that_hold_no_patch_get_smaller_ones_or_are_refused(data):
    assert patch_size(replace(small_fits.INVERSION, patch=100), data) == ball_heads.WIDTH
    lpips = replace(small_fits.INVERSION, patch=32, lpips=0.2, network="alex")
    with pytest.raises(ArtifactError, match=r"24x32 hold no patch of 31x31.*--inversion\.lpips 0"):
        patch_size(lpips, data)
    assert patch_size(replace(lpips, network="vgg"), data) == ball_heads.WIDTH


# ------------------------------------------------------------------------------------------ starts


def test_codes_start_where_the_ablation_says(networks, data):
    codes = networks.codes.detach()
    found = {name: start_code(networks, name, [], 3) for name in ("zeros", "mean", "noise")}
    assert not found["zeros"].any()
    torch.testing.assert_close(found["mean"], codes.mean(dim=0))
    assert torch.equal(found["noise"], start_code(networks, "noise", [], 3))
    assert not torch.equal(found["noise"], start_code(networks, "noise", [], 4))
    many = torch.stack([start_code(networks, "noise", [], seed) for seed in range(300)])
    assert float(many.square().mean().sqrt()) == pytest.approx(float(codes.square().mean().sqrt()), rel=0.1)


def test_the_nearest_of_somebody_in_the_prior_is_himself(balls, networks):
    with Dataset(balls) as dataset:
        for row, name in enumerate(("id0000", "id0001", "id0002")):
            views = grids(observe(dataset, name, ("camera0", "camera3"), None), 12)
            assert torch.equal(start_code(networks, "nearest", views, 0), networks.codes[row])
            assert not torch.equal(start_code(networks, "furthest", views, 0), networks.codes[row])


# --------------------------------------------------------------------------------------- inversion


def test_a_code_is_found_with_networks_that_stay_as_they_are(balls, networks):
    """Of somebody whom the prior knows, from nothing: towards his views, the ones that are not fitted to as well."""
    head = head_of_prior(networks, torch.zeros(networks.config.latent))
    before = {name: value.clone() for name, value in head.state_dict().items()}
    with Dataset(balls) as dataset:
        data = observe(dataset, "id0000", small_fits.VIEWS, None)
        found = [small_fits.psnr_of(head, data, data.held_out.pairs)]
        trainer, loader = inversion_trainer(
            head, replace(small_fits.INVERSION, rate=5e-2), data, 0, 4096, CPU
        )
        for step in range(20):
            trainer.step(step, loader.batch(step))
        found.append(small_fits.psnr_of(head, data, data.held_out.pairs))
    assert found[1] > found[0] + 1
    for name, value in head.state_dict().items():
        assert torch.equal(value, before[name]) == (name != "codes"), name
    assert all(parameter.grad is None for name, parameter in head.named_parameters() if name != "codes")
    assert not any(p.grad is not None for p in networks.parameters())


def test_lpips_is_asked_of_whole_patches_however_few_rays_fit(networks, data):
    config = replace(small_fits.INVERSION, patches=2, patch=16, lpips=0.2)
    terms = []
    for micro_rays in (1, 10_000):
        head = head_of_prior(networks, networks.codes[0].detach())
        trainer, loader = inversion_trainer(head, config, data, 0, micro_rays, CPU)
        terms.append(trainer.step(0, loader.batch(0)).terms)
    assert terms[0]["lpips"] > 0
    for name, value in terms[0].items():
        assert value == pytest.approx(terms[1][name], rel=1e-4), name


def test_missing_weights_of_lpips_name_the_command_that_gets_them(networks, data, monkeypatch, tmp_path):
    monkeypatch.setenv("PREFACE_CACHE", str(tmp_path))
    config = replace(small_fits.INVERSION, patch=16, lpips=0.2)
    with pytest.raises(ArtifactError, match="lpips_weights"):
        inversion_trainer(head_of_prior(networks, networks.codes[0].detach()), config, data, 0, 512, CPU)


def test_heads_of_unmasked_priors_are_clipped_to_the_box_on_black(balls, tmp_path):
    from preface.model.model import PriorModel
    from preface.model.rays import Rays

    base = read_model_config()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        unmasked = PriorModel(replace(base, background="modelled", clip_to_box=False), 2)
    head = head_of_prior(unmasked, unmasked.codes[1].detach())
    with Dataset(balls) as dataset:
        batch = grids(observe(dataset, "id0000", ("camera0",), None), 12)[0]
    with torch.no_grad():
        seen = head(Rays.from_batch(batch), head.codes)
    assert (head.config.background, head.config.clip_to_box) == ("black", True)
    missed = ~batch.hit[:, 0]
    assert missed.any()
    assert not seen.rgb[missed].any()
    assert torch.equal(head.codes[0], unmasked.codes[1])


def read_model_config():
    import small_runs

    return small_runs.MODEL
