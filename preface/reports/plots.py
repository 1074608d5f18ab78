"""Matplotlib figures without a display, and the encoding of figures and pictures for a page.

Nothing here touches ``pyplot``, whose list of figures is global state and whose backend may want a
display: a :class:`~matplotlib.figure.Figure` made by :func:`new_figure` belongs to its caller alone.
"""

import base64
import io
from typing import Any, Literal

import matplotlib
from matplotlib.figure import Figure
from PIL import Image

from preface.reports.pictures import Picture

JPEG_QUALITY = 90
PNG_DOTS_PER_INCH = 144  # two pixels per CSS pixel at matplotlib's usual 72 points per inch

_STYLE: dict[Any, Any] = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.constrained_layout.use": True,
    "font.size": 9.0,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.hashsalt": "preface",  # identifiers inside an SVG are random otherwise
}


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1) -> Figure:
    """An empty figure of ``width`` x ``height`` inches with ``rows`` x ``columns`` axes (``figure.axes``)."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height))
        figure.subplots(rows, columns)
        return figure


def encode_figure(figure: Figure, kind: Literal["svg", "png"]) -> bytes:
    """The figure as a file; the same figure gives the same bytes. Prefer PNG from some thousand marks on."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(buffer, format=kind, dpi=PNG_DOTS_PER_INCH, metadata=metadata)
    return buffer.getvalue()


def encode_picture(picture: Picture, kind: Literal["png", "jpeg"]) -> bytes:
    """Bytes ``[H, W, 3]`` as a file: PNG for maps and drawings, JPEG (4:4:4) for photographs."""
    buffer = io.BytesIO()
    image = Image.fromarray(picture)
    if kind == "png":
        image.save(buffer, "png", optimize=True)
    else:
        image.save(buffer, "jpeg", quality=JPEG_QUALITY, subsampling=0)
    return buffer.getvalue()


def data_uri(content: bytes, kind: Literal["svg", "png", "jpeg"]) -> str:
    """The content of an image file as a URI that a page can hold in itself."""
    media_type = "image/svg+xml" if kind == "svg" else f"image/{kind}"
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"
