"""What is kept of each fit, `cells/<variant>/<identity>-seed<seed>.json`, and means over fits.

A cell is written once its fit is evaluated, atomically, so that a folder can be gone on with at any time. It says with
which settings it was made, and is refused for others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ablation.design import Cell
from preface.artifacts import ArtifactError, json_types, load_json, write_bytes
from preface.model.training.folder import require_same_run
from preface.plain_words import json_text

FACE = "_face"  # the paper's figures are of face crops


@dataclass(frozen=True)
class Result:
    """A cell that is done.

    Attributes:
        figures: means over the held-out views, by name; what could not be measured is not there.
        seconds: of fit and evaluation together, on the clock.
        rays: that the fit was worth, see `cost`.
    """

    figures: Mapping[str, float]
    seconds: float
    rays: float


def cell_path(folder: Path, cell: Cell) -> Path:
    """The file of a cell."""
    return folder / "cells" / f"{cell.name}.json"


def write_cell(folder: Path, cell: Cell, settings: Mapping[str, Any], content: Mapping[str, Any]) -> Path:
    """Write the file of a cell: its settings and results.

    Raises:
        ArtifactError: the disk refuses.
    """
    path = cell_path(folder, cell)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArtifactError.from_os(path, "writing", error) from error
    named = {"variant": cell.variant.name, "identity": cell.identity, "seed": cell.seed}
    payload = json_types({**named, "settings": settings, **content}, path, "")
    return write_bytes(path, f"{json_text(payload)}\n".encode())


def read_cell(folder: Path, cell: Cell, settings: Mapping[str, Any]) -> Result | None:
    """The result of a cell, None if it is to be made.

    Raises:
        ArtifactError: it was made with other settings; the message names them.
    """
    path = cell_path(folder, cell)
    if not path.exists():
        return None
    content = load_json(path)
    require_same_run(path, json_types(settings, path, "settings"), content["settings"])
    return Result(content["figures"], content["seconds"], content["rays"])


def cost(config: Any, pixels: int, held_out: int) -> float:
    """What a fit and its evaluation are worth in rays of training without regularisers, roughly.

    A step with predicted normals takes gradients of gradients; LPIPS costs more than the rays that it looks at; an
    evaluation renders and measures. Factors are those of the `tiny` model on one core.

    Args:
        config: a `FitConfig` with its steps as numbers.
        pixels: of a view.
        held_out: views evaluated.
    """
    inversion, finetuning = config.inversion, config.finetuning
    found = (1.8 if inversion.lpips > 0 else 0.7) * inversion.steps * inversion.patches * inversion.patch**2
    found += (2.1 if finetuning.normals > 0 else 1.0) * finetuning.steps * finetuning.rays
    return found + 1.1 * held_out * pixels


@dataclass(frozen=True)
class Spread:
    """A mean over cells with its standard deviation, and of how many."""

    mean: float
    deviation: float
    count: int

    @property
    def error(self) -> float:
        """Two standard errors of the mean; infinite for a single cell."""
        return 2 * self.deviation / math.sqrt(self.count) if self.count > 1 else math.inf


def spread(values: Sequence[float]) -> Spread | None:
    """None where there is nothing."""
    if not values:
        return None
    return Spread(
        float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0, len(values)
    )


Results = Mapping[str, Mapping[tuple[str, int], Result]]  # by variant, then by identity and seed


def row_spread(results: Results, variant: str, metric: str) -> Spread | None:
    """Of a figure of face crops over the cells of a variant."""
    found = results.get(variant, {}).values()
    return spread([r.figures[metric + FACE] for r in found if metric + FACE in r.figures])


def difference(results: Results, one: str, other: str, metric: str) -> Spread | None:
    """Of one variant's figure over another's, person by person and seed by seed."""
    a, b, name = results.get(one, {}), results.get(other, {}), metric + FACE
    both = [key for key in a if key in b and name in a[key].figures and name in b[key].figures]
    return spread([a[key].figures[name] - b[key].figures[name] for key in both])
