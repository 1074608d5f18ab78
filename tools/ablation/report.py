"""The tables, ours beside the paper's, and what of them agrees: computed, never judged by eye.

Two rows are compared person by person and seed by seed. Their difference counts if its mean is more than two standard
errors from zero; otherwise it lies within the spread and says nothing for or against the paper.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ablation.cells import Results, Spread, difference, row_spread
from ablation.design import Table, TableRow
from ablation.paper import HIGHER_IS_BETTER, METRICS, PAPER

DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4}
TITLES = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS"}
UNITS = {"psnr": " dB", "ssim": "", "lpips": ""}


@dataclass(frozen=True)
class Pair:
    """Two rows of a table, the one that the paper has ahead first, and by how much the first is ahead in ours."""

    ahead: str
    behind: str
    ours: Spread

    @property
    def verdict(self) -> str:
        """`agrees`, `contradicts` or `within the spread`."""
        if abs(self.ours.mean) <= self.ours.error:
            return "within the spread"
        return "agrees" if self.ours.mean > 0 else "contradicts"


def pairs(table: Table, results: Results, metric: str) -> list[Pair]:
    """All pairs of rows that differ in the paper and were measured."""
    sign = 1 if HIGHER_IS_BETTER[metric] else -1
    found = []
    for one, other in itertools.combinations(table.rows, 2):
        paper = [sign * PAPER[table.name].rows[row.paper][metric] for row in (one, other)]
        if paper[0] == paper[1]:
            continue
        ahead, behind = (one, other) if paper[0] > paper[1] else (other, one)
        ours = difference(results, ahead.variant.name, behind.variant.name, metric)
        if ours is not None:
            found.append(Pair(ahead.name, behind.name, Spread(sign * ours.mean, ours.deviation, ours.count)))
    return found


def statement(table: Table, results: Results, metric: str) -> str:
    """What a figure of a table says about the paper's claim, in words."""
    measured = [row for row in table.rows if row_spread(results, row.variant.name, metric) is not None]
    compared = pairs(table, results, metric)
    if len(measured) < 2 or not compared:
        return f"{TITLES[metric]}: not enough was measured to compare rows."
    sign = 1 if HIGHER_IS_BETTER[metric] else -1

    def ours(row: TableRow) -> float:
        found = row_spread(results, row.variant.name, metric)
        assert found is not None
        return sign * found.mean

    def papers(row: TableRow) -> float:
        return sign * PAPER[table.name].rows[row.paper][metric]

    by_ours = [row.name for row in sorted(measured, key=ours)]
    by_paper = [row.name for row in sorted(measured, key=papers)]
    groups: dict[str, list[Pair]] = {"agrees": [], "contradicts": [], "within the spread": []}
    for pair in compared:
        groups[pair.verdict].append(pair)
    order = "the order of the rows is the paper's" if by_ours == by_paper else (
        f"the order of the rows is {' < '.join(by_ours)}, and in the paper {' < '.join(by_paper)}"
    )  # fmt: skip
    best = "as in the paper" if by_ours[-1] == by_paper[-1] else f"in the paper {by_paper[-1]}"
    words = [
        f"{TITLES[metric]}: {order} (better to the right). Best is {by_ours[-1]}, {best}.",
        f"Of {_pairs(len(compared))}, {len(groups['agrees'])} are as in the paper beyond the spread, "
        f"{len(groups['within the spread'])} within it, {len(groups['contradicts'])} the other way round"
        + (":" if groups["contradicts"] else "."),
    ]
    if groups["contradicts"]:
        words.append("; ".join(_against(pair, metric) for pair in groups["contradicts"]) + ".")
    return " ".join(words)


def _pairs(count: int) -> str:
    return f"{count} pair{'s' if count > 1 else ''} of rows"


def _against(pair: Pair, metric: str) -> str:
    digits, unit = DIGITS[metric], UNITS[metric]
    margin = f"{abs(pair.ours.mean):.{digits}f} ± {pair.ours.error:.{digits}f}{unit}"
    return f"{pair.behind} is ahead of {pair.ahead} by {margin}"


