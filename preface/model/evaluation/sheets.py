"""Pictures of evaluated views: truth, render, error, depth, normals and opacity, small enough to keep many.

Normals are shown in the canonical frame. Errors are the mean over channels of the absolute difference, on one scale for
every head. Depth runs from dark (near) to bright, about the depth of the canonical origin in that view, so that the
face has colours of its own. A legend below the sheet says what the colours mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from preface.model.evaluation.evaluate import EvaluatedView
from preface.model.evaluation.metrics_file import FIGURES
from preface.model.rendering.showing import (
    ERROR_SHOWN,
    SMALLEST,
    depth_entry,
    depth_picture,
    error_entry,
    error_picture,
    normals_entry,
    normals_picture,
    tile_size,
)
from preface.reports.pictures import Picture, as_picture, contact_sheet, with_legend

TALLEST = 480  # pixels of a tile's height; larger images are reduced
FACE_TALLEST, FACE_SMALLEST = 360, 240
FACES_ACROSS = 2  # views per row of a sheet of faces, three tiles each
DEPTH_SHOWN = 0.1  # metres before and behind the canonical origin that the colours of depth span


@dataclass(frozen=True, eq=False)
class ViewPictures:
    """What is kept of a view, pictures of one size [h, w, 3], and those of its face, of another.

    Attributes:
        name: of the camera.
        figures: by name.
        truth, rgb, error, depth, normals, alpha: of the frame; without normals where none were asked for.
        depths: metres in front of the camera that the darkest and the brightest colour of depth stand for.
        face_truth, face_rgb, face_error: None where no face is in the image.
    """

    name: str
    figures: dict[str, float]
    truth: Picture
    rgb: Picture
    error: Picture
    depth: Picture
    depths: tuple[float, float]
    normals: Picture | None
    alpha: Picture
    face_truth: Picture | None
    face_rgb: Picture | None
    face_error: Picture | None


def view_pictures(view: EvaluatedView) -> ViewPictures:
    """The pictures of a view, reduced by area averaging where it is larger than a tile."""
    error = error_picture(view.rgb, view.truth)
    square, frames = view.figures.face, (as_picture(view.truth), as_picture(view.rgb), error)
    faces = [None if square is None else _reduced(square.of(frame), FACE_TALLEST) for frame in frames]
    truth, rgb, error = (_reduced(frame, TALLEST) for frame in frames)
    middle = float(view.figures.canonical_from_camera.inverse.translation[2])  # depth of the origin
    depths = (middle - DEPTH_SHOWN, middle + DEPTH_SHOWN)
    return ViewPictures(
        name=view.figures.name,
        figures={name: view.figures.values[name] for name in FIGURES if name in view.figures.values},
        truth=truth,
        rgb=rgb,
        error=error,
        depth=_reduced(depth_picture(view.depth, *depths), TALLEST),
        depths=depths,
        normals=None if view.normals is None else _reduced(normals_picture(view.normals), TALLEST),
        alpha=_reduced(as_picture(view.alpha), TALLEST),
        face_truth=faces[0],
        face_rgb=faces[1],
        face_error=faces[2],
    )


def sheet(views: Sequence[ViewPictures]) -> Picture:
    """A row per view: truth, render, error, depth, normals where there are any, opacity; below, a legend."""
    tiles: list[tuple[Picture | None, str]] = []
    for view in views:
        tiles += [
            (view.truth, view.name),
            (view.rgb, f"{view.figures['psnr']:.2f} dB"),
            (view.error, f"error, 0 to {ERROR_SHOWN}"),
            (view.depth, f"depth, {view.depths[0]:.2f} to {view.depths[1]:.2f} m"),
            *([] if view.normals is None else [(view.normals, "normals")]),
            (view.alpha, "opacity"),
        ]
    there = f"{1000 * DEPTH_SHOWN:.0f} mm"
    entries = [depth_entry(f"{there} nearer than the middle of the face", f"{there} further"), error_entry()]
    entries += [normals_entry()] if any(view.normals is not None for view in views) else []
    drawn = contact_sheet(tiles, len(tiles) // len(views), _tile(views[0].truth))
    return with_legend(drawn, entries)


def face_sheet(views: Sequence[ViewPictures]) -> Picture | None:
    """Truth, render and error of each face, `FACES_ACROSS` views per row; None if no view has a face."""
    tiles: list[tuple[Picture | None, str]] = []
    for view in views:
        if view.face_truth is not None:
            tiles += [
                (view.face_truth, f"{view.name}, photograph"),
                (view.face_rgb, f"render, {view.figures['psnr_face']:.2f} dB"),
                (view.face_error, f"error, 0 to {ERROR_SHOWN}"),
            ]
    if not tiles:
        return None
    largest = max((tile for tile, _ in tiles if tile is not None), key=len)
    return contact_sheet(tiles, 3 * FACES_ACROSS, _tile(largest, FACE_SMALLEST))


def comparison_sheet(heads: Sequence[tuple[str, Sequence[ViewPictures]]]) -> Picture:
    """A row per view: the photograph, then render and error of each head.

    Args:
        heads: name and views of each, the same views for all.
    """
    tiles: list[tuple[Picture | None, str]] = []
    for number, view in enumerate(heads[0][1]):
        tiles.append((view.truth, view.name))
        for name, views in heads:
            other = views[number]
            tiles += [
                (other.rgb, f"{other.figures['psnr']:.2f} dB, {name}"),
                (other.error, f"error, 0 to {ERROR_SHOWN}"),
            ]
    return contact_sheet(tiles, 1 + 2 * len(heads), _tile(heads[0][1][0].truth))


def input_sheet(photographs: Sequence[tuple[np.ndarray, str]]) -> Picture:
    """The photographs that a head was fitted to, [H, W, 3] on black, with the names of their cameras."""
    tiles = [(_reduced(as_picture(truth), TALLEST), name) for truth, name in photographs]
    return contact_sheet(tiles, 7, _tile(tiles[0][0]))


def _reduced(picture: Picture, tallest: int) -> Picture:
    """The picture, at most so many pixels tall."""
    height, width = picture.shape[:2]
    if height <= tallest:
        return picture
    size = max(1, round(width * tallest / height)), tallest
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _tile(picture: Picture, smallest: int = SMALLEST) -> tuple[int, int]:
    height, width = picture.shape[:2]
    return tile_size(width, height, smallest)
