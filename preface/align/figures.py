"""Plots of an alignment: keypoints about the template, residuals, and which views agree.

They take arrays and draw; what the numbers mean is said by `report.py`.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.reports import new_figure

PAGE_WIDTH = 12.6  # inches
COLORS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e")  # one per keypoint
INK, SOFT, ACCENT = "#1c1e21", "#8a9199", "#0b62c4"
MAX_NAMED_ROWS = 70  # of the map of views: beyond, names of identities would overlap
# Panels: the axes across and up, and from where one looks.
VIEWS = ((0, 1, "from the front"), (2, 1, "from the subject's right"), (0, 2, "from above"))
AXES = ("x: subject's left (mm)", "y: up (mm)", "z: out of the face (mm)")


def keypoint_clouds(rows: Mapping[str, np.ndarray], template: np.ndarray) -> Figure:
    """Keypoints of all subjects as clouds about the template's, from three sides.

    Args:
        rows: title of a row of panels to keypoints [S, 5, 3], canonical frame, metres; NaN where missing.
        template: [5, 3], the same frame.
    """
    figure = new_figure(PAGE_WIDTH, 4.4 * len(rows), len(rows), len(VIEWS))
    for row, (title, points) in enumerate(rows.items()):
        every = 1e3 * np.concatenate([points.reshape(-1, 3), template])
        low, high = np.nanmin(every, axis=0) - 6, np.nanmax(every, axis=0) + 6
        panels = figure.axes[row * len(VIEWS) : (row + 1) * len(VIEWS)]
        for axis, (across, up, side) in zip(panels, VIEWS, strict=True):
            _cloud(axis, 1e3 * points[..., (across, up)], 1e3 * template[:, (across, up)])
            axis.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))
            axis.set(xlabel=AXES[across], ylabel=AXES[up], title=f"{title}, {side}")
            if up == 2:  # seen from above with x to the right, the face looks down
                axis.invert_yaxis()
            axis.set_aspect("equal")
    figure.axes[0].legend(fontsize=7, loc="lower left", handletextpad=0.2)
    return figure


def _cloud(axis: Axes, points: np.ndarray, template: np.ndarray) -> None:
    """Dots of every subject in the keypoint's colour, and the template as black crosses."""
    size = 6.0 if len(points) < 20 else 3.5 if len(points) < 200 else 2.0
    for index, name in enumerate(CANONICAL_KEYPOINTS):
        words = name.replace("_", " ")
        axis.plot(*points[:, index].T, ".", color=COLORS[index], markersize=size, alpha=0.7, label=words)
    axis.plot(*template.T, "+", color=INK, markersize=9, markeredgewidth=1.3, label="template")


def histograms(panels: Sequence[tuple[str, str, Mapping[str, np.ndarray]]]) -> Figure:
    """Step histograms side by side.

    Args:
        panels: of each its title, its axis label with the unit, and name to values; what is not finite is
            left out. The last bin holds all beyond the 99th percentile.
    """
    figure = new_figure(PAGE_WIDTH, 3.2, 1, len(panels))
    for axis, (title, label, series) in zip(figure.axes, panels, strict=True):
        known = {name: values[np.isfinite(values)] for name, values in series.items()}
        every = np.concatenate(list(known.values()))
        top = float(np.percentile(every, 99)) or 1.0 if every.size else 1.0
        edges = np.linspace(0, top, 41).tolist()
        for index, (name, values) in enumerate(known.items()):
            color = COLORS[index % len(COLORS)] if len(known) > 1 else ACCENT
            axis.hist(np.minimum(values, top), edges, histtype="step", color=color, label=name)
        axis.set(title=title, xlabel=label, ylabel="count")
        if len(known) > 1:
            axis.legend(fontsize=7)
    return figure


def agreement_map(
    identities: Sequence[str],
    cameras: Sequence[str],
    disagreement: np.ndarray,
    state: np.ndarray,
    limit: float,
) -> Figure:
    """Which views were used, and how far each is from what the other views say.

    Args:
        identities, cameras: names of rows and columns.
        disagreement: [identities, cameras] in per cent of the eye distance; NaN where it cannot be said.
        state: [identities, cameras], 1 used, 0 left out, -1 no landmarks.
        limit: per cent up to which a view is accepted; the end of the colour scale.
    """
    height = max(min(0.16 * len(identities), 14.0) + 1.2, 2.4)
    figure = new_figure(min(PAGE_WIDTH, 0.5 * len(cameras) + 5.5), height)
    (axis,) = figure.axes
    shown = np.where(state == 1, disagreement, np.nan)
    axis.set_facecolor("#ffffff")
    grey = np.where(state == -1, 0.78, np.where(state == 0, 0.0, np.nan))
    picture = axis.imshow(shown, vmin=0, vmax=limit, cmap="YlGnBu", aspect="auto", interpolation="nearest")
    axis.imshow(grey, vmin=0, vmax=1, cmap="gray", aspect="auto", interpolation="nearest")
    axis.grid(visible=False)
    axis.set_xticks(range(len(cameras)), cameras, rotation=60, ha="right", fontsize=7)
    if len(identities) <= MAX_NAMED_ROWS:
        axis.set_yticks(range(len(identities)), identities, fontsize=6)
    else:
        axis.set_ylabel("identities, in the manifest's order")
    axis.set_title("coloured: used; black: left out; grey: no landmarks; white: used, unchecked", fontsize=8)
    figure.colorbar(picture, ax=axis, label="worst keypoint (%)", pad=0.02)
    return figure
