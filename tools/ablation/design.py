"""The rows of each table: the fit behind each row, and the views that are fitted to and held out.

A fit is a *variant* of the full method, two views, inversion, both regularisers, the code optimised, the whole prior;
it differs from it in one thing. The full method is a row of every table and is fitted once.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from ablation.paper import PAPER
from preface.model.fitting.configuration import FinetuningConfig, FitConfig, FitRunConfig, InversionConfig

FULL_PRIOR, HALF_PRIOR = "full", "half-resolution"
USUAL_VIEWS, MOST = 2, 7
VIEW_COUNTS = (1, USUAL_VIEWS, 3, 5, MOST)
AZIMUTHS = (-50.0, -25.0, 0.0, 25.0, 50.0)  # degrees; see `view_sets`


@dataclass(frozen=True)
class Variant:
    """A fit that differs from the full method in one thing.

    Attributes:
        name: of its folder.
        views: how many are fitted to.
        prior: `full`, `half-resolution` or `identities-N`.
        inversion, finetuning: fields that differ.
    """

    name: str
    views: int = USUAL_VIEWS
    prior: str = FULL_PRIOR
    inversion: Mapping[str, Any] = field(default_factory=dict)
    finetuning: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class TableRow:
    """A row of a table: its name, the variant behind it, and the paper's row, which may be called otherwise."""

    name: str
    variant: Variant
    paper: str


@dataclass(frozen=True)
class Table:
    """An ablation; `full` is the row of the full method."""

    name: str
    title: str
    rows: tuple[TableRow, ...]
    full: str


FULL = Variant("full")


def _start(name: str) -> Variant:
    return Variant(f"start-{name}", inversion={"start": name, "steps": 0})


def _same(name: str, title: str, rows: Mapping[str, Variant]) -> Table:
    """A table whose rows are called as in the paper."""
    full = next(row for row, variant in rows.items() if variant == FULL)
    return Table(name, title, tuple(TableRow(row, variant, row) for row, variant in rows.items()), full)


def tables(
    identities: Sequence[int], resolution: tuple[int, int], counts: Sequence[int] = VIEW_COUNTS
) -> dict[str, Table]:
    """All ablations by name.

    Args:
        identities: numbers of training identities, ascending, at most the paper's four; the last is all there are.
        resolution: of the full prior's images.
        counts: numbers of views that can be fitted to.
    """
    width, height = resolution
    smaller, larger = list(PAPER["resolution"].rows)
    # The largest stands beside the paper's largest, and so on down.
    beside = list(PAPER["identities"].rows)[-len(identities) :]
    people = [
        TableRow(str(n), Variant(f"identities-{n}", prior=f"identities-{n}"), paper)
        for n, paper in zip(identities[:-1], beside[:-1], strict=True)
    ]
    people.append(TableRow(str(identities[-1]), FULL, beside[-1]))
    sizes = [
        TableRow(f"{width // 2}x{height // 2}", Variant("half-resolution", prior=HALF_PRIOR), smaller),
        TableRow(f"{width}x{height}", FULL, larger),
    ]
    starts: dict[str, Variant] = {n: _start(n) for n in ("furthest", "nearest", "mean", "noise", "zeros")}
    neither = Variant("no-regularisers", finetuning={"normals": 0.0, "view_weights": 0.0})
    views = {str(n): FULL if n == USUAL_VIEWS else Variant(f"views-{n}", views=n) for n in counts}
    frozen = Variant("frozen-latent", finetuning={"frozen_latent": True})
    found = [
        _same("initialisation", "Where the code starts", {**starts, "inversion": FULL}),
        _same(
            "regularisers",
            "Regularisers of finetuning",
            {
                "none": neither,
                "normals": Variant("normals-only", finetuning={"view_weights": 0.0}),
                "view weights": Variant("view-weights-only", finetuning={"normals": 0.0}),
                "both": FULL,
            },
        ),
        _same("views", "Views fitted to", views),
        _same("frozen-latent", "The code while finetuning", {"frozen": frozen, "optimised": FULL}),
        Table("identities", "Identities that the prior was trained on", tuple(people), str(identities[-1])),
        Table("resolution", "Resolution of the prior's images", tuple(sizes), sizes[1].name),
    ]
    return {table.name: table for table in found}


@dataclass(frozen=True)
class Cell:
    """One fit of one person with one seed."""

    variant: Variant
    identity: str
    seed: int

    @property
    def name(self) -> str:
        """Of its file and its folder."""
        return f"{self.variant.name}/{self.identity}-seed{self.seed}"


def cells_of(chosen: Sequence[Table], identities: Sequence[str], seeds: Sequence[int]) -> list[Cell]:
    """The fits behind some tables, each once; the first seed of all before the second of any."""
    variants = list(dict.fromkeys(row.variant.name for table in chosen for row in table.rows))
    by_name = {row.variant.name: row.variant for table in chosen for row in table.rows}
    order = itertools.product(seeds, identities, variants)
    return [Cell(by_name[variant], identity, seed) for seed, identity, variant in order]


@dataclass(frozen=True)
class Base:
    """The full method, before a variant changes it.

    Attributes:
        shards: folder.
        quality: name of the defaults.
        inversion, finetuning, run: of the full method.
    """

    shards: Path
    quality: Any
    inversion: InversionConfig
    finetuning: FinetuningConfig
    run: FitRunConfig

    def fit(self, cell: Cell, prior: Path, views: Sequence[str], output: Path) -> FitConfig:
        """The fit of a cell."""
        return FitConfig(
            shards=self.shards,
            output=output,
            prior=prior,
            identity=cell.identity,
            views=tuple(views),
            quality=self.quality,
            seed=cell.seed,
            inversion=replace(self.inversion, **cell.variant.inversion),
            finetuning=replace(self.finetuning, **cell.variant.finetuning),
            run=self.run,
        )


def view_sets(directions: np.ndarray) -> dict[int, tuple[int, ...]]:
    """Which views to fit to, for each number of them; the sets lie in the largest, so that all leave the rest.

    Five stand nearest to azimuths of -50, -25, 0, 25 and 50 degrees at the height of the face; of them, one view is
    the middle one, two are those beside it, and three leave those out. Seven are the five with the two that are
    farthest from them, where that leaves any.

    Args:
        directions: [V, 3], from the canonical origin to the cameras, canonical frame, of any length.

    Returns:
        Numbers of views by their count.

    Raises:
        ValueError: fewer than six cameras, so that nothing would be left to evaluate.
    """
    if len(directions) <= len(AZIMUTHS):
        raise ValueError(f"{len(directions)} cameras; five to fit to and at least one to evaluate are needed")
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    angles = np.radians(AZIMUTHS)
    wanted = np.stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)], axis=1)
    five = linear_sum_assignment(np.arccos(np.clip(wanted @ unit.T, -1, 1)))[1].tolist()
    sets = five_views(five)
    if len(unit) > MOST:
        seven = list(five)
        while len(seven) < MOST:
            nearest = (unit @ unit[seven].T).max(axis=1)  # cosines
            seven.append(int(np.argmin(nearest)))
        sets[MOST] = tuple(seven)
    return sets


def five_views(five: Sequence[int]) -> dict[int, tuple[int, ...]]:
    """The sets of one to five of five views, which go from one side of the face to the other."""
    return {1: (five[2],), 2: (five[1], five[3]), 3: (five[0], five[2], five[4]), 5: tuple(five)}
