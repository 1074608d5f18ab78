"""The pictures on the demo's page: what is compared stands side by side, a row per view, a column per head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bench.head_truth_pictures import legend_entries
from demo_page.heads import Head
from preface.artifacts import ArtifactError
from preface.capture.images import read_image
from preface.cli.render_frames import LEGEND_FILE
from preface.model.rendering.showing import error_entry, tile_size
from preface.reports import contact_sheet, with_legend
from preface.reports.pictures import Picture, as_picture, stacked
from preface.shards import Dataset

INPUT_HEIGHT = 288
STRIP = 6  # frames of an orbit that are shown beside its video

Tile = tuple[Picture | None, str]


def inputs_sheet(head: Head) -> tuple[Picture, tuple[int, int]]:
    """The photographs that a head was fitted to, on black by their masks, and their width and height in pixels."""
    with Dataset(head.demo / f"shards{head.suffix}") as dataset:
        person = dataset.names.index(head.fit["identity"])
        cameras = dataset.manifest.identities[person].cameras
        tiles: list[Tile] = []
        for name in head.fit["views"]:
            pixels = dataset.pixels(person, cameras.index(name)).astype(np.float32) / 255
            tiles.append((as_picture(pixels[..., :3] * pixels[..., 3:]), name))
        size = dataset.manifest.width, dataset.manifest.height
    return contact_sheet(tiles, len(tiles), (round(INPUT_HEIGHT * size[0] / size[1]), INPUT_HEIGHT)), size


def views_sheet(heads: Sequence[Head], views: Sequence[str]) -> Picture:
    """A row per view: the photograph, the render of each head with its PSNR of the face, the error of each."""
    measured = [{view["name"]: view for view in head.metrics["views"]} for head in heads]
    folders = [head.evaluation for head in heads]
    rows = []
    for view in views:
        degrees = measured[0][view]["degrees_from_fitted"]
        truth = _read(folders[0] / f"{view}.truth.png"), f"{view}, {degrees:.0f}° away"
        figures = [_figure(of[view], "psnr_face", " dB") for of in measured]
        rows.append(_row(truth, heads, folders, (f"{view}.png", f"{view}.error.png"), figures))
    return with_legend(_sheet(rows), [error_entry()])


def geometry_sheet(heads: Sequence[Head], kind: str) -> Picture:
    """A row per view: true depth or normals, those of each head with the median error, the error of each.

    Args:
        heads: all with `geometry`.
        kind: `depth` or `normals`.
    """
    figure, unit = {"depth": ("depth_median_mm", " mm"), "normals": ("density_normals_median_deg", "°")}[kind]
    measured = [head.geometry["views"] if head.geometry else {} for head in heads]
    folders = [head.pictures_of_geometry for head in heads]
    rows = []
    for view in measured[0]:
        truth = _read(folders[0] / f"{view}.{kind}.true.png"), f"{view}, the truth"
        figures = [_figure(of[view], figure, unit) for of in measured]
        rows.append(_row(truth, heads, folders, (f"{view}.{kind}.png", f"{view}.{kind}.error.png"), figures))
    return with_legend(_sheet(rows), legend_entries(kind))


def orbit_frames(folder: Path) -> list[str]:
    """Names of an orbit's frames.

    Raises:
        ArtifactError: there are none.
    """
    frames = sorted(file.stem for file in folder.glob("????.png"))
    if not frames:
        raise ArtifactError(folder, "frames", "there are none", "Run tools/demo.sh")
    return frames


def orbit_sheet(folder: Path) -> Picture:
    """Some frames of an orbit: colours, depths, normals, and a legend."""
    frames = orbit_frames(folder)
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, min(STRIP, len(frames))).round().astype(int)]
    tiles = [
        (_read(folder / f"{frame}{kind}.png"), f"{frame}{kind}")
        for kind in ("", ".depth", ".normals")
        for frame in chosen
    ]
    return stacked(_sheet_of(tiles, len(chosen)), read_image(folder / LEGEND_FILE))


def _row(
    truth: Tile,
    heads: Sequence[Head],
    folders: Sequence[Path],
    files: tuple[str, str],
    figures: Sequence[str],
) -> list[Tile]:
    """A truth, what each head shows in its place with a figure, and the errors."""
    tiles = [truth]
    for head, folder, figure in zip(heads, folders, figures, strict=True):
        tiles.append((_read(folder / files[0]), f"{head.start}: {figure}"))
    return tiles + [
        (_read(folder / files[1]), f"error, {head.start}")
        for head, folder in zip(heads, folders, strict=True)
    ]


def _figure(values: Mapping[str, float], name: str, unit: str) -> str:
    return f"{values[name]:.1f}{unit}" if name in values else "not measured"


def _sheet(rows: Sequence[Sequence[Tile]]) -> Picture:
    return _sheet_of([tile for row in rows for tile in row], len(rows[0]))


def _sheet_of(tiles: Sequence[Tile], columns: int) -> Picture:
    height, width = tiles[0][0].shape[:2] if tiles[0][0] is not None else (1, 1)
    return contact_sheet(list(tiles), columns, tile_size(width, height))


def _read(path: Path) -> Picture:
    return as_picture(read_image(path))
