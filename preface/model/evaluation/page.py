"""The page of an evaluation: one head, or several beside each other, with every picture and every figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from preface.model.evaluation.metrics_file import Measured
from preface.model.evaluation.options import EvaluationOptions
from preface.model.evaluation.sheets import (
    DEPTH_SHOWN,
    ViewPictures,
    comparison_sheet,
    face_sheet,
    input_sheet,
    sheet,
)
from preface.model.evaluation.tables import FACE, FIGURE_COLUMNS, FOREGROUND, FRAME, row_of
from preface.model.rendering.showing import ERROR_SHOWN
from preface.reports import KeyFigure, Report, Section, new_figure

UNITS = {"psnr_face": "dB", "psnr": "dB", "psnr_foreground": "dB"}
_HEADLINES = (
    ("psnr_face", "PSNR of the face"),
    ("ssim_face", "SSIM of the face"),
    ("lpips_face", "LPIPS of the face, VGG"),
    ("lpips_alex_face", "LPIPS of the face, AlexNet"),
    ("psnr", "PSNR of the frame"),
    ("silhouette_iou", "silhouette, IoU"),
)


@dataclass(frozen=True, eq=False)
class HeadResult:
    """A head with what is shown of it.

    Attributes:
        measured: its figures.
        fitted: names of the cameras whose photographs it has seen.
        inputs: those photographs on black, float [H, W, 3], with names; empty for a prior.
        pictures: of its views.
    """

    measured: Measured
    fitted: tuple[str, ...]
    inputs: tuple[tuple[np.ndarray, str], ...]
    pictures: tuple[ViewPictures, ...]


def evaluation_page(
    heads: Sequence[HeadResult],
    options: EvaluationOptions,
    size: tuple[int, int],
    provenance: Mapping[str, Any],
) -> Report:
    """Put the page together.

    Args:
        heads: at least one; those of one identity were evaluated at the same views.
        options: that the figures were measured with.
        size: width and height of photographs and renders.
        provenance: as `preface.artifacts.provenance` returns it.
    """
    names = ", ".join(head.measured.name for head in heads)
    identities = list(dict.fromkeys(head.measured.identity for head in heads))
    report = Report(f"Evaluation of {', '.join(identities)}: {names}", provenance)
    _result(report.section("Result"), heads, size)
    for identity in identities:
        same = [head for head in heads if head.measured.identity == identity]
        if len(same) > 1:
            section = report.section(f"{identity}: heads beside each other")
            rows = [(head.measured.name, head.pictures) for head in same]
            section.image(
                comparison_sheet(rows),
                "By row, one camera: the photograph on black, then render and error of each head.",
                f"Renders and errors of {', '.join(name for name, _ in rows)} beside the photographs.",
                "jpeg",
            )
    for head in heads:
        _head(report.section(head.measured.name), head)
    angles = _angle_plot(heads)
    if angles is not None:
        section = report.section("Distance from what was photographed")
        section.plot(
            angles,
            "Each mark is a view: how far its camera is from the nearest one whose photograph the model has seen, as "
            "an angle at the head, and the PSNR of the face there.",
            "Scatter plot of PSNR of the face over the angle to the nearest camera that was fitted to.",
            "svg",
        )
    _method(report.section("How it was measured"), heads, options, size)
    return report


def _result(section: Section, heads: Sequence[HeadResult], size: tuple[int, int]) -> None:
    seen = sum(view.fitted for head in heads for view in head.measured.views)
    section.text(
        f"Means over views at {size[0]}x{size[1]} pixels, on black. "
        + (
            f"{seen} of the views were fitted to: their figures say how well photographs are repeated, and not how "
            "well a head is known."
            if seen
            else "The models have seen none of these photographs."
        )
    )
    if len(heads) == 1:
        mean = heads[0].measured.mean
        shown = [(key, name) for key, name in _HEADLINES if key in mean]
        section.key_figures([KeyFigure(name, mean[key], UNITS.get(key, "")) for key, name in shown])
        section.text(_spread(heads[0].measured))
        return
    firsts, values = [], []
    for head in heads:
        row = row_of(head.measured, len(head.fitted))
        several = len({other.measured.identity for other in heads}) > 1
        first = {"head": row["name"]} | ({"identity": row["identity"]} if several else {})
        firsts.append(first | {"fitted to": row["fitted"], "views": row["views"]})
        values.append(row)
    _tables(section, firsts, values, {}, worst_first=False)


def _spread(measured: Measured) -> str:
    """How far apart the views are, in words."""
    key, words = ("psnr_face", "face") if "psnr_face" in measured.mean else ("psnr", "frame")
    known = sorted((view.values[key], view.name) for view in measured.views if key in view.values)
    (low, worst), (high, best) = known[0], known[-1]
    spread = float(np.std([value for value, _ in known]))
    return (
        f"PSNR of the {words} by view: from {low:.2f} dB ({worst}) to {high:.2f} dB ({best}), standard deviation "
        f"{spread:.2f} dB, {len(known)} views."
    )


def _tables(
    section: Section,
    firsts: Sequence[Mapping[str, Any]],
    values: Sequence[Mapping[str, Any]],
    units: Mapping[str, str],
    *,
    worst_first: bool,
) -> None:
    """The figures of rows in two tables, which one page's width does not hold together.

    Args:
        section: gets them.
        firsts: of each row, what it begins with.
        values: of each row, its figures.
        units: of what it begins with.
        worst_first: whether to sort by PSNR.
    """
    for caption, parts in (
        ("The face", (FACE,)),
        ("The whole frame, and the foreground", (FRAME, FOREGROUND)),
    ):
        columns = [c for c in FIGURE_COLUMNS if c.of in parts and any(c.key in row for row in values)]
        if not columns:
            continue
        labels = {column.key: f"{column.of} {column.heading}" for column in columns}
        rows = [
            {**first, **{labels[key]: row[key] for key in labels if key in row}}
            for first, row in zip(firsts, values, strict=True)
        ]
        of_figures = {labels[key]: UNITS[key] for key in labels if key in UNITS}
        section.table(
            rows,
            f"{caption}, worst first" if worst_first else f"{caption}, means over views",
            units={**units, **of_figures},
            sort_by=labels[columns[0].key] if worst_first else None,
            descending=False,
        )


def _head(section: Section, head: HeadResult) -> None:
    measured = head.measured
    section.text(_in_words(head))
    if head.inputs:
        section.image(
            input_sheet(head.inputs),
            "The photographs that the head was fitted to, on black by their masks.",
            f"Photographs of {measured.identity} by {', '.join(name for _, name in head.inputs)}.",
            "jpeg",
        )
    faces = face_sheet(head.pictures)
    if faces is not None:
        section.image(
            faces,
            f"Faces: photograph, render, and the mean absolute error over channels from black (0) to yellow "
            f"({ERROR_SHOWN} of full scale, and all above).",
            f"The face of {measured.identity} in each view, photograph beside render and error.",
            "jpeg",
        )
    normals = any(view.normals is not None for view in head.pictures)
    frame = ", normals in the canonical frame"
    section.image(
        sheet(head.pictures),
        f"Whole frames: photograph, render, error, depth in front of the camera ({DEPTH_SHOWN} m before and behind the "
        f"middle of the face; a checker board where the head is transparent){frame if normals else ''}, opacity. The "
        "legend at the bottom says what the colours mean.",
        f"All views of {measured.identity} with error, depth{', normals' if normals else ''} and opacity.",
        "jpeg",
    )
    firsts = []
    for view in measured.views:
        first: dict[str, Any] = {"camera": view.name, "degrees from fitted": view.degrees_from_fitted}
        firsts.append(first | ({"fitted": view.fitted} if any(v.fitted for v in measured.views) else {}))
    values = [view.values for view in measured.views]
    _tables(section, firsts, values, {"degrees from fitted": "°"}, worst_first=True)
    left_out = {
        f"{view.name}, {figure}: {why}" for view in measured.views for figure, why in view.left_out.items()
    }
    if left_out:
        section.text("Figures left out: " + "; ".join(sorted(left_out)) + ".")


def _in_words(head: HeadResult) -> str:
    prior = head.measured.prior
    if prior.fit is None:
        return (
            f"An identity of a prior that took {prior.step} steps; it has seen {len(head.fitted)} photographs of "
            f"{head.measured.identity}, and {len(prior.identities) - 1} other people."
        )
    start = "without a prior" if prior.fit["prior"] is None else "from a prior"
    count, size = len(head.fitted), prior.fit["resolution"]
    refined = ", whose cameras it corrected; views are rendered with the cameras of the shards"
    refined = refined if prior.fit["cameras"] else ""
    return (
        f"Fitted {start} to {count} photograph{'s' if count != 1 else ''} of {head.measured.identity} "
        f"({', '.join(head.fitted)}) at {size['width']}x{size['height']} pixels{refined}. "
        f"Inversion took {prior.fit['inversion']['steps']} steps, finetuning {prior.fit['finetuning']['steps']}."
    )


def _method(
    section: Section, heads: Sequence[HeadResult], options: EvaluationOptions, size: tuple[int, int]
) -> None:
    modelled = [h.measured.name for h in heads if h.measured.prior.model.background == "modelled"]
    but = (
        f"; but {', '.join(modelled)}, which model the background too, are masked as the photograph is"
        if modelled
        else ""
    )
    section.text(
        f"""Heads are rendered by the cameras of the photographs, lens included, at {size[0]}x{size[1]} pixels in
        front of black by the quality '{options.quality}', and clipped to [0, 1]. The truth is the photograph on black
        by its mask. Nothing of the render is masked, so that what floats beside a head counts against it{but}.

        The face is the square about the image of the canonical origin that {2 * options.face_half_side:g} m fill at
        its depth. PSNR is of all pixels and channels at a peak of 1. SSIM has Gaussian windows of 11x11 with sigma
        1.5, K1 0.01 and K2 0.03, inside the image only. LPIPS is version 0.1 with the original weights on VGG16, and
        on AlexNet (LPIPS-A), which inversion does not descend on by default. Foreground figures are of pixels that are
        more than half foreground; the IoU of silhouettes compares them with where the render is more than half opaque.
        PSNR and SSIM are better when larger, LPIPS when smaller."""
    )


def _angle_plot(heads: Sequence[HeadResult]) -> Figure | None:
    points = [
        (head.measured.name, view.degrees_from_fitted, view.values["psnr_face"])
        for head in heads
        for view in head.measured.views
        if view.degrees_from_fitted is not None and "psnr_face" in view.values
    ]
    if len(points) < 2:
        return None
    figure = new_figure(6.5, 3.2)
    axes = figure.axes[0]
    for marker, name in zip(
        "os^DvPX*" * len(heads), dict.fromkeys(name for name, _, _ in points), strict=False
    ):
        of_head = np.array([(x, y) for n, x, y in points if n == name])
        axes.plot(*of_head.T, marker, label=name, markersize=5, alpha=0.8)
    axes.set_xlabel("degrees from the nearest camera that was fitted to")
    axes.set_ylabel("PSNR of the face, dB")
    axes.legend()
    return figure
