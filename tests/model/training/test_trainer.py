"""One step: its gradient whatever the parts, its clipping, Adam, and what it does with what is not finite."""

from dataclasses import replace

import numpy as np
import pytest
import small_runs
import torch
from torch import nn

from preface.model.model import PriorModel
from preface.model.training.configuration import TrainingConfig
from preface.model.training.prior_loss import jitter, prior_terms, renderer
from preface.model.training.trainer import (
    LossTerm,
    NonFiniteError,
    Options,
    ParameterSet,
    Trainer,
    part_size,
)
from preface.shards import Dataset, Loader, PaperPattern

EPS, BETAS = 1e-8, (0.9, 0.999)


def constant(rate):
    return lambda step: rate


class Line:
    """y = a x + b on batches of the balls' red channel, as a model without rays."""

    def __init__(self, rate=0.1, clips=(None, None), terms=None, micro_rays=2**31):
        self.a, self.b = nn.Parameter(torch.tensor([0.5])), nn.Parameter(torch.tensor([0.25]))
        sets = [
            ParameterSet("slope", {"a": self.a}, constant(rate), clips[0]),
            ParameterSet("offset", {"b": self.b}, constant(rate), clips[1]),
        ]
        terms = terms or [
            LossTerm("square", 1.0, lambda y, part: ((y - part.batch.rgba[:, 1]) ** 2).mean()),
        ]
        options = Options(BETAS, EPS, micro_rays)
        self.trainer = Trainer(sets, terms, lambda part: self.a * part.batch.rgba[:, 0] + self.b, options, 12)


@pytest.fixture(scope="module")
def batch(balls):
    with Dataset(balls) as dataset:
        pattern = PaperPattern(dataset.index("train"), 7, identities=3, views=4, rays=16)
        yield Loader(dataset, pattern, scale=dataset.manifest.scene_scale).batch(0)


def test_steps_are_those_of_adam_in_float64_with_each_set_clipped_by_itself(batch):
    clips = (0.05, 1e6)
    line = Line(clips=clips)
    x, y = batch.rgba[:, 0].double().numpy(), batch.rgba[:, 1].double().numpy()
    values, first, second = np.array([0.5, 0.25]), np.zeros(2), np.zeros(2)
    for step in range(5):
        line.trainer.step(step, batch)
        residual = values[0] * x + values[1] - y
        gradient = np.array([(2 * residual * x).mean(), (2 * residual).mean()])
        gradient = np.sign(gradient) * np.minimum(np.abs(gradient), clips)
        first = BETAS[0] * first + (1 - BETAS[0]) * gradient
        second = BETAS[1] * second + (1 - BETAS[1]) * gradient**2
        corrected = [first / (1 - BETAS[0] ** (step + 1)), second / (1 - BETAS[1] ** (step + 1))]
        values -= 0.1 * corrected[0] / (np.sqrt(corrected[1]) + EPS)
        np.testing.assert_allclose([line.a.item(), line.b.item()], values, rtol=2e-5)


def prior_trainer(balls, micro_rays, seed=3):
    dataset = Dataset(balls)
    torch.manual_seed(seed)
    model = PriorModel(small_runs.MODEL, 3)
    names = {id(p): n for n, p in model.named_parameters()}
    sets = [
        ParameterSet(name, {names[id(p)]: p for p in group}, constant(1e-3), None)
        for name, group in model.parameter_groups().items()
    ]
    pattern = PaperPattern(dataset.index("train"), 7, identities=3, views=4, rays=16)
    loader = Loader(dataset, pattern, scale=dataset.manifest.scene_scale)
    render = renderer(model, torch.arange(4), torch.zeros(24, 2), 6, seed=5, steps=10)
    terms = prior_terms("black", TrainingConfig())
    return Trainer(sets, terms, render, Options(micro_rays=micro_rays), pattern.groups), model, loader


def gradients(balls, micro_rays):
    trainer, model, loader = prior_trainer(balls, micro_rays)
    outcome = trainer.step(0, loader.batch(0))
    return outcome, {name: p.grad.clone() for name, p in model.named_parameters()}


@pytest.mark.parametrize("micro_rays", [64, 48, 16, 4, 5])
def test_parts_give_the_gradient_and_the_losses_of_the_whole(balls, micro_rays):
    whole, expected = gradients(balls, 2**31)
    parts, found = gradients(balls, micro_rays)
    assert parts.terms == pytest.approx(whole.terms, rel=1e-5, abs=1e-9)
    for name, gradient in expected.items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-4, atol=1e-6 * float(gradient.abs().max()))


@pytest.mark.parametrize(
    ("rays", "group", "micro", "size"),
    [
        (192, 16, 64, 64),
        (192, 16, 70, 64),
        (192, 16, 15, 8),
        (192, 16, 1, 1),
        (192, 16, 10**9, 192),
        (5, 5, 4, 1),
    ],
)
def test_parts_are_whole_groups_or_divisors_of_one(rays, group, micro, size):
    assert part_size(rays, group, micro) == size


