"""Do the masks of one person agree with one another? A visual hull at low resolution says which one does not.

A point belongs to the visual hull (Laurentini 1994) when no view that sees it says background. Whatever the masks of
the other views carve, a right mask must lie within its silhouette; and a mask that lacks a piece of the person
removes points that all others keep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from preface.geometry import GeometryError, Views, lens

GRID = 56  # points along the longest side of the box
EXCESS = (
    0.08  # share of a mask outside the hull of the others that flags it; shoulders beyond the box cost 0.05
)
LACKING = 0.15  # share of the hull that one mask alone removes that flags it,
LOOSE = (
    1.5  # over the number of views: the least share where few views carve, and a right mask still cuts deep
)
TIMES = 6.0  # when it is also this many times the other views' median: views from far aside always cut deep
LEAST_VIEWS = 3  # with fewer there is nothing to compare with


@dataclass(frozen=True, eq=False)
class HullCheck:
    """How the masks of the views of one person agree; float64 [v], NaN where nothing can be said.

    Attributes:
        disagreement: the larger of the next two.
        excess: share of the mask, within the box's outline, that lies outside the hull of the other trusted views.
        lacking: share of what the other trusted views keep that this mask alone removes.
        flagged: bool [v], views whose mask contradicts the others.
    """

    disagreement: np.ndarray
    excess: np.ndarray
    lacking: np.ndarray
    flagged: np.ndarray


def hull_disagreement(alphas: Sequence[np.ndarray | None], views: Views, box: np.ndarray) -> HullCheck:
    """Compare every mask with the hull that the others carve.

    Views are taken out of the carving one at a time, the one that contradicts the rest most first, until none does: a
    single bad mask would otherwise make all good ones look bad.

    Args:
        alphas: per view the coverage [h, w] (floats in [0, 1] or uint8), at the size of the view's camera; None
            for a view without image. Small ones do: reduce cameras and masks alike.
        views: the cameras, stacked, in the frame of the box.
        box: float64 [2, 3], corners of the box around the head, metres.

    Returns:
        One figure per view. With fewer than three masks all are NaN and none is flagged.

    Raises:
        GeometryError: another number of masks than views, or an empty box.
    """
    count = len(views.intrinsics)
    corners = np.asarray(box, np.float64)
    if len(alphas) != count:
        raise GeometryError(
            f"alphas: {len(alphas)} masks for {count} views; give None where there is no image"
        )
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
        raise GeometryError("box: it must be [2, 3] with each maximum above its minimum")
    excess, lacking = np.full(count, np.nan), np.full(count, np.nan)
    flagged = np.zeros(count, bool)
    present = [index for index, alpha in enumerate(alphas) if alpha is not None and alpha.size]
    if len(present) < LEAST_VIEWS:
        return HullCheck(excess.copy(), excess, lacking, flagged)
    points, step = _grid(corners)
    seen = {index: _see(alphas[index], views, index, points, step) for index in present}
    trusted = list(present)
    while True:
        cut = _alone_removed(seen, trusted)
        worst = max(trusted, key=lambda index: cut[index])
        others = [cut[index] for index in trusted if index != worst]
        least = max(LACKING, LOOSE / len(trusted), TIMES * float(np.median(others)))
        if len(trusted) < LEAST_VIEWS or cut[worst] <= least:
            break
        lacking[worst], flagged[worst] = cut[worst], True
        trusted.remove(worst)
    for index in trusted:
        lacking[index] = cut[index]
    for index in present:
        against = [other for other in trusted if other != index]
        excess[index] = _outside(seen[index], _hull(seen, against))
    flagged |= np.fmax(excess, 0) > EXCESS
    return HullCheck(np.fmax(excess, lacking), excess, lacking, flagged)


@dataclass(frozen=True, eq=False)
class _Seen:
    """What one view says about the points: where they lie in its reduced image, and whether that is background.

    `cell` is -1 for points that the view does not see; `mask` is the reduced mask.
    """

    cell: np.ndarray
    background: np.ndarray
    mask: np.ndarray


def _grid(corners: np.ndarray) -> tuple[np.ndarray, float]:
    """Points [n, 3] all over the box, and their distance."""
    centre, sides = corners.mean(axis=0), corners[1] - corners[0]
    step = float(sides.max()) / GRID
    counts = np.maximum(np.round(sides / step), 1)
    axes = [c + (np.arange(n) - (n - 1) / 2) * step for c, n in zip(centre, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), step


def _see(alpha: np.ndarray | None, views: Views, index: int, points: np.ndarray, step: float) -> _Seen:
    """Project the points into a view whose image is reduced to about one cell per point."""
    assert alpha is not None
    pose = views.world_from_camera[index]
    in_camera = (points - pose[:, 3]) @ pose[:, :3]
    pixels, valid = lens.project(views.intrinsics[index], views.monotonic_radius[index], in_camera)
    height, width = alpha.shape
    pixels = np.where(valid[:, None], pixels, -1.0)
    inside = valid & (pixels >= 0).all(axis=-1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    depth = float(np.median(in_camera[:, 2]))
    size = max(1.0, float(views.intrinsics[index][0]) * step / max(depth, 1e-9))  # pixels per point
    shape = (max(1, round(height / size)), max(1, round(width / size)))
    scale = 255.0 if alpha.dtype == np.uint8 else 1.0
    mask = cv2.resize(alpha.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA) / scale
    column = np.minimum((pixels[:, 0] * shape[1] / width).astype(np.int64), shape[1] - 1)
    row = np.minimum((pixels[:, 1] * shape[0] / height).astype(np.int64), shape[0] - 1)
    cell = np.where(inside, row * shape[1] + column, -1)
    # A cell that is background to its half is not enough: the hull must not lose what is there.
    background = inside & (cv2.dilate(mask, np.ones((3, 3), np.uint8)).ravel()[cell] < 0.5)
    return _Seen(cell, background, mask)


def _hull(seen: dict[int, _Seen], trusted: list[int]) -> np.ndarray:
    """The points that no trusted view calls background, and that at least one sees."""
    looked = np.any([seen[index].cell >= 0 for index in trusted], axis=0)
    return looked & ~np.any([seen[index].background for index in trusted], axis=0)


def _alone_removed(seen: dict[int, _Seen], trusted: list[int]) -> dict[int, float]:
    """Per view, the share of what the other views keep and it sees that it alone calls background."""
    calls = np.sum([seen[index].background for index in trusted], axis=0)
    share = {}
    for index in trusted:
        one = seen[index]
        kept = (calls - one.background == 0) & (one.cell >= 0)
        share[index] = float((kept & one.background).sum()) / max(int(kept.sum()), 1)
    return share


def _outside(one: _Seen, hull: np.ndarray) -> float:
    """The share of a mask, within the box's outline, that the silhouette of a hull does not cover."""
    outline, silhouette = (_drawn(one, points) for points in (np.ones_like(hull), hull))
    mask = (one.mask >= 0.5) & outline
    return float((mask & ~silhouette).sum()) / mask.sum() if mask.any() else 0.0


def _drawn(one: _Seen, points: np.ndarray) -> np.ndarray:
    """Where points appear in a view's reduced image, without gaps between neighbours: bool [h, w]."""
    image = np.zeros(one.mask.size, np.uint8)
    image[one.cell[points & (one.cell >= 0)]] = 1
    return cv2.dilate(image.reshape(one.mask.shape), np.ones((3, 3), np.uint8)) > 0
