"""Learning rates as functions of the step."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class LogLinear:
    """A rate that falls (or rises) by the same factor at each step: the paper's schedule.

    rate(step) = first^(1 - s) * last^s with s = step / steps, as multinerf's `learning_rate_decay`; the very
    first steps are scaled by sin(pi/2 * step / warmup), from `warmup_share` on, where there is a warm-up.

    Attributes:
        first, last: rates at step 0 and at step `steps`, positive.
        steps: of the run.
        warmup: steps of the warm-up; 0 for none.
        warmup_share: what the first of them is scaled by.

    Raises:
        ValueError: a rate that is not positive and finite, or no steps.
    """

    first: float
    last: float
    steps: int
    warmup: int = 0
    warmup_share: float = 0.01

    def __post_init__(self) -> None:
        for name in ("first", "last"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name}: a learning rate of {value} is not positive and finite")
        if self.steps < 1 or self.warmup < 0:
            raise ValueError(f"steps: {self.steps} steps with a warm-up of {self.warmup} are no schedule")

    def __call__(self, step: int) -> float:
        """The rate of a step; beyond the end it stays at the last."""
        share = min(max(step / self.steps, 0.0), 1.0)
        rate = math.exp(math.log(self.first) * (1 - share) + math.log(self.last) * share)
        if step < self.warmup:
            rise = math.sin(0.5 * math.pi * step / self.warmup)
            rate *= self.warmup_share + (1 - self.warmup_share) * rise
        return rate
