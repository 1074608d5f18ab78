"""How far a head from a few photographs can be trusted: what they settle, and what stands in for what they do not.

The numbers are those of the alignment's report and of the shards, the picture of the head is the fit's last preview;
nothing is measured anew but angles between views.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.photos.trust import NAMES as KEYPOINTS
from preface.align.photos.views import HARDLY
from preface.artifacts import ArtifactError, load_json
from preface.capture.foreground.sheet import MaskFigures, worst_first
from preface.capture.images import read_image
from preface.reports import Link, Report, contact_sheet
from preface.reports.pictures import Picture
from preface.shards import Dataset
from preface.shards.dataset.finishing import MASKS_FILE
from preface.shards.dataset.heads import mask_figures

REPORT_FILE, REPORT_PAGE = "report.json", "report.html"  # of an alignment
THUMBNAIL_HEIGHT = 240  # pixels, of a view
# The column of the alignment's report that says what a number rests on, in the alignment's words, and ours for them.
SOURCE = "rests on"
SOURCES = {
    "photographs": "Settled by the photographs",
    "exif": "From what the photographs' files say of the lens",
    "given": "Given by you",
    "expectation": "From what is usual of faces and of phones",
    "assumption": "Assumed",
    HARDLY: "Hardly settled by the photographs",
}
# Less than this between the outermost views shows depth by small displacements only: at half a metre and 20 degrees,
# a centimetre of depth moves a point by 3.5 mm.
NARROW, WIDE = math.radians(20), math.radians(45)


@dataclass(frozen=True, eq=False)
class Trust:
    """What is to be said.

    Attributes:
        numbers: what each number of the alignment rests on, in sentences.
        views: on the number of views and where they are.
        masks: on the masks.
        rows: of the table of views.
        thumbnails: the views that were fitted to, on black by their masks, with their names.
        preview: picture of the head beside the views.
        alignment, shards: folders, whose pages tell more.
        inputs: name -> file of what it was read from.
    """

    numbers: tuple[str, ...]
    views: tuple[str, ...]
    masks: tuple[str, ...]
    rows: tuple[Mapping[str, Any], ...]
    thumbnails: tuple[tuple[Picture, str], ...]
    preview: Path
    alignment: Path
    shards: Path
    inputs: Mapping[str, Path]

    @property
    def sentences(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.numbers, *self.views, *self.masks)

    def report(self, provenance: Mapping[str, Any], folder: Path) -> Report:
        """The same as a page, which is to lie in a folder.

        Raises:
            ArtifactError: the preview cannot be read.
        """

        def link(words: str, page: Path) -> Link:
            return Link(words, Path(os.path.relpath(page, folder)).as_posix())

        report = Report("How far this head can be trusted", provenance)
        report.section("The head").image(
            read_image(self.preview),
            "By row, one of the views: the photograph, the head rendered there, their difference, depth, normals, and "
            "the head from a new view.",
            "The head as it was found, rendered beside the photographs",
            "png",
        )
        section = report.section("What each number rests on")
        section.text("\n\n".join(self.numbers))
        section.links([link("report.html of the alignment: all its numbers", self.alignment / REPORT_PAGE)])
        section = report.section("Views")
        section.text("\n\n".join(self.views))
        height, width = self.thumbnails[0][0].shape[:2]
        section.image(
            contact_sheet(
                self.thumbnails,
                len(self.thumbnails),
                (round(THUMBNAIL_HEIGHT * width / height), THUMBNAIL_HEIGHT),
            ),
            f"The views at the {width}x{height} pixels that were fitted to, on black by their masks.",
            "The photographs, cut out around the head",
            "jpeg",
        )
        section.table(
            self.rows,
            "Where the views were taken from, to the subject's left and up, and their masks",
            units={"to the left": "°", "up": "°", "mask off the hull": "%"},
        )
        section = report.section("Masks")
        section.text("\n\n".join(self.masks))
        section.links([link("masks.html of the shards: the edges of the masks", self.shards / MASKS_FILE)])
        return report


def trust(alignment: Path, shards: Path, preview: Path, from_prior: bool) -> Trust:
    """Put together what is known.

    Args:
        alignment: folder, written by ``preface-align photos``.
        shards: folder, of one identity.
        preview: the fit's last picture.
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
        thumbnails = tuple((_on_black(dataset.pixels(0, view)), str(entry.cameras[view])) for view in valid)
        inputs = {"report.json": file, "manifest.json": dataset.manifest.path, preview.name: preview}
    azimuth, elevation = directions(centers)
    rows = tuple(
        {
            "view": camera,
            "to the left": math.degrees(left),
            "up": math.degrees(up),
            "mask": mask.method,
            "mask off the hull": 100 * mask.disagreement,
        }
        for camera, left, up, mask in zip(cameras, azimuth, elevation, masks, strict=True)
    )
    return Trust(
        numbers=tuple(_numbers(_tables(file))),
        views=tuple(_views(azimuth, widest_angle(centers), from_prior)),
        masks=tuple(_masks(masks)),
        rows=rows,
        thumbnails=thumbnails,
        preview=preview,
        alignment=alignment,
        shards=shards,
        inputs=inputs,
    )


def _on_black(pixels: np.ndarray) -> Picture:
    """Colour by coverage of a view uint8 [H, W, 4]."""
    return np.rint(pixels[..., :3] * (pixels[..., 3:] / 255.0)).astype(np.uint8)


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
    sentences = []
    for source, words in SOURCES.items():
        named = [_quantity(row) for row in rows if row[SOURCE] == source]
        if named:
            sentences.append(f"{words}: {'; '.join(named)}.")
    shares = [
        row["from the photographs"] for table in tables for row in table if "from the photographs" in row
    ]
    if shares:
        sentences.append(
            f"Of what differs among faces in eyes, nose, mouth and chin, the photographs settle "
            f"{min(shares):.0f}% to {max(shares):.0f}%; the expected face stands for the rest."
        )
    return sentences


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
