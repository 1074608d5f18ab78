"""Proposals that are taught between and beyond the views: which rays, who learns, and what it is good for."""

from dataclasses import replace

import numpy as np
import pytest
import small_fits
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from preface.geometry import Box
from preface.model import losses
from preface.model.fitting.elsewhere import interlevel_elsewhere, turned_about
from preface.model.fitting.finetuning import finetuning_trainer
from preface.model.fitting.heads import code_of, head_of_prior
from preface.model.rays import Rays
from preface.model.training.data import WholeViews
from preface.model.training.prior_files import read_prior
from preface.model.training.trainer import Part
from preface.shards import Loader

CPU = torch.device("cpu")
BOX = Box(np.array([-0.2, -0.25, -0.3]), np.array([0.2, 0.25, 0.1]))
SCALE = 4.0


@pytest.fixture
def head(prior):
    networks = read_prior(prior).load_model()
    return head_of_prior(networks, networks.codes.detach().mean(dim=0))


def rays_towards(points) -> Rays:
    """From a camera before the face to points [n, 3], scene units."""
    origins = torch.tensor([[0.1, 0.2, 4.0]]).expand(len(points), 3)
    directions = points - origins
    ones = torch.ones(len(points), 1)
    viewdirs = torch.nn.functional.normalize(directions, dim=-1)
    return Rays(origins, directions, viewdirs, 1e-3 * ones, 0.5 * ones, 1.5 * ones, ones.bool())


@settings(deadline=None)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.5, 0.5))
def test_turned_rays_are_those_of_a_camera_that_was_turned(sideways, tilt, height):
    rays = rays_towards(torch.tensor([[0.05, height, -0.2], [0.3, 0.1, 0.0], [3.0, 9.0, 0.0]]))
    turned = turned_about(rays, torch.tensor([[sideways, tilt]]).expand(3, 2), BOX, SCALE)
    centre = torch.tensor([0.0, 0.0, -0.4])
    before, after = rays.origins - centre, turned.origins - centre
    torch.testing.assert_close(after.norm(dim=-1), before.norm(dim=-1))
    torch.testing.assert_close((after * turned.directions).sum(-1), (before * rays.directions).sum(-1))
    torch.testing.assert_close(turned.viewdirs, torch.nn.functional.normalize(turned.directions, dim=-1))
    near, far, hit = Box(BOX.minimum * SCALE, BOX.maximum * SCALE).intersect(
        turned.origins.numpy(), turned.directions.numpy()
    )
    np.testing.assert_array_equal(turned.hit[:, 0].numpy(), hit)
    assert bool(turned.far.isfinite().all())
    np.testing.assert_allclose(turned.near[turned.hit[:, 0], 0].numpy(), near[hit], rtol=1e-5)
    np.testing.assert_allclose(turned.far[turned.hit[:, 0], 0].numpy(), far[hit], rtol=1e-5)


def test_half_a_turn_is_the_view_from_behind():
    rays = rays_towards(torch.tensor([[0.0, 0.0, -0.4]]))
    turned = turned_about(rays, torch.tensor([[1.0, 0.0]]), BOX, SCALE)
    expected = torch.tensor([[-0.1, 0.2, -0.4 - 4.4]])
    torch.testing.assert_close(turned.origins, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(turned.viewdirs[0, 2] > 0, torch.tensor(True))


def trainer_of(head, data, micro_rays=4096, **changes):
    config = replace(small_fits.FINETUNING, normals=0.0, rays=96, **changes)
    return finetuning_trainer(head, config, 8, data, 0, micro_rays, CPU, knows_heads=True)


def test_only_the_proposal_network_learns_from_them(head, data):
    box = Box(data.scene.box[0], data.scene.box[1])
    term = interlevel_elsewhere(head, box, data.scene.scene_scale, 0.5, 0)
    _, loader = trainer_of(head, data)
    value = term(None, Part(0, loader.batch(0), 0, 1))
    assert float(value.detach()) > 0
    value.backward()
    assert all(p.grad is not None and p.grad.any() for p in head.proposal.parameters())
    assert not any(p.grad.any() for p in head.nerf.parameters() if p.grad is not None)


def test_it_does_not_matter_how_a_step_is_cut(head, data):
    terms = []
    for micro_rays in (96, 32, 7):
        trainer, loader = trainer_of(head, data, micro_rays, elsewhere=0.3, rate=1e-12, rate_last=1e-12)
        terms.append(trainer.step(3, loader.batch(3)).terms["interlevel_elsewhere"])
    assert terms[0] > 0
    assert terms[1:] == pytest.approx([terms[0]] * 2, rel=1e-5)


def test_a_step_whose_rays_all_pass_the_box_teaches_nothing(head, data):
    away = Box(data.scene.box[0] + 50, data.scene.box[0] + 50.001)
    term = interlevel_elsewhere(head, away, data.scene.scene_scale, 0.5, 0)
    _, loader = trainer_of(head, data)
    assert float(term(None, Part(0, loader.batch(0), 0, 1)).detach()) == 0


def test_without_being_asked_for_there_is_no_such_term(head, data):
    assert "interlevel_elsewhere" not in {term.name for term in trainer_of(head, data)[0].terms}
    assert "interlevel_elsewhere" in {term.name for term in trainer_of(head, data, elsewhere=0.1)[0].terms}
    without = trainer_of(head, data, elsewhere=0.1, interlevel=0.0)[0]
    assert "interlevel_elsewhere" not in {term.name for term in without.terms}


def missed(head, data) -> float:
    """The interlevel loss of the views that were not fitted to."""
    views = WholeViews(data.held_out, data.held_out.pairs)
    loader = Loader(data.dataset, views, placement="mmap", scale=data.scene.scene_scale)
    found = []
    with torch.no_grad():
        for number in range(len(data.held_out.pairs)):
            rays = Rays.from_batch(loader.batch(number))
            *proposals, last = head.rounds(rays[rays.hit[:, 0].nonzero()[:, 0]], code_of(head))
            known = ((level.sdist, level.weights) for level in proposals)
            found.append(float(losses.interlevel(last.sdist, last.weights, known)))
    return float(np.mean(found))


def test_what_is_taught_elsewhere_holds_in_views_that_were_not_fitted_to(head, data):
    """A density that was sharpened, as finetuning does, which proposals do not know yet."""
    with torch.no_grad():
        head.nerf.density.weight *= 5
        head.nerf.density.bias *= 5
    box = Box(data.scene.box[0], data.scene.box[1])
    term = interlevel_elsewhere(head, box, data.scene.scene_scale, 1.0, 0)
    _, loader = trainer_of(head, data)
    adam = torch.optim.Adam(head.proposal.parameters(), lr=5e-3)
    before = missed(head, data)
    for step in range(40):
        adam.zero_grad()
        term(None, Part(step, loader.batch(step), 0, 1)).backward()
        adam.step()
    assert missed(head, data) < 0.7 * before
