"""Reports: sections of text, key figures, tables and pictures, as one HTML file and its JSON twin.

The page stands alone: style, script, pictures and videos are inside it, and its content security policy forbids
everything else. The twin holds the same figures at full precision for machines, and the sha256 of every
picture. The same input gives the same bytes.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import jinja2
from matplotlib.figure import Figure
from numpy.typing import NDArray

from preface.artifacts import write_artifact, write_bytes
from preface.reports.blocks import (
    Block,
    Column,
    KeyFigure,
    KeyFigures,
    Link,
    Links,
    Picture,
    Table,
    Text,
    Video,
)
from preface.reports.pictures import as_picture
from preface.reports.plots import encode_figure, encode_picture
from preface.reports.values import Target, Value, encodable, is_number, json_tree, plain, shown

SCHEMA = "preface/report"
SCHEMA_VERSION = 1
_EBML = b"\x1a\x45\xdf\xa3"  # what WebM files begin with


class Section:
    """A headed part of a report; blocks appear in the order in which they were added."""

    def __init__(self, heading: str):
        self.heading = heading
        self.blocks: list[Block] = []

    def text(self, text: str) -> None:
        """Adds plain text; blank lines separate paragraphs."""
        paragraphs = tuple(" ".join(part.split()) for part in text.split("\n\n") if part.strip())
        if paragraphs:
            self.blocks.append(Text(paragraphs))

    def key_figures(self, figures: Sequence[KeyFigure]) -> None:
        """Adds figures in large print; a target is shown with whether it is met."""
        self.blocks.append(
            KeyFigures(tuple(KeyFigure(f.name, plain(f.value), f.unit, f.target) for f in figures))
        )

    def table(
        self,
        rows: Sequence[Mapping[str, Any]],
        caption: str,
        *,
        units: Mapping[str, str] | None = None,
        sort_by: str | None = None,
        descending: bool = True,
        targets: Mapping[str, Target] | None = None,
    ) -> None:
        """Adds a table with one line per row.

        Args:
            rows: column name -> value. Columns appear in order of first appearance; a value that a row
                lacks is missing.
            caption: what the table shows.
            units: column name -> unit, shown in the heading.
            sort_by: a column to sort by, missing values last; None keeps the given order.
            descending: the largest first.
            targets: column name -> target; cells that miss it are marked.

        Raises:
            ValueError: no rows, or a unit, target or ``sort_by`` for a column that no row has.
            TypeError: a value that is neither a number, text, path, truth value nor None.
        """
        units, targets = units or {}, targets or {}
        names = list(dict.fromkeys(name for row in rows for name in row))
        unknown = sorted({*units, *targets, *([sort_by] if sort_by is not None else [])} - set(names))
        if not names or unknown:
            raise ValueError(
                f"table {caption!r}: columns are {names}, but {unknown or 'rows'} were asked for"
            )
        filled = [{name: plain(row.get(name)) for name in names} for row in rows]
        if sort_by is not None:
            filled = _sorted_rows(filled, sort_by, descending)
        direction: Literal["ascending", "descending"] = "descending" if descending else "ascending"
        columns = tuple(
            Column(
                name,
                units.get(name, ""),
                targets.get(name),
                direction if name == sort_by else None,
                all(row[name] is None or is_number(row[name]) for row in filled),
            )
            for name in names
        )
        self.blocks.append(Table(caption, columns, tuple(filled)))

    def image(self, image: NDArray[Any], caption: str, alt: str, kind: Literal["png", "jpeg"]) -> None:
        """Adds an image, shown at its own size or as wide as the page, whichever is smaller.

        Args:
            image: as :func:`preface.reports.pictures.as_picture` takes it.
            caption: shown below it.
            alt: what a reader who cannot see the image should know.
            kind: ``"png"`` for maps and drawings, ``"jpeg"`` for photographs.

        Raises:
            ValueError: not an image, or an empty ``alt``.
        """
        picture = as_picture(image)
        self._add_picture(
            caption, alt, kind, encode_picture(picture, kind), picture.shape[1], picture.shape[0]
        )

    def plot(self, figure: Figure, caption: str, alt: str, kind: Literal["svg", "png"]) -> None:
        """Adds a matplotlib figure, made by :func:`preface.reports.plots.new_figure`.

        Args:
            figure: the plot.
            caption: shown below it.
            alt: what a reader who cannot see the plot should know.
            kind: ``"svg"``, or ``"png"`` from some thousand marks on.

        Raises:
            ValueError: an empty ``alt``.
        """
        width, height = (round(inches * 96) for inches in figure.get_size_inches())  # CSS: 96 pixels per inch
        self._add_picture(caption, alt, kind, encode_figure(figure, kind), width, height)

    def video(self, content: bytes, size: tuple[int, int], caption: str, alt: str) -> None:
        """Adds a video that plays in the page.

        Args:
            content: of a WebM file.
            size: width and height to show it at, CSS pixels.
            caption: shown below it.
            alt: what a reader who cannot see the video should know.

        Raises:
            ValueError: not a WebM file, or an empty ``alt``.
        """
        if not content.startswith(_EBML):
            raise ValueError(f"video {caption!r} is not a WebM file")
        self.blocks.append(Video(caption, _required_alt("video", caption, alt), content, *size))

    def links(self, links: Sequence[Link]) -> None:
        """Adds a list of files near the page.

        Raises:
            ValueError: no links, or a path that is absolute or leads to the network.
        """
        for link in links:
            if link.path.startswith(("/", "\\")) or ":" in link.path.split("/")[0]:
                raise ValueError(f"link {link.text!r}: {link.path} is not a path from the page's folder")
        if not links:
            raise ValueError("links: there are none")
        self.blocks.append(Links(tuple(links)))

    def _add_picture(
        self,
        caption: str,
        alt: str,
        kind: Literal["png", "jpeg", "svg"],
        content: bytes,
        width: int,
        height: int,
    ) -> None:
        alt = _required_alt("picture", caption, alt)
        self.blocks.append(Picture(caption, alt, kind, content, width, height))


class Report:
    """A page under construction.

    Args:
        title: shown on top and in the browser's tab.
        provenance: where the numbers come from: configuration, versions, seed, hashes of the inputs; any
            nesting of mappings and sequences. The page leaves out what there is none of. Leave times of day
            out where the same input should give the same bytes.
    """

    def __init__(self, title: str, provenance: Mapping[str, Any]):
        self.title = title
        self.provenance: dict[str, Any] = json_tree(provenance)
        self.sections: list[Section] = []

    def section(self, heading: str, introduction: str = "") -> Section:
        """Adds a section, to be filled by its own methods."""
        section = Section(heading)
        section.text(introduction)
        self.sections.append(section)
        return section

    def twin(self) -> dict[str, Any]:
        """The report as the JSON artefact ``preface/report``."""
        sections = [{"heading": s.heading, "blocks": [b.twin() for b in s.blocks]} for s in self.sections]
        twin = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, "title": self.title}
        return json_tree({**twin, "provenance": self.provenance, "sections": sections})

    def html(self) -> str:
        """The page."""
        known = {name: item for name, item in self.provenance.items() if item not in (None, {}, [])}
        return _template().render(report=self, provenance=_flattened(known))

    def write(self, path: Path) -> Path:
        """Writes ``NAME.html`` and then ``NAME.json`` beside it, each atomically.

        Returns:
            The path of the page.

        Raises:
            ValueError: a path that does not end in ``.html``.
            ArtifactError: the disk refuses.
        """
        if path.suffix != ".html":
            raise ValueError(f"a report is written to a path that ends in .html, not {path}")
        write_bytes(path, encodable(self.html()).encode())
        write_artifact(path.with_suffix(".json"), self.twin())
        return path


def _required_alt(what: str, caption: str, alt: str) -> str:
    if not alt.strip():
        raise ValueError(f"{what} {caption!r} needs an alt text for readers who cannot see it")
    return alt


def _sorted_rows(rows: list[dict[str, Value]], name: str, descending: bool) -> list[dict[str, Value]]:
    """Rows by one column: numbers by size, words by alphabet, missing values last in either direction."""

    def is_missing(row: dict[str, Value]) -> bool:
        value = row[name]
        return value is None or (isinstance(value, float) and math.isnan(value))

    def order(row: dict[str, Value]) -> tuple[bool, Any]:
        value = row[name]
        return isinstance(value, str), value

    present = [row for row in rows if not is_missing(row)]
    return sorted(present, key=order, reverse=descending) + [row for row in rows if is_missing(row)]


def _flattened(tree: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Nested provenance as lines (``packages.torch``, ``2.13.0``); lists of plain values stay on one line."""
    if isinstance(tree, dict) and tree:
        return [
            line
            for key, item in tree.items()
            for line in _flattened(item, f"{prefix}.{key}" if prefix else key)
        ]
    if isinstance(tree, list) and any(isinstance(item, (dict, list)) for item in tree):
        return [line for i, item in enumerate(tree) for line in _flattened(item, f"{prefix}[{i}]")]
    if isinstance(tree, list):
        return [(prefix, ", ".join(shown(item) for item in tree) or shown(None))]
    return [(prefix, shown(None) if tree == {} else shown(tree))] if prefix else []


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("preface.reports", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["shown"] = shown
    environment.tests["number"] = is_number
    return environment.get_template("report.html.j2")
