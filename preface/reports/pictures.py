"""Arrays to pictures: contact sheets, heat maps with a colour bar, and overlays.

Pictures are uint8 ``[H, W, 3]``, sRGB-encoded. Every function returns a new array. Pixel coordinates are
continuous, with the centre of the top-left pixel at (0.5, 0.5).
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Picture = NDArray[np.uint8]
Color = tuple[int, int, int]
LegendEntry = tuple[str, Picture, str]  # a sample of colours between the words before and after it

SHEET_BACKGROUND: Color = (32, 33, 36)
TILE_BACKGROUND: Color = (18, 18, 20)
CAPTION_COLOR: Color = (232, 234, 237)
MISSING_COLOR: Color = (95, 99, 104)
GREEN: Color = (80, 230, 120)
CHECKER = (108, 148)  # two greys that are told apart from the ends of every colour map used here
CHECKER_CELL = 8
GAP = 6  # pixels between tiles
CAPTION_LINES = 2
SMALLEST_FONT = 11  # pixels; below this, digits are no longer told apart


def as_picture(image: NDArray[Any]) -> Picture:
    """An image of any usual kind as sRGB bytes ``[H, W, 3]``.

    Args:
        image: ``[H, W]``, ``[H, W, 1]``, ``[H, W, 3]`` or ``[H, W, 4]`` (straight alpha, shown on a checker
            board); bool, uint8, uint16, or floats that are sRGB-encoded in [0, 1] and clipped to it.

    Raises:
        ValueError: another shape or type, no pixels, or a non-finite float (:func:`colorize` shows those).
    """
    pixels = np.asarray(image)
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or pixels.size == 0:
        raise ValueError(
            f"an image must be [H, W], [H, W, 1], [H, W, 3] or [H, W, 4] with pixels, not {image.shape}"
        )
    pixels = _as_bytes(pixels)
    if pixels.shape[2] == 4:
        alpha = pixels[:, :, 3:] / 255.0
        mixed = pixels[:, :, :3] * alpha + _checker(*pixels.shape[:2])[:, :, None] * (1 - alpha)
        return np.rint(mixed).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)))


def contact_sheet(
    tiles: Sequence[tuple[NDArray[Any] | None, str]], columns: int, tile_size: tuple[int, int]
) -> Picture:
    """Tiles in reading order on one sheet, each letterboxed into the same size with its caption below.

    Images are reduced by area averaging and enlarged by repeating pixels, so that no detail is invented.
    A caption that is too wide, or has a line break, goes on below itself, and is shortened with an ellipsis beyond
    `CAPTION_LINES`. Sheets without captions spend no room on them.

    Args:
        tiles: (image, caption) pairs; images as :func:`as_picture` takes them, ``None`` for a missing one.
        columns: tiles per row.
        tile_size: (width, height) of each tile in pixels, without its caption.

    Raises:
        ValueError: no tiles, or columns or a tile size below one.
    """
    width, height = tile_size
    if not tiles or columns < 1 or width < 1 or height < 1:
        raise ValueError(
            f"a contact sheet needs at least 1 tile, 1 column and a tile of 1 x 1 pixels, "
            f"not {len(tiles)}, {columns} and {width} x {height}"
        )
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    font = _font(max(SMALLEST_FONT, min(18, width // 14)))
    captions = [_wrapped(caption, font, width) for _, caption in tiles]
    caption_height = _line_height(font) * max(map(len, captions))
    pitch_x, pitch_y = width + GAP, height + caption_height + GAP

    sheet = Image.new("RGB", (columns * pitch_x + GAP, rows * pitch_y + GAP), SHEET_BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for index, ((image, _), lines) in enumerate(zip(tiles, captions, strict=True)):
        left, top = GAP + index % columns * pitch_x, GAP + index // columns * pitch_y
        sheet.paste(_tile(image, width, height), (left, top))
        for line, text in enumerate(lines):
            middle = left + width / 2, top + height + line * _line_height(font)
            draw.text(middle, text, CAPTION_COLOR, font, anchor="ma")
    return np.array(sheet)


def with_legend(sheet: Picture, entries: Sequence[LegendEntry]) -> Picture:
    """A sheet with what its colours mean below it, as :func:`legend` draws it."""
    return stacked(sheet, legend(entries, sheet.shape[1]))


def stacked(above: Picture, below: Picture) -> Picture:
    """One picture above another; the narrower one has background to its right."""
    width = max(above.shape[1], below.shape[1])
    return np.concatenate([_widened(above, width), _widened(below, width)])


def legend(entries: Sequence[LegendEntry], width: int) -> Picture:
    """Samples of colours with their words, side by side on as few rows as ``width`` pixels allow.

    An entry that is wider than that has a row for itself, and the legend is as wide as this needs.
    """
    font = _font(max(SMALLEST_FONT, min(18, width // 70)))
    drawn = [_legend_entry(entry, font) for entry in entries]
    rows: list[list[Picture]] = []
    for picture in drawn:
        used = sum(other.shape[1] for other in rows[-1]) if rows else 0
        if rows and used + picture.shape[1] <= width:
            rows[-1].append(picture)
        else:
            rows.append([picture])
    across = max(width, *(sum(picture.shape[1] for picture in row) for row in rows))
    lines = []
    for row in rows:
        height = max(picture.shape[0] for picture in row)
        lines.append(_widened(np.concatenate([_heightened(p, height) for p in row], axis=1), across))
    return np.concatenate(lines)


def gradient(colormap: str, width: int, height: int) -> Picture:
    """All colours of a matplotlib map, the lowest at the left."""
    return colorize(np.linspace(0, 1, width)[None].repeat(height, 0), 0, 1, colormap)


def colorize(values: NDArray[Any], low: float, high: float, colormap: str) -> Picture:
    """Scalars as colours; what is not a number becomes a grey checker board, never a colour of the map.

    Args:
        values: ``[H, W]``, any real type.
        low, high: the values at the two ends of the map; values outside take the colour of the nearer end.
        colormap: a matplotlib name, such as ``"viridis"`` or ``"inferno"``.

    Raises:
        ValueError: values that are not ``[H, W]``, ``low`` not below ``high``, or an unknown map.
    """
    field = np.asarray(values, dtype=np.float64)
    if field.ndim != 2 or field.size == 0:
        raise ValueError(f"a map of scalars must be [H, W] with pixels, not {field.shape}")
    if not (np.isfinite([low, high]).all() and low < high):
        raise ValueError(f"the range of a colour map must be finite and increasing, not {low} to {high}")
    known = ~np.isnan(field)
    share = np.clip((np.where(known, field, low) - low) / (high - low), 0, 1)
    colours = matplotlib.colormaps[colormap](share, bytes=True)[:, :, :3]
    return np.where(known[:, :, None], colours, _checker(*field.shape)[:, :, None]).astype(np.uint8)


def heat_map(values: NDArray[Any], low: float, high: float, colormap: str, unit: str) -> Picture:
    """:func:`colorize` with a labelled colour bar at the right: ``[H', W', 3]``, not smaller than the input.

    The bar names both ends and the middle with the unit. Small fields are enlarged by whole factors until
    the labels fit.
    """
    picture = colorize(values, low, high, colormap)
    factor = max(1, -(-96 // picture.shape[0]))
    picture = np.repeat(np.repeat(picture, factor, 0), factor, 1)
    height = picture.shape[0]
    font = _font(max(SMALLEST_FONT, min(28, height // 26)))
    line = _line_height(font)
    ticks = [(low, height - line), ((low + high) / 2, (height - line) // 2), (high, 0)]
    labels = [(f"{value:.3g} {unit}".strip(), top) for value, top in ticks]
    label_width = max(int(np.ceil(font.getlength(text))) for text, _ in labels)

    gradient = np.linspace(high, low, height)[:, None].repeat(line, 1)
    bar = colorize(gradient, low, high, colormap)
    canvas = Image.new(
        "RGB", (picture.shape[1] + 2 * GAP + line + label_width + GAP, height), SHEET_BACKGROUND
    )
    canvas.paste(Image.fromarray(picture), (0, 0))
    canvas.paste(Image.fromarray(bar), (picture.shape[1] + GAP, 0))
    draw = ImageDraw.Draw(canvas)
    for text, top in labels:
        draw.text((picture.shape[1] + 2 * GAP + line, top), text, CAPTION_COLOR, font)
    return np.array(canvas)


def finite_range(values: NDArray[Any], low_percentile: float, high_percentile: float) -> tuple[float, float]:
    """An increasing range between two percentiles (0 to 100) of the finite values, for a colour map.

    Equal ends are set apart by one; without any finite value the range is 0 to 1.
    """
    field = np.asarray(values, dtype=np.float64)
    finite = field[np.isfinite(field)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(finite, [low_percentile, high_percentile]))
    return (low, high) if low < high else (low - 0.5, low + 0.5)


def overlay_points(
    image: NDArray[Any], points: NDArray[Any], labels: Sequence[str] | None, radius: float, color: Color
) -> Picture:
    """Circles with a dark rim around points, and their labels above them (below at the upper edge).

    Args:
        image: as :func:`as_picture` takes it.
        points: ``[N, 2]`` pixel coordinates (x, y); NaN and points outside the image are left out.
        labels: N words, or None.
        radius: of the circle, in pixels.
        color: sRGB bytes.

    Raises:
        ValueError: points that are not ``[N, 2]``, or another number of labels than points.
    """
    picture = as_picture(image).copy()
    places = np.asarray(points, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 2:
        raise ValueError(f"points must be [N, 2], not {places.shape}")
    if labels is not None and len(labels) != len(places):
        raise ValueError(f"{len(labels)} labels for {len(places)} points")
    size = np.array(picture.shape[1::-1])
    inside = ((places >= 0) & (places <= size)).all(-1)  # false for NaN
    for x, y in places[inside]:
        _circle(picture, x, y, radius, (0, 0, 0), max(2, round(radius * 0.9)))
        _circle(picture, x, y, radius, color, max(1, round(radius * 0.45)))
    if labels is None:
        return picture
    font = _font(max(SMALLEST_FONT, round(radius * 3)))
    canvas = Image.fromarray(picture)
    draw = ImageDraw.Draw(canvas)
    for (x, y), label in zip(places[inside], np.array(labels, dtype=object)[inside], strict=True):
        half = min(font.getlength(label) / 2 + 2, picture.shape[1] / 2)
        centre = min(max(x, half), picture.shape[1] - half)  # keeps the whole word inside
        above = y - 2 * radius >= _line_height(font)
        place, anchor = ((centre, y - 2 * radius), "mb") if above else ((centre, y + 2 * radius), "mt")
        draw.text(place, label, color, font, anchor=anchor, stroke_width=2, stroke_fill=(0, 0, 0))
    return np.array(canvas)


def overlay_mask_edges(image: NDArray[Any], mask: NDArray[Any], thickness: int, color: Color) -> Picture:
    """Draws the line where a mask crosses one half, inside the masked region.

    Args:
        image: ``[H, W, ...]`` as :func:`as_picture` takes it.
        mask: ``[H, W]``, bool or coverage in [0, 1].
        thickness: of the line, in pixels.
        color: sRGB bytes.

    Raises:
        ValueError: a mask of another size than the image.
    """
    picture = as_picture(image).copy()
    if mask.shape != picture.shape[:2]:
        raise ValueError(
            f"the mask is {mask.shape}, the image {picture.shape[:2]}: they must have the same size"
        )
    inside = (np.asarray(mask, dtype=np.float64) >= 0.5).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    core = cv2.erode(inside, kernel, iterations=thickness, borderType=cv2.BORDER_REPLICATE)
    picture[inside != core] = color
    return picture


def _as_bytes(pixels: NDArray[Any]) -> Picture:
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.bool_:
        return pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype == np.uint16:
        return np.rint(pixels / 257.0).astype(np.uint8)
    if np.issubdtype(pixels.dtype, np.floating):
        if not np.isfinite(pixels).all():
            raise ValueError("a float image must be finite; use colorize() for values with gaps")
        return np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)
    raise ValueError(f"an image must be bool, uint8, uint16 or float, not {pixels.dtype}")


def _checker(height: int, width: int) -> Picture:
    y, x = np.mgrid[:height, :width] // CHECKER_CELL
    return np.where((x + y) % 2 == 0, *CHECKER).astype(np.uint8)


def _tile(image: NDArray[Any] | None, width: int, height: int) -> Image.Image:
    """One image letterboxed into a tile, or a crossed-out tile for a missing one."""
    tile = Image.new("RGB", (width, height), TILE_BACKGROUND)
    if image is None:
        draw = ImageDraw.Draw(tile)
        draw.line((0, 0, width, height), MISSING_COLOR, 1)
        draw.line((0, height, width, 0), MISSING_COLOR, 1)
        return tile
    picture = as_picture(image)
    rows, cols = picture.shape[:2]
    scale = min(width / cols, height / rows)
    size = max(1, round(cols * scale)), max(1, round(rows * scale))
    resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    tile.paste(Image.fromarray(resized), ((width - size[0]) // 2, (height - size[1]) // 2))
    return tile


def _circle(picture: Picture, x: float, y: float, radius: float, color: Color, thickness: int) -> None:
    """An anti-aliased circle at sub-pixel places; OpenCV counts from pixel centres and in 1/16 pixel."""
    centre = round((x - 0.5) * 16), round((y - 0.5) * 16)
    cv2.circle(picture, centre, round(radius * 16), color, thickness, cv2.LINE_AA, shift=4)


def _legend_entry(entry: LegendEntry, font: ImageFont.FreeTypeFont) -> Picture:
    before, sample, after = entry
    widths = [int(np.ceil(font.getlength(words))) for words in (before, after)]
    height = max(sample.shape[0], _line_height(font)) + 2 * GAP
    left = GAP + (widths[0] + GAP if before else 0)
    drawn = Image.new("RGB", (left + sample.shape[1] + GAP + widths[1] + 3 * GAP, height), SHEET_BACKGROUND)
    drawn.paste(Image.fromarray(sample), (left, (height - sample.shape[0]) // 2))
    draw = ImageDraw.Draw(drawn)
    draw.text((GAP, height / 2), before, CAPTION_COLOR, font, anchor="lm")
    draw.text((left + sample.shape[1] + GAP, height / 2), after, CAPTION_COLOR, font, anchor="lm")
    return np.array(drawn)


def _widened(picture: Picture, width: int) -> Picture:
    """With background to the right."""
    return _padded(picture, 0, width - picture.shape[1])


def _heightened(picture: Picture, height: int) -> Picture:
    """With background above and below."""
    return _padded(picture, height - picture.shape[0], 0)


def _padded(picture: Picture, rows: int, columns: int) -> Picture:
    height, width = picture.shape[:2]
    canvas = np.empty((height + rows, width + columns, 3), np.uint8)
    canvas[:] = SHEET_BACKGROUND
    canvas[rows // 2 : rows // 2 + height, :width] = picture
    return canvas


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib brings: the same on every machine, with Greek, Cyrillic and symbols."""
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)


def _line_height(font: ImageFont.FreeTypeFont) -> int:
    return sum(font.getmetrics()) + 2


def _wrapped(text: str, font: ImageFont.FreeTypeFont, width: int) -> list[str]:
    """The text's lines, at most `CAPTION_LINES`, each shortened where it would be wider than ``width`` pixels."""
    lines: list[str] = []
    for part in text.splitlines():
        for index, word in enumerate(part.split()):
            longer = f"{lines[-1]} {word}" if lines else word
            if lines and (len(lines) == CAPTION_LINES or (index and font.getlength(longer) <= width)):
                lines[-1] = longer
            else:
                lines.append(word)
    return [_shortened(line, font, width) for line in lines]


def _shortened(line: str, font: ImageFont.FreeTypeFont, width: int) -> str:
    """The line, cut with an ellipsis where it would be wider than ``width`` pixels."""
    if font.getlength(line) <= width:
        return line
    while line and font.getlength(line + "…") > width:
        line = line[:-1]
    return line.rstrip() + "…"
