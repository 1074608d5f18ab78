"""The training loop: one step of the prior, of inversion and of finetuning alike.

They differ in what is handed over: which parameters are trained at which rate (`ParameterSet`), what is asked of
the rendered rays (`LossTerm`), and how rays are rendered. Everything random is a function of (seed, step), so that
a step needs its number, the parameters and Adam's moments, and nothing else. On a CPU, with as many threads, a
step taken again is the same bit for bit. On CUDA it is the same to rounding: gradients of rows that are picked out
(codes of identities, rays that meet the box, edges of intervals) are added up there in whatever order they come.

    trainer = Trainer(sets, terms, render, Options(), sampler.groups)
    for step, batch in loader.batches(start, stop):
        outcome = trainer.step(step, batch)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from preface.model.training.ranks import Ranks
from preface.shards import Batch
from preface.shards.samplers import groups_of


class NonFiniteError(RuntimeError):
    """A loss or gradient that is not a number; the parameters are still those of the step before.

    Attributes:
        step: that failed.
        names: the terms, or the parameters whose gradients are not finite.
    """

    def __init__(self, step: int, kind: str, names: Sequence[str]):
        shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
        super().__init__(f"step {step}: {kind} is not finite: {shown}")
        self.step, self.names = step, tuple(names)


@dataclass(frozen=True, eq=False)
class ParameterSet:
    """Parameters that share a rate and are clipped together.

    Attributes:
        name: such as "nerf".
        parameters: by name.
        rate: of a step.
        clip: largest norm of the set's gradient; None does not clip.
    """

    name: str
    parameters: Mapping[str, nn.Parameter]
    rate: Callable[[int], float]
    clip: float | None


@dataclass(frozen=True, eq=False)
class Part:
    """Some rays of a step, as many as memory allows at a time.

    Attributes:
        step: its number.
        batch: the rays.
        first: number of the first of them among all rays of the step, of all processes.
        group: each `group` consecutive rays are of one view.
    """

    step: int
    batch: Batch
    first: int
    group: int


@dataclass(frozen=True, eq=False)
class LossTerm:
    """What is asked of rendered rays.

    Attributes:
        name: of the term in logs and errors.
        weight: in the sum that is minimised; a term of weight 0 is measured only.
        value: of the rays of a part, a mean over them (or what does not depend on rays).
    """

    name: str
    weight: float
    value: Callable[[Any, Part], Tensor]


@dataclass(frozen=True)
class Options:
    """What the loop itself can be told.

    Attributes:
        betas, eps: Adam's. The paper states 0.9 and 0.999, and no eps.
        micro_rays: rays at a time; gradients of all parts are added up. The sum does not depend on it but for
            rounding. Whole groups are kept together where they fit.
    """

    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    micro_rays: int = 2**31


@dataclass(frozen=True)
class Outcome:
    """What a step measured before it changed the parameters.

    Attributes:
        step: its number.
        rays: of all processes.
        loss: the weighted sum.
        terms: value by name.
        norms: of the gradients before clipping, by set.
        rates: by set.
    """

    step: int
    rays: int
    loss: float
    terms: Mapping[str, float]
    norms: Mapping[str, float]
    rates: Mapping[str, float] = field(default_factory=dict)


class Trainer:
    """Takes steps.

    Args:
        sets: disjoint. All their gradients lie in one buffer, which is added up over the processes at once.
        terms: with different names.
        render: rays of a part, as the terms take it.
        options: see there.
        groups: of a step, of all processes together (`Sampler.groups`).
        ranks: the processes.

    Raises:
        ValueError: no parameter, a parameter or a name twice, or fewer groups than processes.
    """

    def __init__(
        self,
        sets: Sequence[ParameterSet],
        terms: Sequence[LossTerm],
        render: Callable[[Part], Any],
        options: Options,
        groups: int,
        ranks: Ranks = Ranks(),  # noqa: B008 - frozen
    ):
        self.sets, self.terms, self.render, self.options = list(sets), list(terms), render, options
        self._groups, self._ranks = groups, ranks
        named = [item for one in self.sets for item in one.parameters.items()]
        self.parameters = dict(named)
        if not named or len({id(p) for _, p in named}) < len(named) or len(self.parameters) < len(named):
            raise ValueError("sets: need parameters, each in one set only")
        if len({term.name for term in self.terms}) < len(self.terms) or not self.terms:
            raise ValueError("terms: need different names")
        if groups < ranks.world:
            raise ValueError(f"groups: {groups} cannot be shared out among {ranks.world} processes")
        ranks.copy_from_first(p.data for p in self.parameters.values())
        self._gradients = self._lay_out_gradients()
        self._adam = torch.optim.Adam(
            [{"params": list(one.parameters.values()), "lr": 0.0} for one in self.sets],
            betas=options.betas,
            eps=options.eps,
            fused=True,
        )

    def _lay_out_gradients(self) -> Tensor:
        """One buffer for all gradients and, behind them, the values of the terms; each gradient is a view of it."""
        count = sum(p.numel() for p in self.parameters.values())
        first = next(iter(self.parameters.values()))
        buffer = torch.zeros(count + len(self.terms), device=first.device)
        begin = 0
        self._set_ranges: list[tuple[int, int]] = []
        for one in self.sets:
            start = begin
            for parameter in one.parameters.values():
                parameter.grad = buffer[begin : begin + parameter.numel()].view_as(parameter)
                begin += parameter.numel()
            self._set_ranges.append((start, begin))
        return buffer

    def step(self, step: int, batch: Batch) -> Outcome:
        """Take one step on this process's rays.

        Raises:
            NonFiniteError: a term or gradient is not finite, with all its parameters as before.
        """
        self._gradients.zero_()
        begin, end = groups_of(self._ranks.rank, self._ranks.world, self._groups)
        group = len(batch) // (end - begin)
        rays = self._groups * group
        size = part_size(len(batch), group, self.options.micro_rays)
        for first in range(0, len(batch), size):
            some = slice_batch(batch, first, first + size)
            self._accumulate(Part(step, some, begin * group + first, min(group, size)), len(some) / rays)
        self._ranks.add_up(self._gradients)
        outcome = self._measured(step, rays)
        self._descend(outcome)
        return outcome

    def _accumulate(self, part: Part, share: float) -> None:
        """Add a part's share of the terms and of their gradients."""
        rendered = self.render(part)
        values, total = self._gradients[len(self._gradients) - len(self.terms) :], None
        for index, term in enumerate(self.terms):
            with torch.set_grad_enabled(term.weight != 0):
                value = term.value(rendered, part)
            values[index] += value.detach() * share
            if value.requires_grad:  # nothing does where no ray meets the box
                total = value * term.weight if total is None else total + value * term.weight
        if total is not None:  # positions, by which normals differentiated, need no gradient any more
            (total * share).backward(inputs=list(self.parameters.values()))

    def _measured(self, step: int, rays: int) -> Outcome:
        """Read the terms and norms, in one transfer, and refuse what is not finite."""
        norms = [self._gradients[begin:end].norm() for begin, end in self._set_ranges]
        count = len(self.terms)
        numbers = torch.cat([self._gradients[len(self._gradients) - count :], torch.stack(norms)]).tolist()
        terms = dict(zip([term.name for term in self.terms], numbers[:count], strict=True))
        wrong = [name for name, value in terms.items() if not math.isfinite(value)]
        if wrong:
            raise NonFiniteError(step, "loss", wrong)
        by_set: dict[str, float] = {}
        for one, norm, (begin, end) in zip(self.sets, numbers[count:], self._set_ranges, strict=True):
            if not math.isfinite(norm):
                norm = float(self._gradients[begin:end].double().norm())  # the squares may have overflowed
            if not math.isfinite(norm):
                raise NonFiniteError(step, "the gradient of", _not_finite(one.parameters))
            by_set[one.name] = norm
        loss = sum(term.weight * terms[term.name] for term in self.terms)
        rates = {one.name: one.rate(step) for one in self.sets}
        return Outcome(step, rays, loss, terms, by_set, rates)

    def _descend(self, outcome: Outcome) -> None:
        """Clip each set and let Adam take its step."""
        for one, group, (begin, end) in zip(
            self.sets, self._adam.param_groups, self._set_ranges, strict=True
        ):
            group["lr"] = outcome.rates[one.name]
            norm = outcome.norms[one.name]
            if one.clip is not None and norm > one.clip:
                self._gradients[begin:end] *= one.clip / norm
        self._adam.step()

    def state(self) -> dict[str, Tensor]:
        """What Adam remembers, by `exp_avg/PARAMETER`, `exp_avg_sq/PARAMETER` and `step/PARAMETER`."""
        return {
            f"{kind}/{name}": value
            for name, parameter in self.parameters.items()
            for kind, value in self._adam.state[parameter].items()
        }

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from what `state` returned.

        Raises:
            ValueError: it is of other parameters, or of other shapes.
        """
        kinds = ("step", "exp_avg", "exp_avg_sq")
        expected = {f"{kind}/{name}" for kind in kinds for name in self.parameters} if state else set()
        if set(state) != expected:
            example = sorted(set(state) ^ expected)[0]
            raise ValueError(f"state: is of other parameters; {example!r} is in one of the two only")
        for name, parameter in self.parameters.items():
            loaded = {kind: state[f"{kind}/{name}"] for kind in kinds} if state else {}
            for kind, value in loaded.items():
                if kind != "step" and value.shape != parameter.shape:
                    raise ValueError(
                        f"state: {kind}/{name} is {tuple(value.shape)}, not {tuple(parameter.shape)}"
                    )
            self._adam.state[parameter] = {
                kind: value.clone().to(parameter.device) for kind, value in loaded.items()
            }


def _not_finite(parameters: Mapping[str, nn.Parameter]) -> list[str]:
    return [n for n, p in parameters.items() if p.grad is not None and not bool(p.grad.isfinite().all())]


def part_size(rays: int, group: int, micro_rays: int) -> int:
    """Rays of a part: whole groups if at least one fits, and otherwise a divisor of a group.

    Raises:
        ValueError: `micro_rays` is not positive.
    """
    if micro_rays < 1:
        raise ValueError(f"micro_rays: {micro_rays} is not positive")
    if micro_rays >= group:
        return max(group, min(rays, micro_rays // group * group))
    return next(size for size in range(micro_rays, 0, -1) if group % size == 0)


def slice_batch(batch: Batch, begin: int, end: int) -> Batch:
    """Rays `begin` to `end` - 1 of a batch, without copying."""
    return Batch(**{name: getattr(batch, name)[begin:end] for name in Batch.__dataclass_fields__})
