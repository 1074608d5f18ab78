"""The route of matrix products that a run takes, and goes on with when it is resumed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace

import torch

from preface.model.configuration import ModelConfig
from preface.model.matmul import FP32_ERROR, Route, choose_route
from preface.model.training.configuration import TrainingConfigError


@contextlib.contextmanager
def chosen_products(model: ModelConfig, before: str, wanted: str, device: torch.device) -> Iterator[Route]:
    """Multiply by the route wanted, by that of the steps before, or by the fastest exact one.

    Args:
        model: says in which precision.
        before: the route of the steps before; empty if there were none.
        wanted: `auto` or the name of a route.
        device: where.

    Raises:
        TrainingConfigError: the route wanted is not exact on this processor.
    """
    fastest = choose_route(model.matmul, device, model.nerf.width)
    named = device.type == "cpu" and model.matmul == "fp32"
    name = (before if wanted == "auto" else wanted) if named else ""
    route = replace(fastest, name=name or fastest.name)
    route.apply()
    try:
        if route.name != fastest.name and not _is_exact():
            if wanted != "auto":
                raise TrainingConfigError(
                    f"--products {wanted}: multiplies float32 matrices in bfloat16 on this processor; give "
                    "--products auto"
                )
            route = fastest  # the run has moved to another machine
            route.apply()
        yield route
    finally:
        Route("mkl", 0.0, 0.0).apply()  # PyTorch's own


def _is_exact() -> bool:
    """Whether float32 products on the CPU are, at present."""
    numbers = torch.linspace(-1, 1, 256 * 256).view(256, 256)
    exact = numbers.double() @ numbers.double()
    return float(((numbers @ numbers).double() - exact).abs().max() / exact.abs().max()) <= FP32_ERROR