def markdown_table(table: Table, results: Results) -> str:
    """A table in Markdown: our mean and standard deviation over cells beside the paper's mean."""
    heads = [f"{TITLES[m]} {'↑' if HIGHER_IS_BETTER[m] else '↓'}" for m in METRICS]
    columns = [
        table.title,
        "fits",
        *[name for head in heads for name in (f"{head} ours", "paper")],
        "PSNR to full",
    ]
    lines = [f"| {' | '.join(columns)} |", f"|---|{'---:|' * (len(columns) - 1)}"]
    full = next(row for row in table.rows if row.name == table.full)
    for row in table.rows:
        shown = [row_spread(results, row.variant.name, metric) for metric in METRICS]
        counts = [s.count for s in shown if s is not None]
        name = row.name if row.paper == row.name else f"{row.name} (the paper: {row.paper})"
        cells = [name, str(max(counts)) if counts else "0"]
        for metric, found in zip(METRICS, shown, strict=True):
            digits = DIGITS[metric]
            paper = PAPER[table.name].rows[row.paper][metric]
            cells += [_shown(found, f".{digits}f"), f"{paper:.{digits}f}"]
        gap = difference(results, row.variant.name, full.variant.name, "psnr")
        reference = row.name == table.full
        cells.append("" if reference else _shown(gap, "+.2f"))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _shown(found: Spread | None, form: str) -> str:
    """A mean with its standard deviation, where there is one."""
    if found is None:
        return "–"
    deviation = f" ± {found.deviation:{form.lstrip('+')}}" if found.count > 1 else ""
    return f"{found.mean:{form}}{deviation}"


def markdown(tables: Sequence[Table], results: Results, facts: Sequence[str]) -> str:
    """The whole report.

    Args:
        tables: in order.
        results: all cells that are done.
        facts: lines on what was fitted to, with what.
    """
    parts = ["# Ablations", "\n".join(f"- {fact}" for fact in facts)]
    parts.append(
        "Figures are of face crops of held-out views: mean ± standard deviation over fits, one per person and seed. "
        "`PSNR to full` is the mean difference to the full method, person by person and seed by seed. Differences "
        "count from two standard errors on. The paper's people, cameras, resolution and steps are others: what can "
        "be compared is the order of rows, not the figures."
    )
    for table in tables:
        words = "\n".join(f"- {statement(table, results, metric)}" for metric in METRICS)
        source = f"The paper: {PAPER[table.name].source}."
        parts += [f"## {table.title}", markdown_table(table, results), words, source]
    return "\n\n".join(parts) + "\n"


def payload(tables: Sequence[Table], results: Results) -> list[dict[str, Any]]:
    """The tables as JSON data."""
    return [
        {
            "table": table.name,
            "title": table.title,
            "source": PAPER[table.name].source,
            "rows": [_row(table, row, results) for row in table.rows],
            "statements": {metric: statement(table, results, metric) for metric in METRICS},
            "pairs": {metric: [_pair(p) for p in pairs(table, results, metric)] for metric in METRICS},
        }
        for table in tables
    ]


def _row(table: Table, row: TableRow, results: Results) -> dict[str, Any]:
    ours: dict[str, Mapping[str, float] | None] = {}
    for metric in METRICS:
        found = row_spread(results, row.variant.name, metric)
        ours[metric] = None if found is None else vars(found)
    paper = PAPER[table.name].rows[row.paper]
    return {
        "row": row.name,
        "variant": row.variant.name,
        "ours": ours,
        "paper": {"row": row.paper, **paper},
    }


def _pair(pair: Pair) -> dict[str, Any]:
    return {
        "ahead_in_paper": pair.ahead,
        "behind": pair.behind,
        "ahead_by": vars(pair.ours),
        "verdict": pair.verdict,
    }
