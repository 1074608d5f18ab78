"""Finetuning: what is trained, what is asked of it, and derivatives that reach where they must."""

from dataclasses import replace

import numpy as np
import pytest
import small_fits
import small_runs
import torch

from preface.model.fitting.finetuning import finetuning_terms, finetuning_trainer, parameter_sets
from preface.model.fitting.heads import (
    code_of,
    head_from_scratch,
    head_of_prior,
    with_predicted_normals,
)
from preface.model.fitting.observations import grids
from preface.model.rays import Rays
from preface.model.training.prior_files import read_prior
from preface.model.training.trainer import Part

CPU = torch.device("cpu")


@pytest.fixture
def head(prior):
    networks = read_prior(prior).load_model()
    return with_predicted_normals(head_of_prior(networks, networks.codes.detach().mean(dim=0)), 0)


def test_the_layer_for_normals_is_added_without_changing_what_is_seen(prior, head, data):
    networks = read_prior(prior).load_model()
    without = head_of_prior(networks, networks.codes.detach().mean(dim=0))
    rays = Rays.from_batch(grids(data, 8)[0])
    with torch.no_grad():
        seen, before = head(rays, code_of(head), normals=True), without(rays, code_of(without))
    torch.testing.assert_close(seen.rgb, before.rgb, atol=1e-5, rtol=0)
    lengths = seen.normals_pred.norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))
    again, other = (with_predicted_normals(without, seed).nerf.normals.weight for seed in (0, 1))
    assert torch.equal(again, head.nerf.normals.weight)
    assert not torch.equal(other, again)
    assert with_predicted_normals(head, 5) is head


def values_of(terms, model, data):
    """The terms of a grid of rays, with their graphs."""
    batch = grids(data, 8)[0]
    seen = model(Rays.from_batch(batch), code_of(model), normals=True)
    return {term.name: (term.weight, term.value(seen, Part(0, batch, 0, 1))) for term in terms}


def test_the_objective_is_the_papers(head, data):
    values = values_of(finetuning_terms(head, small_fits.FINETUNING), head, data)
    weights = {name: weight for name, (weight, _) in values.items() if weight}
    assert weights == {"l1": 1, "interlevel": 1, "normals": 1e-3, "view_weights": 1e-4}
    none = replace(small_fits.FINETUNING, normals=0.0, view_weights=0.0)
    assert {"normals", "view_weights"}.isdisjoint(values_of(finetuning_terms(head, none), head, data))


def test_opacity_is_held_against_the_mask_where_it_is_asked_for(head, data):
    asked = replace(small_fits.FINETUNING, opacity=0.5)
    weight, value = values_of(finetuning_terms(head, asked), head, data)["opacity"]
    batch = grids(data, 8)[0]
    seen = head(Rays.from_batch(batch), code_of(head))
    mask = np.where(batch.hit[:, 0].numpy(), batch.alpha[:, 0].numpy().astype(np.float64), 0.0)
    assert weight == 0.5
    assert 0 < mask.mean() < 1
    np.testing.assert_allclose(
        float(value.detach()), np.abs(seen.acc.detach().numpy() - mask).mean(), rtol=1e-5
    )


@pytest.mark.parametrize("normals", [0.0, 1e-3], ids=["alone", "beside predicted normals"])
def test_normals_that_face_away_are_penalised_where_it_is_asked_for(prior, data, correction, normals):
    """By the directions that are rendered, those of corrected cameras, as a mean over all rays."""
    networks = read_prior(prior).load_model()
    head = head_of_prior(networks, networks.codes.detach().mean(dim=0))
    head = with_predicted_normals(head, 0) if normals else head
    with torch.no_grad():
        correction.cameras.rotation[:, 1] = 0.2
    asked = replace(small_fits.FINETUNING, rays=96, orientation=0.1, normals=normals)
    trainer, loader = finetuning_trainer(
        head, asked, 4, data, 0, 32, CPU, knows_heads=True, correction=correction
    )
    batch = loader.batch(0)
    (term,) = [one for one in trainer.terms if one.name == "orientation"]
    part = Part(0, batch, 0, 1)
    seen = trainer.render(part)
    value = term.value(seen, part)
    rays = correction.apply(Rays.from_batch(batch), batch.view)
    hit = rays.hit[:, 0].numpy()
    assert 0 < hit.sum() < len(hit)
    weights, found, ahead = (
        x.detach().double().numpy()
        for x in (seen.levels[-1].weights, seen.normals, rays.viewdirs[rays.hit[:, 0]])
    )
    away = np.maximum((found * ahead[:, None]).sum(axis=-1), 0)
    assert term.weight == 0.1
    assert float(value.detach()) == pytest.approx((weights * away**2).sum() / len(hit), rel=1e-5)
    (gradient,) = torch.autograd.grad(value, head.nerf.layers[0].weight)
    assert gradient.any()
    assert trainer.step(0, batch).terms["orientation"] > 0


