"""Contact sheets, plots and self-contained HTML reports with a JSON twin.

Shared by every command that shows results. It knows images, numbers and words, not what they mean: no
cameras, no faces, no networks.

- :mod:`preface.reports.pictures` turns arrays into pictures: contact sheets, legends, heat maps, overlays.
- :mod:`preface.reports.plots` makes matplotlib figures without a display and encodes them.
- :mod:`preface.reports.page` collects sections into a :class:`Report` and writes ``NAME.html`` and
  ``NAME.json``.

>>> report = Report("Calibration of take 2", provenance={"seed": 7})
>>> section = report.section("Cameras", "One row per camera, worst first.")
>>> section.table(
...     [{"camera": "C00", "rms": 0.21}, {"camera": "C01", "rms": 0.34}],
...     "Reprojection error", units={"rms": "px"}, sort_by="rms", targets={"rms": Target(at_most=0.3)},
... )
>>> page = report.write(Path("calibration/report.html"))  # doctest: +SKIP
"""

from preface.reports.blocks import KeyFigure, Link
from preface.reports.page import Report, Section
from preface.reports.pictures import (
    colorize,
    contact_sheet,
    finite_range,
    gradient,
    heat_map,
    legend,
    overlay_mask_edges,
    overlay_points,
    with_legend,
)
from preface.reports.plots import new_figure
from preface.reports.values import Target

__all__ = [
    "KeyFigure",
    "Link",
    "Report",
    "Section",
    "Target",
    "colorize",
    "contact_sheet",
    "finite_range",
    "gradient",
    "heat_map",
    "legend",
    "new_figure",
    "overlay_mask_edges",
    "overlay_points",
    "with_legend",
]
