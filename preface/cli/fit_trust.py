"""How far a head from a few photographs can be trusted: what they settle, and what stands in for what they do not.

The numbers are those of the alignment's report and of the shards; nothing is measured anew but angles between views.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.photos.trust import NAMES as KEYPOINTS
from preface.artifacts import ArtifactError, load_json
from preface.capture.foreground.sheet import MaskFigures, worst_first
from preface.reports import Report
from preface.shards import Dataset
from preface.shards.dataset.heads import mask_figures

REPORT_FILE = "report.json"  # of an alignment
# The column of the alignment's report that says what a number rests on, in the alignment's words, and ours for them.
SOURCE = "rests on"
SOURCES = {
    "photographs": "Settled by the photographs",
    "exif": "From what the photographs' files say of the lens",
    "given": "Given by you",
    "expectation": "From what is usual of faces and of phones",
    "assumption": "Assumed",
}
# Less than this between the outermost views shows depth by small displacements only: at half a metre and 20 degrees,
# a centimetre of depth moves a point by 3.5 mm.
NARROW, WIDE = math.radians(20), math.radians(45)
# A deviation of more than this share of its number is no settled number, whatever it rests on.
LOOSE = 0.1


@dataclass(frozen=True, eq=False)
class Trust:
    """What is to be said.

    Attributes:
        numbers: what each number of the alignment rests on, in sentences.
        views: on the number of views and where they are.
        masks: on the masks.
        rows: of the table of views.
        inputs: name -> file of what it was read from.
    """

    numbers: tuple[str, ...]
    views: tuple[str, ...]
    masks: tuple[str, ...]
    rows: tuple[Mapping[str, Any], ...]
    inputs: Mapping[str, Path]

    @property
    def sentences(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.numbers, *self.views, *self.masks)

    def report(self, provenance: Mapping[str, Any]) -> Report:
        """The same as a page."""
        report = Report("How far this head can be trusted", provenance)
        report.section("What each number rests on").text("\n\n".join(self.numbers))
        section = report.section("Views")
        section.text("\n\n".join(self.views))
        section.table(
            self.rows,
            "Where the views were taken from, to the subject's left and up, and their masks",
            units={"to the left": "°", "up": "°", "mask contradicts the others": "%"},
        )
        report.section("Masks").text("\n\n".join(self.masks))
        return report


def trust(alignment: Path, shards: Path, from_prior: bool) -> Trust:
    """Put together what is known.

    Args:
        alignment: folder, written by ``preface-align photos``.
        shards: folder, of one identity.
        from_prior: whether a prior of heads was there to fill in what no photograph shows.

    Raises:
        ArtifactError: a file is missing or damaged.
    """
    file = alignment / REPORT_FILE
    with Dataset(shards) as dataset:
        valid = np.flatnonzero(dataset.index().valid[0])
        centers = dataset.tables["canonical_from_camera"][0][valid][:, :, 3]
        (entry,) = dataset.manifest.identities
        cameras = [str(entry.cameras[view]) for view in valid]
        metadata = dataset.shards[0].people[0]["metadata"]
        masks = [mask_figures(entry.identity, camera, metadata) for camera in cameras]
        inputs = {"report.json": file, "manifest.json": dataset.manifest.path}
    azimuth, elevation = directions(centers)
    rows = tuple(
        {
            "view": camera,
            "to the left": math.degrees(left),
            "up": math.degrees(up),
            "mask": mask.method,
            "mask contradicts the others": 100 * mask.disagreement,
        }
        for camera, left, up, mask in zip(cameras, azimuth, elevation, masks, strict=True)
    )
    return Trust(
        numbers=tuple(_numbers(_tables(file))),
        views=tuple(_views(azimuth, widest_angle(centers), from_prior)),
        masks=tuple(_masks(masks)),
        rows=rows,
        inputs=inputs,
    )


def directions(centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth to the subject's left and elevation [v] of camera centres [v, 3] of the canonical frame, radians."""
    x, y, z = np.asarray(centers, np.float64).T
    return np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))


def widest_angle(centers: np.ndarray) -> float:
    """The largest angle between two of the camera centres [v, 3], seen from the origin, radians; 0 for one."""
    unit = centers / np.linalg.norm(centers, axis=1, keepdims=True)
    across = np.linalg.norm(np.cross(unit[:, None], unit[None]), axis=-1)
    return float(np.arctan2(across, unit @ unit.T).max())


