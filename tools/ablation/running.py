"""What is done with the cells: priors trained, heads fitted and evaluated, tables written, time left estimated."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ablation.cells import Result, cell_path, cost, read_cell, write_cell
from ablation.design import Base, Cell, Table
from ablation.priors import Priors
from ablation.report import markdown, payload
from preface.artifacts import json_types, provenance, sha256, write_bytes
from preface.cli.output import say
from preface.model.evaluation.evaluate import evaluate_head
from preface.model.evaluation.options import EvaluationOptions
from preface.model.fitting.configuration import FitConfig, finetuning_steps
from preface.model.fitting.run import fit_head
from preface.model.training.prior_files import MODEL_FILE, Prior, read_prior
from preface.plain_words import duration, json_text
from preface.shards import Dataset


class StoppedError(Exception):
    """A signal came while something was fitted or trained; what was done is kept."""

    def __init__(self, status: int):
        super().__init__("interrupted; run the same command again to resume")
        self.status = status


@dataclass(frozen=True, eq=False)
class Ablation:
    """What is to be done.

    Attributes:
        dataset, prior: opened.
        tables: chosen.
        cells: the fits behind them.
        base: the full method.
        views: names of the cameras to fit to, by their number.
        held_out: names of those to evaluate.
        priors: see there.
        output: folder.
    """

    dataset: Dataset
    prior: Prior
    tables: tuple[Table, ...]
    cells: tuple[Cell, ...]
    base: Base
    views: Mapping[int, Sequence[str]]
    held_out: Sequence[str]
    priors: Priors
    output: Path

    # An error of the renderer is that of all rows: at most 0.03 dB, tools/bench/evaluation_choices.py.
    options = EvaluationOptions("vgg", quality="balanced", normals=False)

    def fit(self, cell: Cell) -> FitConfig:
        """The fit of a cell."""
        views = self.views[cell.variant.views]
        output = self.output / "heads" / cell.name
        return self.base.fit(cell, self.priors.path(cell.variant.prior), views, output)

    def settings(self, cell: Cell) -> dict[str, Any]:
        """What a cell's result depends on; the prior of the cell has to be there."""
        return {
            "fit": self.fit(cell).to_dict(),
            "shards": self._shards,
            "prior": sha256(self.priors.path(cell.variant.prior) / MODEL_FILE),
            "held_out": list(self.held_out),
            "evaluation": self.options.settings(),
        }

    @cached_property
    def _shards(self) -> str:
        return sha256(self.dataset.manifest.path)

    def result(self, cell: Cell) -> Result | None:
        """The result of a cell that is done."""
        if not cell_path(self.output, cell).exists() or not self.priors.is_trained(cell.variant.prior):
            return None
        return read_cell(self.output, cell, self.settings(cell))

    def rays(self, cell: Cell) -> float:
        """What a cell costs, see `cost`."""
        config, manifest = self.fit(cell), self.dataset.manifest
        steps = finetuning_steps(config.finetuning, manifest.width, manifest.height)
        known = replace(config, finetuning=replace(config.finetuning, steps=steps))
        return cost(known, manifest.width * manifest.height, len(self.held_out))

    def untrained(self) -> list[str]:
        """Priors that some cells need and that are not there."""
        names = dict.fromkeys(cell.variant.prior for cell in self.cells)
        return [name for name in names if not self.priors.is_trained(name)]

    # ------------------------------------------------------------------------------------------ doing it

    def run(self) -> list[str]:
        """Make what is missing, and write the tables."""
        for name in self.untrained():
            status = self.priors.train(name, say)
            if status:
                raise StoppedError(status)
        done = {cell.name: result for cell in self.cells if (result := self.result(cell)) is not None}
        for number, cell in enumerate(self.cells):
            if cell.name not in done:
                say(f"{number + 1} of {len(self.cells)}: {cell.name}; {self._left(done)}")
                done[cell.name] = self._make(cell)
                self._report(done)
        return self._report(done)

    def _make(self, cell: Cell) -> Result:
        """Fit and evaluate."""
        began, config = time.perf_counter(), self.fit(cell)
        ended = fit_head(config, say)
        if ended.status:
            raise StoppedError(ended.status)
        found = evaluate_head(
            read_prior(config.output), self.dataset, cell.identity, self.held_out, self.options
        )
        content: dict[str, Any] = {
            "figures": found.mean,
            "views": {view.figures.name: view.figures.values for view in found.views},
            "seconds": time.perf_counter() - began,
            "rays": self.rays(cell),
        }
        write_cell(self.output, cell, self.settings(cell), content)
        return Result(found.mean, content["seconds"], content["rays"])

    def _report(self, done: Mapping[str, Result]) -> list[str]:
        """Write the tables of what is done; returns what to print."""
        results: dict[str, dict[tuple[str, int], Result]] = {}
        for cell in self.cells:
            if cell.name in done:
                results.setdefault(cell.variant.name, {})[cell.identity, cell.seed] = done[cell.name]
        people = sorted({cell.identity for cell in self.cells})
        seeds = sorted({cell.seed for cell in self.cells})
        facts = [
            f"{len(done)} of {len(self.cells)} fits, of {', '.join(people)} with seeds {', '.join(map(str, seeds))}",
            f"prior of {len(self.prior.identities)} identities at {_size(self.prior.scene.resolution)}, views at "
            f"{_size((self.dataset.manifest.width, self.dataset.manifest.height))}",
            *[f"{count} view{'s' if count > 1 else ''}: {', '.join(v)}" for count, v in self.views.items()],
            f"evaluated: {', '.join(self.held_out)}",
            f"inversion: {vars(self.base.inversion)}",
            f"finetuning: {vars(self.base.finetuning)}",
        ]
        text = markdown(self.tables, results, facts)
        path = self.output / "ablation.json"
        inputs = {"manifest.json": self.dataset.manifest.path, MODEL_FILE: self.prior.path}
        content = {
            "facts": facts,
            "tables": payload(self.tables, results),
            "provenance": provenance({"quality": self.base.quality}, inputs),
        }
        write_bytes(path.with_suffix(".md"), text.encode())
        write_bytes(path, f"{json_text(json_types(content, path, ''))}\n".encode())
        return [text, str(path.with_suffix(".md"))]

    # ------------------------------------------------------------------------------------------ how long

    def _rate(self, done: Mapping[str, Result]) -> float | None:
        """Rays per second: of the cells that are done, or else of the prior's training, wherever that was."""
        seconds = sum(result.seconds for result in done.values())
        if seconds > 0:
            return sum(result.rays for result in done.values()) / seconds
        return rate_of_training(self.prior.path.parent / "log.jsonl")

    def _left(self, done: Mapping[str, Result]) -> str:
        rate = self._rate(done)
        left = sum(self.rays(cell) for cell in self.cells if cell.name not in done)
        return "time unknown" if rate is None else f"about {duration(left / rate)} left for all"

    def plan(self) -> list[str]:
        """Which fits there are, which of them are done, and how long the others will take."""
        done = {cell.name: result for cell in self.cells if (result := self.result(cell)) is not None}
        rate = self._rate(done)

        def shown(rays: float) -> str:
            return "unknown" if rate is None else duration(rays / rate)

        lines = ["| fit | done | all | left |", "|---|---:|---:|---:|"]
        priors = self.untrained()
        lines += [f"| prior {name} | 0 | 1 | {shown(self.priors.rays())} |" for name in priors]
        for variant in dict.fromkeys(cell.variant.name for cell in self.cells):
            cells = [cell for cell in self.cells if cell.variant.name == variant]
            left = [cell for cell in cells if cell.name not in done]
            time_left = shown(sum(map(self.rays, left)))
            lines.append(f"| {variant} | {len(cells) - len(left)} | {len(cells)} | {time_left} |")
        left_of_all = [cell for cell in self.cells if cell.name not in done]
        total = sum(map(self.rays, left_of_all)) + len(priors) * self.priors.rays()
        lines.append(f"| all | {len(done)} | {len(self.cells) + len(priors)} | {shown(total)} |")
        return lines


def rate_of_training(log: Path) -> float | None:
    """Rays per second that a run's log says last; None without a log."""
    if not log.exists():
        return None
    entries = [json.loads(line) for line in log.read_text().splitlines()]
    rates = [entry["rays_per_second"] for entry in entries if "rays_per_second" in entry]
    return rates[-1] if rates else None


def _size(resolution: tuple[int, int]) -> str:
    return f"{resolution[0]}x{resolution[1]}"