def test_noise_of_a_ray_does_not_depend_on_the_part_it_is_in():
    whole = jitter(11, 4, 0, 100, 3)
    np.testing.assert_array_equal(jitter(11, 4, 37, 20, 3), whole[37:57])
    assert whole.min() >= 0
    assert whole.max() < 1
    assert not np.array_equal(whole, jitter(11, 5, 0, 100, 3))
    assert not np.array_equal(whole, jitter(12, 4, 0, 100, 3))
    assert abs(whole.mean() - 0.5) < 0.1


def test_a_term_without_weight_is_measured_and_teaches_nothing(batch):
    terms = [
        LossTerm("none", 0.0, lambda y, part: (y * 5).mean()),
        LossTerm("square", 1.0, lambda y, part: (y**2).mean()),
    ]
    both, alone = Line(terms=terms), Line(terms=terms[1:])
    outcome = both.trainer.step(0, batch)
    alone.trainer.step(0, batch)
    assert both.a.item() == alone.a.item()
    expected = 5 * (0.5 * batch.rgba[:, 0].double() + 0.25).mean().item()
    assert outcome.terms["none"] == pytest.approx(expected, rel=1e-5)
    assert outcome.loss == outcome.terms["square"]


def test_a_loss_that_is_not_finite_is_named_and_changes_nothing(batch):
    terms = [
        LossTerm("fine", 1.0, lambda y, part: y.mean()),
        LossTerm("broken", 1.0, lambda y, part: (y / 0).mean()),
    ]
    line = Line(terms=terms)
    with pytest.raises(NonFiniteError, match=r"step 9: loss is not finite: broken"):
        line.trainer.step(9, batch)
    assert (line.a.item(), line.b.item()) == (0.5, 0.25)


def test_a_gradient_that_is_not_finite_names_its_parameter(batch):
    terms = [LossTerm("root", 1.0, lambda y, part: (y - y.detach()).abs().sqrt().mean())]
    line = Line(terms=terms)
    with pytest.raises(NonFiniteError, match=r"gradient of is not finite: a"):
        line.trainer.step(0, batch)
    assert (line.a.item(), line.b.item()) == (0.5, 0.25)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e12, 1e25])
def test_clipping_holds_for_gradients_whose_squares_leave_float32(batch, scale):
    terms = [LossTerm("linear", 1.0, lambda y, part: (y * scale).mean())]
    line = Line(clips=(1e-3, 1e-3), terms=terms)
    outcome = line.trainer.step(0, batch)
    slope = scale * batch.rgba[:, 0].double().mean().item()
    assert outcome.norms["slope"] == pytest.approx(slope, rel=1e-5)
    assert line.a.grad.item() == pytest.approx(min(slope, 1e-3), rel=1e-5)


def test_rays_that_all_miss_the_box_teach_nothing_and_do_no_harm(balls):
    trainer, model, loader = prior_trainer(balls, 64)
    before = {name: p.clone() for name, p in model.named_parameters()}
    batch = loader.batch(0)
    outcome = trainer.step(0, replace(batch, hit=torch.zeros_like(batch.hit)))
    assert outcome.terms["hit"] == 0
    assert outcome.norms == {"proposal": 0, "nerf": 0, "codes": 0}
    for name, parameter in model.named_parameters():
        torch.testing.assert_close(parameter, before[name], rtol=0, atol=0)


def test_only_codes_of_the_batch_are_taught(balls):
    trainer, model, loader = prior_trainer(balls, 64)
    batch = loader.batch(0)
    only = replace(batch, identity=torch.full_like(batch.identity, 1))
    trainer.step(0, only)
    norms = model.codes.grad.norm(dim=1)
    assert norms[1] > 0
    assert norms[0] == norms[2] == 0


def test_a_parameter_in_two_sets_is_refused():
    parameter = nn.Parameter(torch.zeros(1))
    sets = [ParameterSet(name, {name: parameter}, constant(1.0), None) for name in "ab"]
    with pytest.raises(ValueError, match="sets"):
        Trainer(sets, [LossTerm("one", 1.0, lambda y, part: y)], lambda part: None, Options(), 1)


def test_state_of_other_parameters_is_refused(batch):
    line = Line()
    line.trainer.step(0, batch)
    state = line.trainer.state()
    with pytest.raises(ValueError, match="exp_avg/a"):
        Line().trainer.load_state({k: v for k, v in state.items() if k != "exp_avg/a"})
    with pytest.raises(ValueError, match="exp_avg/b"):
        Line().trainer.load_state({**state, "exp_avg/b": torch.zeros(3)})