def _tables(file: Path) -> list[Sequence[Mapping[str, Any]]]:
    """The rows of all tables of a report.

    Raises:
        ArtifactError: it cannot be read, or it is no report.
    """
    content = load_json(file)
    try:
        blocks = [block for section in content["sections"] for block in section["blocks"]]
        return [block["rows"] for block in blocks if block["kind"] == "table"]
    except (KeyError, TypeError) as error:
        raise ArtifactError(
            file, "sections", "is not a report of preface", "Remove the folder to align again"
        ) from error


def _numbers(tables: Sequence[Sequence[Mapping[str, Any]]]) -> list[str]:
    """Which numbers rest on what."""
    rows = [row for table in tables for row in table if SOURCE in row]
    loose = [row for row in rows if row[SOURCE] == "photographs" and _is_loose(row)]
    sentences = []
    for source, words in SOURCES.items():
        named = [_quantity(row) for row in rows if row[SOURCE] == source and row not in loose]
        if named:
            sentences.append(f"{words}: {'; '.join(named)}.")
    if loose:
        sentences.append(f"Hardly settled by the photographs: {'; '.join(map(_quantity, loose))}.")
    shares = [
        row["from the photographs"] for table in tables for row in table if "from the photographs" in row
    ]
    if shares:
        sentences.append(
            f"Of what differs among faces in eyes, nose, mouth and chin, the photographs settle "
            f"{min(shares):.0f}% to {max(shares):.0f}%; the expected face stands for the rest."
        )
    return sentences


def _is_loose(row: Mapping[str, Any]) -> bool:
    value, deviation = row.get("value"), row.get("±")
    if not isinstance(value, int | float) or not isinstance(deviation, int | float):
        return False
    return deviation > LOOSE * abs(value)


def _quantity(row: Mapping[str, Any]) -> str:
    value, deviation, unit = (row.get(name) for name in ("value", "±", "unit"))
    what = KEYPOINTS.get(row["what"], row["what"])
    if isinstance(value, int | float) and isinstance(deviation, int | float):
        return (
            f"{what} {value:.0f} ± {deviation:.0f} {unit}"
            if unit
            else f"{what} {value:.3f} ± {deviation:.3f}"
        )
    return f"{what} to {deviation:.1f} {unit}" if isinstance(deviation, int | float) else str(what)


def _views(azimuth: np.ndarray, spread: float, from_prior: bool) -> list[str]:
    """What number and angles of the views mean for depth and for the sides."""
    who = "the prior's heads" if from_prior else "nothing: there is no prior"
    right, left = (math.degrees(angle) for angle in (azimuth.min(), azimuth.max()))
    where = f"from {_side(right)} to {_side(left)}"
    if len(azimuth) == 1:
        first = f"One view, {_side(left)}: it shows no depth at all, and depth rests on {who}."
    else:
        apart = f"{len(azimuth)} views, {where}, at most {math.degrees(spread):.0f}° apart: "
        if spread < NARROW:
            first = apart + f"they hardly show depth, which rests mostly on {who}."
        elif spread < WIDE:
            first = apart + f"they show depth where several see the same; elsewhere it rests on {who}."
        else:
            first = apart + "they show depth well where several see the same."
    return [
        first,
        f"What no view sees (ears and hair on a far side, the back of the head) rests on {who}. Renders are best "
        "within a few degrees of the views.",
    ]


def _side(degrees: float) -> str:
    if round(degrees) == 0:
        return "straight ahead"
    return f"{abs(degrees):.0f}° to the subject's {'left' if degrees > 0 else 'right'}"


def _masks(masks: Sequence[MaskFigures]) -> list[str]:
    """Which masks there are, and which of them to look at."""
    methods = ", ".join(sorted({mask.method for mask in masks}))
    sentences = [f"Masks by {methods}; masks.html of the shards shows them, those that deserve a look first."]
    for mask in worst_first(masks):
        if mask.flagged:
            sentences.append(
                f"'{mask.camera}': its mask contradicts the others by {mask.disagreement:.0%}; look at it, and give a "
                "better one by --photos.masks if it cuts into the head. Inexact cameras do the same."
            )
        sentences += [f"'{mask.camera}': {note}" for note in mask.notes]
    return sentences
