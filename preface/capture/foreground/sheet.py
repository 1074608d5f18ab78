"""The report on masks: their edges over the photographs, those that deserve a look first."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from preface.capture.foreground.result import Foreground
from preface.capture.images import displayable
from preface.reports import KeyFigure, Report, contact_sheet, overlay_mask_edges
from preface.reports.pictures import Color, Picture

SHOWN = 36  # views on the sheet
COLUMNS = 6
TILE = (240, 320)  # pixels
LINE: Color = (255, 60, 200)  # a colour that neither skin, hair, nor a screen has
DIMMED = 0.35  # of the light of what is taken for background remains visible on the sheet
MAX_LISTED = 60
UNDECIDED = (0.05, 0.95)

LoadView = Callable[[str, str], tuple[np.ndarray, np.ndarray]]  # a photograph and its coverage, of one size


@dataclass(frozen=True)
class MaskFigures:
    """What is known about the mask of one view, without its pixels.

    Attributes:
        identity, camera: the view.
        method: that found it.
        share: of the image that is foreground.
        soft: share of the foreground whose coverage is neither 0 nor 1: hair, blur, or doubt.
        disagreement: with the hull of the other views (`hull_disagreement`), NaN where unknown.
        flagged: whether it contradicts them.
        notes: of the method.
    """

    identity: str
    camera: str
    method: str
    share: float
    soft: float
    disagreement: float = float("nan")
    flagged: bool = False
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        identity: str,
        camera: str,
        found: Foreground,
        disagreement: float = float("nan"),
        flagged: bool = False,
    ) -> MaskFigures:
        """Measure a view's mask."""
        soft = float(((found.alpha > UNDECIDED[0]) & (found.alpha < UNDECIDED[1])).mean())
        share = float(found.alpha.mean())
        soft = soft / share if share > 0 else 0.0
        return cls(identity, camera, found.method, share, soft, disagreement, flagged, found.notes)


def worst_first(figures: Sequence[MaskFigures]) -> list[MaskFigures]:
    """All masks: flagged ones, then those with notes, each by how far they are off the hull.

    Those of which that is unknown come last, the unusual first: a mask that covers much more or less of the image
    than the camera's others, or has a soft edge that is wide.
    """
    by_camera = defaultdict(list)
    for one in figures:
        by_camera[one.camera].append(one.share)
    usual = {camera: float(np.median(shares)) for camera, shares in by_camera.items()}

    def badness(one: MaskFigures) -> tuple[bool, bool, float, float]:
        disagreement = -1.0 if np.isnan(one.disagreement) else one.disagreement
        unusual = abs(one.share - usual[one.camera]) + one.soft
        return one.flagged, bool(one.notes), disagreement, unusual

    return sorted(figures, key=badness, reverse=True)


def mask_report(
    figures: Sequence[MaskFigures], load: LoadView, choices: Mapping[str, str], provenance: Mapping[str, Any]
) -> Report:
    """Put the report together.

    Args:
        figures: of every mask.
        load: a photograph [h, w, ...] and its coverage [h, w] by identity and camera; called for those shown only.
        choices: take to "method: reason".
        provenance: of the page.

    Raises:
        ValueError: no figures.
    """
    if not figures:
        raise ValueError("figures: there is no mask to report on")
    ordered = worst_first(figures)
    report = Report(f"Foreground of {len(figures)} photographs", provenance)
    section = report.section("Summary")
    flagged = sum(one.flagged for one in figures)
    methods = ", ".join(sorted({one.method for one in figures}))
    checked = [one.disagreement for one in figures if not np.isnan(one.disagreement)]
    section.key_figures(
        [
            KeyFigure("Masks", len(figures)),
            KeyFigure("Methods", methods),
            KeyFigure("Flagged: contradict the other views", flagged),
            KeyFigure("Off the hull, median", 100 * float(np.median(checked)) if checked else None, "%"),
            KeyFigure("Foreground, median", 100 * float(np.median([one.share for one in figures])), "%"),
        ]
    )
    if choices:
        rows = [{"take": take, "method and reason": words} for take, words in choices.items()]
        section.table(rows, "How the foreground was found")
    edges = report.section(
        "Edges, worst first",
        "The line is where coverage crosses one half; what is taken for background is dimmed. How far a mask is off "
        "the hull is the share of it that the other views' masks leave no room for, or the share of what they leave "
        "that it alone removes, whichever is larger. With few views that is often much; masks that stand out "
        "contradict the other views and are flagged. First come the flagged ones, then those with a remark, then the "
        "others, those furthest off the hull first.",
    )
    shown = ordered[:SHOWN]
    tiles = [(_tile(*load(one.identity, one.camera)), _caption(one)) for one in shown]
    edges.image(
        contact_sheet(tiles, COLUMNS, TILE),
        f"{len(shown)} of {len(figures)} masks",
        "Photographs with the outline of the foreground drawn over them",
        "jpeg",
    )
    edges.table(
        [_row(one) for one in ordered[:MAX_LISTED]],
        f"The first {min(len(ordered), MAX_LISTED)} of them: the foreground's share of the image, the soft edge's of "
        "the foreground, and how far the mask is off the hull",
        units=dict.fromkeys(("foreground", "soft", "off the hull"), "%"),
    )
    return report


def _tile(pixels: np.ndarray, alpha: np.ndarray) -> Picture:
    """A photograph reduced to a tile, with its background dimmed and the edge drawn."""
    height, width = alpha.shape
    scale = min(1.0, 2 * max(TILE) / max(height, width))  # twice the tile's size, so that the line stays thin
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    image = cv2.resize(displayable(pixels), size, interpolation=cv2.INTER_AREA)
    mask = cv2.resize(alpha.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    dimmed = image * (DIMMED + (1 - DIMMED) * mask[..., None])
    return overlay_mask_edges(np.rint(dimmed).astype(np.uint8), mask, 1, LINE)


def _caption(one: MaskFigures) -> str:
    doubt = "" if np.isnan(one.disagreement) else f"{one.disagreement:.0%} off the hull"
    mark = " FLAGGED" if one.flagged else " (remark)" if one.notes else ""
    return f"{one.identity} {one.camera}\n{doubt}{mark}"


def _row(one: MaskFigures) -> dict[str, Any]:
    return {
        "view": f"{one.identity} {one.camera}",
        "method": one.method,
        "foreground": 100 * one.share,
        "soft": 100 * one.soft,
        "off the hull": 100 * one.disagreement,
        "flagged": one.flagged,
        "remarks": "; ".join(one.notes),
    }
