"""Which ways to render are measured: one thing varied at a time, then choices of several."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from preface.model.rendering.shortcuts import QUALITIES, Shortcuts
from preface.model.training.prior_files import Prior

FULLEST = (128, 128, 64)  # samples, four times what presets for CPUs are trained with
ALL = 8  # rounds, more than any model has
NORMALS = ("opaque_normals", "predicted_normals")  # groups whose images are rendered with normals


@dataclass(frozen=True)
class Point:
    """A way to render.

    Attributes:
        name: unique among the points.
        group: what is varied.
        model: number of the folder.
        samples: per round; None as trained.
        shortcuts: which.
    """

    name: str
    group: str
    model: int
    samples: tuple[int, ...] | None
    shortcuts: Shortcuts

    @property
    def as_trained(self) -> bool:
        """Whether it is the model itself, without shortcuts."""
        return self.samples is None and self.shortcuts == Shortcuts()

    def settings(self) -> dict[str, Any]:
        """As JSON data."""
        samples = None if self.samples is None else list(self.samples)
        return {"model": self.model, "samples": samples, "shortcuts": asdict(self.shortcuts)}


def fullest(model: int, prior: Prior) -> Point:
    """What all others of a model are compared with: without shortcuts, and with at least twice its samples."""
    own = prior.model.samples
    return Point(
        f"fullest {model}", "fullest", model, tuple(max(2 * n, m) for n, m in _paired(own)), Shortcuts()
    )


def render_points(priors: Sequence[Prior], *, small: bool) -> list[Point]:
    """Everything that is measured of the first model, and of the others what may be chosen of the first.

    Args:
        priors: the models; they differ in width, or in anything else.
        small: a third of the points, to try.
    """
    found = [*_alone(priors[0], small=small), *_together(0, small=small)]
    for number in range(1, len(priors)):
        found += [
            Point(f"model {number}", "width", number, None, Shortcuts()),
            *_together(number, small=True),
        ]
    return found


def _alone(prior: Prior, *, small: bool) -> Iterator[Point]:
    own = prior.model.samples
    yield Point("as trained", "reference", 0, None, Shortcuts())
    for factor in (0.5, 2) if small else (0.25, 0.5, 0.75, 1.5, 2, 3):
        samples = tuple(max(2, round(factor * n)) for n in own)
        yield Point(f"samples {' '.join(map(str, samples))}", "samples", 0, samples, Shortcuts())
    levels = prior.model.levels
    assert isinstance(levels, int)
    for less in (2,) if small else (1, 2, 3, 4):
        yield _one("levels", levels=max(levels - less, 1))
    yield _one("folded", folded=True)
    yield _one("precision", matmul="bf16")
    for cubes in (64,) if small else (32, 48, 64, 96):
        yield _one("occupancy", occupancy=cubes)
    for alpha in () if small else (0.01, 0.05, 0.2):
        yield _one("empty_alpha", occupancy=64, empty_alpha=alpha)
    for rounds in (ALL,) if small else (1, ALL):
        yield _one("skipped_rounds", occupancy=64, skipped_rounds=rounds)
    for share in () if small else (0.25, 0.5, 0.75):
        yield _one("sample_share", sample_share=share)
    for short in () if small else (0.02, 0.04):
        yield _one("short_share", short_share=0.5, short=short)
    for bound in (0.005,) if small else (0.001, 0.005, 0.02):
        yield _one("weight_bound", weight_bound=bound)
        yield _one("color_bound", color_bound=bound)
    for name in NORMALS:
        yield _one(name, **{name: True})


def _together(model: int, *, small: bool) -> Iterator[Point]:
    base = QUALITIES["balanced"]
    cubes, shares = ((48, 64), (0.5, 0.75)) if small else ((32, 48, 64, 96), (0.375, 0.5, 0.75, 1.0))
    for occupancy, share in itertools.product(cubes, shares):
        for bound in (0.005,) if small else (0.002, 0.005, 0.02):
            yield _of(
                model,
                replace(base, occupancy=occupancy, sample_share=share, weight_bound=bound, color_bound=bound),
            )
        if share == 1.0:
            for short in (0.02, 0.04):
                yield _of(
                    model, replace(base, occupancy=occupancy, sample_share=1.0, short_share=0.5, short=short)
                )
    if not small:
        yield _of(model, replace(base, skipped_rounds=1))
        yield _of(model, replace(base, matmul="fp32"))


def _one(group: str, **shortcuts: Any) -> Point:
    name = ", ".join(f"{key} {_shown(value)}" for key, value in shortcuts.items())
    return Point(name, group, 0, None, Shortcuts(**shortcuts))


def _of(model: int, shortcuts: Shortcuts) -> Point:
    usual = asdict(Shortcuts())
    told = {key: value for key, value in asdict(shortcuts).items() if value != usual[key]}
    told.pop("folded")
    name = ", ".join(f"{key} {_shown(value)}" for key, value in told.items())
    return Point(name if model == 0 else f"model {model}: {name}", "together", model, None, shortcuts)


def _shown(value: Any) -> str:
    if value is True:
        return "on"
    return "all" if value == ALL and isinstance(value, int) else str(value)


def _paired(samples: Sequence[int]) -> list[tuple[int, int]]:
    """Each round's samples with what the fullest render has at least in it."""
    rounds = [*FULLEST[:1] * (len(samples) - 1), FULLEST[-1]]
    return list(zip(samples, rounds, strict=True))
