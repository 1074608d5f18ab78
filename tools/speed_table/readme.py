"""The tables as Markdown, between their markers in a README."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from preface.artifacts import ArtifactError, write_bytes
from speed_table.keeping import Kept
from speed_table.model_stages import STAGES
from speed_table.stages import SCRIPTS

TABLE, FACES = "speed for accuracy", "real faces"
COLUMNS = 120  # of a line of text
FIGURES = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "lpips": ("LPIPS", ".3f"),
    "psnr_face": ("PSNR, face", ".2f"),
    "ssim_face": ("SSIM, face", ".3f"),
    "lpips_face": ("LPIPS, face", ".3f"),
}


def write(readme: Path, kept: Sequence[Kept]) -> Path:
    """Put the tables between their markers.

    Raises:
        ArtifactError: unreadable, a marker is missing or there twice, a kept file is of no known source, or the disk
            refuses.
    """
    try:
        text = readme.read_text()
    except OSError as error:
        raise ArtifactError.from_os(readme, "reading", error) from error
    return write_bytes(readme, filled(text, kept, readme).encode())


def filled(text: str, kept: Sequence[Kept], path: Path) -> str:
    """A README's text with the tables of what was kept; `path` is for errors."""
    for one in kept:
        if one.source not in SCRIPTS:
            remedy = f"Use one of {', '.join(SCRIPTS)}, or remove the file"
            raise ArtifactError(one.path, "source", f"is '{one.source}', which is none", remedy)
    for name, block in ((TABLE, speed_for_accuracy(kept)), (FACES, real_faces(kept))):
        text = _between(text, name, block, path)
    return text


def markers(name: str) -> tuple[str, str]:
    """The lines between which a table stands."""
    return f"<!-- {name}: begin, by tools/speed_for_accuracy.py -->", f"<!-- {name}: end -->"


def _between(text: str, name: str, block: str, path: Path) -> str:
    begin, end = markers(name)
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        remedy = f"Have the lines\n{begin}\n{end}\nin it once, in this order"
        raise ArtifactError(path, "markers", f"those of '{name}' are not there, or not once", remedy)
    before, after = text[: text.index(begin) + len(begin)], text[text.index(end) :]
    return f"{before}\n{block}{after}"


def speed_for_accuracy(kept: Sequence[Kept]) -> str:
    """The table of all stages that were measured, defaults bold, then each default with its reason."""
    lines, reasons = [], []
    for stage in STAGES:
        measured = [one for one in kept if one.source == stage.source]
        rows = [row for one in measured for row in stage.rows(one.measured)]
        for number, row in enumerate(rows):
            choice = f"**{row.choice}**" if row.default else row.choice
            lines.append(f"| {'' if number else stage.title} | {choice} | {row.time} | {row.error} |")
        if rows:
            of = "; ".join(dict.fromkeys(one.of for one in measured))
            reason = f"- {stage.title}: {stage.default}. {stage.why} (`{SCRIPTS[stage.source]}`: {of}.)"
            reasons.append(fill(reason, COLUMNS, subsequent_indent="  ", break_on_hyphens=False))
    if not lines:
        return ""
    head = ["| stage | choice, the default bold | time | error |", "|---|---|---|---|"]
    return "\n".join([*head, *lines, "", "The defaults, and why:", "", *reasons, ""])


def real_faces(kept: Sequence[Kept]) -> str:
    """A table per measurement of heads of real people, on views that they were not fitted to."""
    blocks = []
    for one in kept:
        if one.source == "real-faces" and one.measured:
            blocks += [f"{one.of} (`{SCRIPTS[one.source]}`):", "", _faces(one.measured), ""]
    return "\n".join(["### Real faces", "", *blocks]) if blocks else ""


def _faces(rows: Sequence[Mapping[str, Any]]) -> str:
    known = [name for name in FIGURES if any(name in row for row in rows)]
    head = ["person", "views", "fitted from", *(FIGURES[name][0] for name in known)]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for row in rows:
        cells = [str(row["person"]), str(row["views"]), str(row["fitted from"])]
        cells += [format(row[name], FIGURES[name][1]) if name in row else "–" for name in known]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