def test_the_view_penalty_is_on_the_columns_of_the_direction_alone(head, data):
    _, value = values_of(finetuning_terms(head, small_fits.FINETUNING), head, data)["view_weights"]
    columns = 3 + 6 * head.config.view_levels
    weight = head.nerf.view.weight
    direction = weight.detach().double()[:, -columns:]
    assert float(value.detach()) == pytest.approx(float((direction**2).sum()), rel=1e-6)
    (gradient,) = torch.autograd.grad(value, weight)
    assert not gradient[:, :-columns].any()
    torch.testing.assert_close(gradient[:, -columns:], 2 * weight.detach()[:, -columns:])
    assert weight.shape[1] == head.config.bottleneck + columns


def test_the_normals_loss_reaches_the_density_through_second_derivatives(head, data):
    """Against central differences, in a direction of the weights that only the analytic normals feel."""
    terms = finetuning_terms(head, small_fits.FINETUNING)
    parameter = head.nerf.density.weight
    _, value = values_of(terms, head, data)["normals"]
    (gradient,) = torch.autograd.grad(value, parameter)
    assert gradient.any()
    direction = gradient / gradient.norm()
    step, found = 2e-3 * float(parameter.detach().norm()), []
    for sign in (1, -1):
        with torch.no_grad():
            parameter += sign * step * direction
        found.append(float(values_of(terms, head, data)["normals"][1].detach()))
        with torch.no_grad():
            parameter -= sign * step * direction
    assert (found[0] - found[1]) / (2 * step) == pytest.approx(float(gradient.norm()), rel=0.05)


def test_all_networks_and_the_code_are_trained_unless_it_is_frozen(head):
    config = small_fits.FINETUNING
    sets = {one.name: one for one in parameter_sets(head, config, 10)}
    assert set(sets) == {"proposal", "nerf", "codes"}
    assert sum(len(one.parameters) for one in sets.values()) == len(list(head.parameters()))
    assert sets["nerf"].rate(0) == pytest.approx(config.rate)
    assert sets["nerf"].rate(10) == pytest.approx(config.rate_last)
    frozen = parameter_sets(head, replace(config, frozen_latent=True), 10)
    assert {one.name for one in frozen} == {"proposal", "nerf"}
    assert not head.codes.requires_grad


def test_finetuning_brings_the_views_closer(head, data):
    before = small_fits.psnr_of(head, data, data.train.pairs)
    config = replace(small_fits.FINETUNING, rays=128, foreground_share=0.5)
    code = head.codes.detach().clone()
    trainer, loader = finetuning_trainer(head, config, 25, data, 0, 4096, CPU, knows_heads=True)
    for step in range(25):
        trainer.step(step, loader.batch(step))
    assert small_fits.psnr_of(head, data, data.train.pairs) > before + 2
    assert not torch.equal(head.codes, code)


def test_a_model_from_random_weights_has_no_code_and_is_the_seeds():
    one, same, other = (head_from_scratch(small_runs.MODEL, seed) for seed in (0, 0, 1))
    assert one.codes.shape == (1, 0)
    assert code_of(one) is None
    for name, value in one.state_dict().items():
        assert torch.equal(value, same.state_dict()[name])
    assert not torch.equal(one.nerf.color.weight, other.nerf.color.weight)
    assert {s.name for s in parameter_sets(one, small_fits.FINETUNING, 5)} == {"proposal", "nerf"}


# ----------------------------------------------------------------------------------------- cameras


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("name", ["translation", "rotation"])
def test_colours_have_derivatives_by_the_cameras(head, data, correction, normals, name):
    """Against central differences; samples are held where they are, as they have no derivatives."""
    single = replace(head.config, samples=(16,), dilation_bias=0.0, dilation_multiplier=0.0)
    model = type(head)(single, 1)
    model.load_state_dict(head.state_dict())
    batch = grids(data, 8)[0]
    rays = Rays.from_batch(batch)
    weights = torch.rand(len(batch), 3, generator=torch.Generator().manual_seed(0)) * batch.alpha

    def total():
        moved = correction.apply(rays, batch.view)
        kept = replace(moved, near=rays.near, far=rays.far, hit=rays.hit)
        return (model(kept, code_of(model), normals=normals).rgb * weights).sum()

    parameter = getattr(correction.cameras, name)
    (gradient,) = torch.autograd.grad(total(), parameter)
    assert not gradient[1].any()
    direction = gradient / gradient.norm()
    step, found = 3e-4, []
    for sign in (1, -1):
        with torch.no_grad():
            parameter += sign * step * direction
            found.append(float(total()))
            parameter -= sign * step * direction
    assert (found[0] - found[1]) / (2 * step) == pytest.approx(float(gradient.norm()), rel=0.05)
