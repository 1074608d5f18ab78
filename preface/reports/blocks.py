"""What a section of a report is made of: each block knows its content and its part of the JSON twin.

The page's template draws the same blocks by their ``kind``.
"""

import base64
import hashlib
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal

from preface.reports.plots import data_uri
from preface.reports.values import Target, Value


@dataclass(frozen=True)
class KeyFigure:
    """One number or word that a reader should see first, with its unit and its target, if it has one."""

    name: str
    value: Any
    unit: str = ""
    target: Target | None = None


@dataclass(frozen=True)
class Text:
    """Paragraphs of plain text."""

    kind: ClassVar[str] = "text"
    paragraphs: tuple[str, ...]

    def twin(self) -> dict[str, Any]:
        """The block for the twin."""
        return {"kind": self.kind, "paragraphs": list(self.paragraphs)}


@dataclass(frozen=True)
class KeyFigures:
    """A row of figures in large print."""

    kind: ClassVar[str] = "key_figures"
    figures: tuple[KeyFigure, ...]

    def twin(self) -> dict[str, Any]:
        """The block for the twin."""
        return {"kind": self.kind, "figures": [self._twin(figure) for figure in self.figures]}

    @staticmethod
    def _twin(figure: KeyFigure) -> dict[str, Any]:
        met = None if figure.target is None else figure.target.met_by(figure.value)
        return {**asdict(figure), "met": met}


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str
    unit: str
    target: Target | None
    sorted: Literal["ascending", "descending"] | None
    numeric: bool


@dataclass(frozen=True)
class Table:
    """Rows of plain values under named columns; the first column names the row."""

    kind: ClassVar[str] = "table"
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[dict[str, Value], ...]

    def twin(self) -> dict[str, Any]:
        """The block for the twin."""
        columns = [
            {"name": c.name, "unit": c.unit, "target": None if c.target is None else asdict(c.target)}
            for c in self.columns
        ]
        return {"kind": self.kind, "caption": self.caption, "columns": columns, "rows": self.rows}


@dataclass(frozen=True)
class Picture:
    """An encoded image or plot."""

    kind: ClassVar[str] = "picture"
    caption: str
    alt: str
    media: Literal["png", "jpeg", "svg"]
    content: bytes = field(repr=False)
    width: int  # CSS pixels
    height: int

    @property
    def uri(self) -> str:
        """The picture as the page holds it."""
        return data_uri(self.content, self.media)

    def twin(self) -> dict[str, Any]:
        """The block for the twin; the picture itself by its sha256."""
        entry = {name: value for name, value in asdict(self).items() if name != "content"}
        return {"kind": self.kind, **entry, "sha256": hashlib.sha256(self.content).hexdigest()}


@dataclass(frozen=True)
class Video:
    """A WebM file, played in the page."""

    kind: ClassVar[str] = "video"
    caption: str
    alt: str
    content: bytes = field(repr=False)
    width: int  # CSS pixels
    height: int

    @property
    def uri(self) -> str:
        """The video as the page holds it."""
        return f"data:video/webm;base64,{base64.b64encode(self.content).decode('ascii')}"

    def twin(self) -> dict[str, Any]:
        """The block for the twin; the video itself by its sha256."""
        entry = {name: value for name, value in asdict(self).items() if name != "content"}
        return {"kind": self.kind, **entry, "sha256": hashlib.sha256(self.content).hexdigest()}


@dataclass(frozen=True)
class Link:
    """A file near the page: what it is, and its path from the page's folder, with forward slashes."""

    text: str
    path: str


@dataclass(frozen=True)
class Links:
    """Files near the page, which do not travel with it."""

    kind: ClassVar[str] = "links"
    links: tuple[Link, ...]

    def twin(self) -> dict[str, Any]:
        """The block for the twin."""
        return {"kind": self.kind, "links": [asdict(link) for link in self.links]}


Block = Text | KeyFigures | Table | Picture | Video | Links
