"""How fast a run is: rays per second, time left, and the share of what the machine's matrix products reach."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from preface.model.model import PriorModel
from preface.model.networks import Trunk
from preface.model.training.trainer import Outcome
from preface.plain_words import duration


def train_flops_per_ray(model: PriorModel) -> float:
    """Floating-point operations of the matrix products of one training ray that meets the box.

    Two per weight and sample forward, two for the weight's gradient, and two for the gradient of the layer's input,
    which encodings do not need. What codes cost once per view does not count.
    """
    samples = model.config.samples
    proposal = _flops_per_sample(model.proposal) * sum(samples[:-1])
    return proposal + _flops_per_sample(model.nerf) * samples[-1]


def _flops_per_sample(network: Trunk) -> float:
    weights = [p for name, p in network.named_parameters() if name.split(".")[-1] == "weight"]
    first, with_skip = network.layers[0], network.layers[network.skip + 1 : network.skip + 2]
    encoding = first.get_parameter("weight").shape[1]
    from_encoding = sum(len(layer.get_parameter("weight")) * encoding for layer in (first, *with_skip))
    return 6.0 * sum(p.numel() for p in weights) - 2.0 * from_encoding


@dataclass
class Progress:
    """Means since the last line.

    Attributes:
        steps: of the whole run.
        flops: of a ray that meets the box.
        peak: floating-point operations per second of a large matrix product on this machine.
    """

    steps: int
    flops: float
    peak: float
    _seconds: float = 0.0
    _all: list[float] = field(default_factory=lambda: [0.0, 0.0])  # seconds and steps of this run
    _rays: int = 0
    _sums: dict[str, float] = field(default_factory=dict)
    _count: int = 0
    _started: float = 0.0

    def start(self) -> None:
        """Begin to count a step's time."""
        self._started = time.perf_counter()

    def add(self, outcome: Outcome) -> None:
        """Count a step, which ends now."""
        seconds = time.perf_counter() - self._started
        self._seconds += seconds
        self._all = [self._all[0] + seconds, self._all[1] + 1]
        self._rays += outcome.rays
        self._count += 1
        for name, value in {"loss": outcome.loss, **outcome.terms}.items():
            self._sums[name] = self._sums.get(name, 0.0) + value

    def summary(self, outcome: Outcome) -> dict[str, float | Mapping[str, float]]:
        """Figures since the last summary, for the log; begins anew."""
        means = {name: total / self._count for name, total in self._sums.items()}
        rate = self._rays / max(self._seconds, 1e-9)
        hit = means.pop("hit", 1.0)
        squared = means.pop("squared_error", math.nan)
        values: dict[str, float | Mapping[str, float]] = {
            **means,
            "rays_per_second": rate,
            "share_of_peak": rate * hit * self.flops / self.peak,
            "seconds_left": (self.steps - outcome.step - 1) * self._all[0] / max(self._all[1], 1),
            "gradient_norm": outcome.norms,
            "rate": outcome.rates,
        }
        if squared > 0 and hit > 0:
            values["psnr"] = -10 * math.log10(squared / hit)
        self._seconds, self._rays, self._count, self._sums = 0.0, 0, 0, {}
        return values

    def line(self, step: int, values: Mapping[str, float | Mapping[str, float]]) -> str:
        """The figures as a line for people."""
        left = values["seconds_left"]
        assert isinstance(left, float)
        psnr = f"PSNR {values['psnr']:5.2f} dB  " if "psnr" in values else ""
        return (
            f"step {step:>7,} of {self.steps:,}  loss {values['loss']:.4f}  {psnr}"
            f"{values['rays_per_second']:>8,.0f} rays/s  {duration(left)} left  "
            f"{values['share_of_peak']:.0%} of the matmul peak"
        )
