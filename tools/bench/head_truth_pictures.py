"""Pictures of a head's surface beside the truth, view by view, for `head_truth.py` and the page of the demo.

Per camera, in a folder of the head: CAMERA.depth.true.png, CAMERA.depth.png, CAMERA.depth.error.png, and the same of
normals. Depths have the colours that the true surface spans; errors have a scale of their own, the same everywhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from preface.capture.images import write_png
from preface.model.rendering.showing import (
    BAR_HEIGHT,
    BAR_WIDTH,
    depth_entry,
    depth_picture,
    normals_entry,
    normals_picture,
)
from preface.reports import colorize, finite_range, gradient
from preface.reports.pictures import LegendEntry

ERROR_COLORS = "inferno"  # matplotlib's name
DEPTH_ERROR_SHOWN = 20.0  # mm at the bright end
NORMALS_ERROR_SHOWN = 60.0  # degrees at the bright end

Triple = tuple[np.ndarray, np.ndarray, np.ndarray]


def write_pictures(folder: Path, camera: str, depths: Triple, normals: Triple) -> None:
    """Write the six pictures of a view.

    Args:
        folder: of the head, which exists.
        camera: its name.
        depths: true and rendered, [H, W], metres along the camera's axis, and the error, mm; NaN where there is none.
        normals: true and rendered, [H, W, 3] in one frame, and the angle between them, [H, W], degrees; NaN likewise.

    Raises:
        ArtifactError: the disk refuses.
    """
    near, far = finite_range(depths[0], 0, 100)
    drawn = {
        "depth.true": depth_picture(depths[0], near, far),
        "depth": depth_picture(depths[1], near, far),
        "depth.error": colorize(np.abs(depths[2]), 0, DEPTH_ERROR_SHOWN, ERROR_COLORS),
        "normals.true": normals_picture(normals[0]),
        "normals": normals_picture(normals[1]),
        "normals.error": colorize(normals[2], 0, NORMALS_ERROR_SHOWN, ERROR_COLORS),
    }
    for kind, picture in drawn.items():
        write_png(folder / f"{camera}.{kind}.png", picture)


def legend_entries(kind: str) -> list[LegendEntry]:
    """What the colours of the pictures of a kind mean, `depth` or `normals`."""
    values, most, unit = {
        "depth": (
            depth_entry("the nearest of the true surface in this view", "the furthest"),
            DEPTH_ERROR_SHOWN,
            " mm",
        ),
        "normals": (normals_entry(), NORMALS_ERROR_SHOWN, "°"),
    }[kind]
    return [values, ("error: 0", gradient(ERROR_COLORS, BAR_WIDTH, BAR_HEIGHT), f"{most:.0f}{unit} and more")]
