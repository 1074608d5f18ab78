"""Heads side by side as a table: Markdown for a README, LaTeX (with booktabs) for a paper.

A row is a mapping with `name`, `identity`, `fitted` (how many photographs the model has seen of it), `views` (how many
were evaluated) and figures by the names of metrics.json; what it lacks is a dash. The best figure of an identity is
bold where several rows are of it and share their number of views.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from preface.model.evaluation.metrics_file import Measured

Row = Mapping[str, Any]


@dataclass(frozen=True)
class FigureColumn:
    """How a figure is shown.

    Attributes:
        key: in a row.
        heading: words, without an arrow.
        decimals: shown.
        higher: whether more is better.
        of: what part of the image it is of.
    """

    key: str
    heading: str
    decimals: int
    higher: bool
    of: str


FACE, FRAME, FOREGROUND = "face", "frame", "foreground"
FIGURE_COLUMNS = (
    FigureColumn("psnr_face", "PSNR", 2, True, FACE),
    FigureColumn("ssim_face", "SSIM", 4, True, FACE),
    FigureColumn("lpips_face", "LPIPS", 4, False, FACE),
    FigureColumn("lpips_alex_face", "LPIPS-A", 4, False, FACE),
    FigureColumn("psnr", "PSNR", 2, True, FRAME),
    FigureColumn("ssim", "SSIM", 4, True, FRAME),
    FigureColumn("lpips", "LPIPS", 4, False, FRAME),
    FigureColumn("lpips_alex", "LPIPS-A", 4, False, FRAME),
    FigureColumn("psnr_foreground", "PSNR", 2, True, FOREGROUND),
    FigureColumn("silhouette_iou", "IoU", 4, True, FOREGROUND),
)
_FIXED = (("name", "head"), ("identity", "identity"), ("fitted", "fitted to"), ("views", "views"))
_ESCAPES = {c: f"\\{c}" for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


def row_of(measured: Measured, fitted: int) -> dict[str, Any]:
    """The row of a head that was fitted to so many photographs."""
    views = len(measured.views)
    first = {"name": measured.name, "identity": measured.identity, "fitted": fitted, "views": views}
    return first | measured.mean


def markdown(rows: Sequence[Row]) -> str:
    """The table in Markdown, with its end of line.

    Raises:
        ValueError: no rows.
    """
    columns = _shown(rows)
    headings = [words for _, words in _FIXED]
    headings += [f"{column.of} {column.heading} {'↑' if column.higher else '↓'}" for column in columns]
    lines = [headings, ["---"] * len(_FIXED) + ["---:"] * len(columns)]
    lines += _cells(rows, columns, lambda text: text.replace("|", "\\|"), lambda text: f"**{text}**", "–")
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def latex(rows: Sequence[Row]) -> str:
    """The table in LaTeX; it needs the package booktabs.

    Raises:
        ValueError: no rows.
    """
    columns = _shown(rows)
    parts = list(dict.fromkeys(column.of for column in columns))
    spans = [sum(column.of == part for column in columns) for part in parts]
    above = [rf"\multicolumn{{{span}}}{{c}}{{{part}}}" for part, span in zip(parts, spans, strict=True)]
    headings = [words for _, words in _FIXED]
    headings += [rf"{column.heading} $\{'up' if column.higher else 'down'}arrow$" for column in columns]
    begin, rules = len(_FIXED) + 1, []
    for span in spans:
        rules.append(rf"\cmidrule(lr){{{begin}-{begin + span - 1}}}")
        begin += span
    body = _cells(rows, columns, _escaped, lambda text: rf"\textbf{{{text}}}", "--")
    lines = [
        rf"\begin{{tabular}}{{ll{'r' * (len(_FIXED) - 2 + len(columns))}}}",
        r"\toprule",
        f"{' & ' * len(_FIXED)}{' & '.join(above)} \\\\",
        "".join(rules),
        rf"{' & '.join(headings)} \\",
        r"\midrule",
        *(rf"{' & '.join(line)} \\" for line in body),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _shown(rows: Sequence[Row]) -> list[FigureColumn]:
    """The columns that a row has a figure for."""
    if not rows:
        raise ValueError("rows: a table needs one")
    return [column for column in FIGURE_COLUMNS if any(column.key in row for row in rows)]


def _cells(
    rows: Sequence[Row],
    columns: Sequence[FigureColumn],
    escape: Callable[[str], str],
    bold: Callable[[str], str],
    missing: str,
) -> list[list[str]]:
    lines = []
    for row in rows:
        line = [escape(str(row[key])) for key, _ in _FIXED]
        for column in columns:
            text = f"{row[column.key]:.{column.decimals}f}" if column.key in row else missing
            line.append(bold(text) if column.key in row and _is_best(row, rows, column) else text)
        lines.append(line)
    return lines


def _is_best(row: Row, rows: Sequence[Row], column: FigureColumn) -> bool:
    """Whether no row of the same identity and number of views is better, and one is worse, as printed."""
    same = [r for r in rows if (r["identity"], r["views"]) == (row["identity"], row["views"])]
    known = [round(r[column.key], column.decimals) for r in same if column.key in r]
    best = max(known) if column.higher else min(known)
    return len(set(known)) > 1 and round(row[column.key], column.decimals) == best


def _escaped(text: str) -> str:
    return "".join(_ESCAPES.get(c, c) for c in text)
