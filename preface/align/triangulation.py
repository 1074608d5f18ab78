"""Triangulation: points from what any number of calibrated views see of them, robust, with covariance.

Each point is the maximum-likelihood one of the views that agree on it. All views are tried first: a linear (DLT)
solution and Gauss-Newton steps. Where a view is then further off than the threshold, the point goes through
pair consensus: hypotheses from two views each, the one of least truncated cost (MSAC, Torr and Zisserman 2000)
says which views agree, and these are solved again. What cannot be determined is NaN with a `Reason`.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from enum import IntEnum
from itertools import combinations
from typing import NamedTuple

import numpy as np

from preface.align.options import TriangulationOptions
from preface.align.sightings import (
    Frame,
    Sightings,
    Symmetric,
    inverse,
    linear_points,
    linearise,
    normal_of_each,
    residuals,
    sight,
    solve,
)
from preface.geometry import GeometryError, Views

CHUNK = 1024  # points at a time: what they need stays within a core's second-level cache
ITERATIONS = 20  # of Gauss-Newton; two are usual, more where rays are almost parallel
CONVERGED = 1e-6  # squared step in standard deviations; what is left after it is of the order of its square
SLACK = 2.0  # factor on the threshold while a point is still that of two views, or not yet converged
RECLASSIFY = 4  # rounds of solving and deciding again which views agree; the second rarely changes anything
# Consensus in two rounds: all pairs of this many views of a point, drawn at random, and the share of its views
# that must agree to end the search. What 60% agree on cannot be outvoted, and 5 views hold a good pair in all but
# 1 of 33,000 points with 5% outliers, in all but 1 of 5 with 50%; 45 views hold one always.
QUICK_VIEWS, QUICK_SHARE = 5, 0.6
THOROUGH_VIEWS = 45
HYPOTHESES = 1 << 17  # residuals held at a time


class Reason(IntEnum):
    """Why a point is not triangulated."""

    OK = 0
    TOO_FEW_VIEWS = 1
    BEHIND = 2
    SMALL_ANGLE = 3
    NO_CONSENSUS = 4
    UNDETERMINED = 5

    @property
    def words(self) -> str:
        """The reason as part of a sentence."""
        return {
            Reason.OK: "",
            Reason.TOO_FEW_VIEWS: "seen by fewer than two views",
            Reason.BEHIND: "lies behind cameras that see it",
            Reason.SMALL_ANGLE: "its rays are almost parallel",
            Reason.NO_CONSENSUS: "too few views agree on it",
            Reason.UNDETERMINED: "the solution does not converge to a finite point",
        }[self]


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Points of any leading shape [..., P], from V views.

    Attributes:
        points: float64 [..., P, 3], world frame of the views; NaN where not triangulated.
        covariance: float64 [..., P, 3, 3], from the standard deviations given; NaN where not triangulated.
        inliers: bool [..., P, V], the views that the point rests on.
        residuals: float64 [..., P, V], distance in pixels between projection and measurement, to first order in
            the lens at the measured pixel; also of outliers. NaN where not seen or not triangulated.
        angle: float64 [..., P], the largest angle between two rays of inliers, radians; NaN as above.
        reason: int8 [..., P], values of `Reason`.
    """

    points: np.ndarray
    covariance: np.ndarray
    inliers: np.ndarray
    residuals: np.ndarray
    angle: np.ndarray
    reason: np.ndarray

    @property
    def ok(self) -> np.ndarray:
        """Which points are triangulated, bool [..., P]."""
        return self.reason == Reason.OK


def triangulate(
    views: Views,
    pixels: np.ndarray,
    sigmas: np.ndarray | float,
    options: TriangulationOptions = TriangulationOptions(),  # noqa: B008  (frozen)
) -> Triangulation:
    """Triangulate points that V views see.

    Args:
        views: the V cameras with their poses, arrays [V, ...]; their world is the frame of the points.
        pixels: [..., P, V, 2], the centre of the top-left pixel at (0.5, 0.5); NaN where not seen. Pixels beyond
            the monotonic radius of the lens count as not seen.
        sigmas: standard deviation of each coordinate in pixels, broadcasts against [..., P, V]; positive
            wherever there is a pixel.
        options: thresholds.

    Raises:
        GeometryError: shapes that do not fit, or a standard deviation that is not positive.
    """
    pixels, sigmas = _checked(views, pixels, sigmas)
    lead, count = pixels.shape[:-2], pixels.shape[-2]
    total = math.prod(lead)
    flat, flat_sigmas = pixels.reshape(total, count, 2), sigmas.reshape(total, count)
    views = views.map(lambda array: np.asarray(array, dtype=np.float64))
    frame = Frame.about(views.world_from_camera[:, :, 3])

    def part(start: int) -> Triangulation:
        chunk = slice(start, start + CHUNK)
        return _triangulate(views, frame, flat[chunk], flat_sigmas[chunk], options)

    starts = range(0, max(len(flat), 1), CHUNK)
    workers = min(len(starts), len(os.sched_getaffinity(0)))
    if workers > 1:
        with ThreadPoolExecutor(workers) as pool:
            parts = list(pool.map(part, starts))
    else:
        parts = [part(start) for start in starts]
    joined = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Triangulation)}
    return Triangulation(**{name: array.reshape(*lead, *array.shape[1:]) for name, array in joined.items()})


def _checked(views: Views, pixels: np.ndarray, sigmas: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    pixels = np.asarray(pixels, dtype=np.float64)
    count = len(views.intrinsics)
    if pixels.ndim < 2 or pixels.shape[-2:] != (count, 2):
        raise GeometryError(
            f"pixels: the shape {pixels.shape} does not end in ({count}, 2) for {count} views"
        )
    try:
        sigmas = np.broadcast_to(np.asarray(sigmas, dtype=np.float64), pixels.shape[:-1])
    except ValueError as error:
        problem = f"sigmas: the shape {np.shape(sigmas)} does not broadcast to {pixels.shape[:-1]}"
        raise GeometryError(f"{problem}; give one per pixel") from error
    wrong = np.isfinite(pixels).all(-1) & ~(np.isfinite(sigmas) & (sigmas > 0))
    if wrong.any():
        where = np.argwhere(wrong)[0].tolist()
        raise GeometryError(
            f"sigmas{where}: {sigmas[tuple(where)]} is not a positive number of pixels; where there is no "
            "measurement, set the pixel to NaN"
        )
    return pixels, sigmas


class _Solution(NamedTuple):
    """P points in the local frame.

    Attributes:
        points: [3, P].
        normal: [6, P], the entries of `Symmetric` at the points.
        inliers: [V, P].
        squared: [V, P], squared whitened residuals; infinite where the point is behind the view.
        settled: [P], whether inliers and point fit each other. Elsewhere nothing else has a meaning.
    """

    points: np.ndarray
    normal: np.ndarray
    inliers: np.ndarray
    squared: np.ndarray
    settled: np.ndarray

    @staticmethod
    def none(views: int, points: int) -> _Solution:
        """Nothing solved yet."""
        return _Solution(
            np.full((3, points), np.nan),
            np.full((6, points), np.nan),
            np.zeros((views, points), dtype=bool),
            np.full((views, points), np.nan),
            np.zeros(points, dtype=bool),
        )

    def put(self, index: np.ndarray, other: _Solution, which: np.ndarray | slice) -> None:
        """Store some points of another solution at an index into this one."""
        for mine, theirs in zip(self, other, strict=True):
            mine[..., index] = theirs[..., which]


@np.errstate(all="ignore")  # points that cannot be solved are NaN on the way, and are found by that
def _triangulate(
    views: Views, frame: Frame, pixels: np.ndarray, sigmas: np.ndarray, options: TriangulationOptions
) -> Triangulation:
    """Triangulate P points from pixels [P, V, 2] and standard deviations [P, V]."""
    sightings, seen = sight(views, frame, np.moveaxis(pixels, 1, 0), sigmas.T)
    count = seen.sum(0)
    start = _step(sightings, linear_points(sightings))
    squared, depth = residuals(sightings, start)
    near = squared <= (SLACK * options.outlier_threshold) ** 2
    easy = near.all(0) & (depth > 0).all(0) & (count >= 2)
    solution = _Solution.none(*seen.shape)
    index = np.flatnonzero(easy)
    here = sightings.of(index)
    solution.put(index, _agree(here, seen[:, index], seen[:, index], start[:, index], options), slice(None))
    index = np.flatnonzero(~easy & (count >= 3))
    if len(index):
        solution.put(index, _consensus(sightings.of(index), seen[:, index], options), slice(None))

    covariance = inverse(Symmetric(*solution.normal)) * frame.unit**2
    angle = _widest(_towards_cameras(views, frame, solution.points), solution.inliers)
    failed = np.flatnonzero(~solution.settled)
    parallel = np.zeros(len(count), dtype=bool)
    too_small = np.radians(options.minimum_angle_degrees)
    parallel[failed] = _widest(_rays(sightings.of(failed)), seen[:, failed]) < too_small
    behind = near.all(0) & (depth <= 0).any(0)
    failures = (
        (count < 2, Reason.TOO_FEW_VIEWS),
        (parallel, Reason.SMALL_ANGLE),
        (behind & ~solution.settled, Reason.BEHIND),
        (~solution.settled & np.isfinite(start).all(0), Reason.NO_CONSENSUS),
        (~np.isfinite(covariance).all((-1, -2)), Reason.UNDETERMINED),
        (angle < too_small, Reason.SMALL_ANGLE),
    )
    reason = np.select([case for case, _ in failures], [why for _, why in failures], Reason.OK).astype(
        np.int8
    )
    good = reason == Reason.OK
    distances = np.where(seen & good & np.isfinite(solution.squared), np.sqrt(solution.squared), np.nan)
    return Triangulation(
        points=np.where(good, frame.origin[:, None] + frame.unit * solution.points, np.nan).T,
        covariance=np.where(good[:, None, None], covariance, np.nan),
        inliers=(solution.inliers & good).T,
        residuals=distances.T * sigmas,
        angle=np.where(good, angle, np.nan),
        reason=reason,
    )


# ------------------------------------------------------------------------------ least squares


def _step(sightings: Sightings, points: np.ndarray) -> np.ndarray:
    """One Gauss-Newton step from points [3, P]."""
    here = linearise(sightings, points)
    return points - solve(here.normal, here.gradient)


def _refine(sightings: Sightings, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss-Newton from points [3, P] until nothing moves.

    Returns:
        points [3, P]; normal matrices [6, P], as they were before the last, tiny step; which came to rest [P].
    """
    count = points.shape[1]
    rest, normal, settled = np.empty((3, count)), np.empty((6, count)), np.zeros(count, dtype=bool)
    active = np.arange(count)
    for _ in range(ITERATIONS):
        here = linearise(sightings, points)
        step = solve(here.normal, here.gradient)
        points = points - step
        size = (step * here.gradient).sum(0)
        rest[:, active], normal[:, active], settled[active] = points, here.normal, size <= CONVERGED
        going = size > CONVERGED
        if not going.any():
            break
        if not going.all():
            active, points, sightings = active[going], points[:, going], sightings.of(going)
    return rest, normal, settled


def _needed(count: np.ndarray, share: float) -> np.ndarray:
    """How many views must agree, of `count` [P] that see the point."""
    return np.where(count < 3, 2, np.maximum(3, np.ceil(share * count - 1e-9)))


def _agree(
    sightings: Sightings,
    seen: np.ndarray,
    inliers: np.ndarray,
    points: np.ndarray,
    options: TriangulationOptions,
) -> _Solution:
    """Solve from the inliers [V, P] and decide again who they are, until the two fit each other."""
    needed = _needed(seen.sum(0), options.minimum_share)
    solution = _Solution.none(*seen.shape)
    index: np.ndarray = np.arange(len(needed))
    for _ in range(RECLASSIFY):
        used = sightings if np.array_equal(inliers, seen) else sightings.only(inliers)
        points, normal, rest = _refine(used, points)
        squared, depth = residuals(sightings, points)
        squared[depth <= 0] = np.inf
        agreeing = seen & (squared <= options.outlier_threshold**2)
        enough = rest & (agreeing.sum(0) >= needed)
        same = (agreeing == inliers).all(0)
        solution.put(index, _Solution(points, normal, agreeing, squared, same & enough), slice(None))
        again = np.flatnonzero(~same & enough)
        if not len(again):
            break
        index, needed, points = index[again], needed[again], points[:, again]
        sightings, seen, inliers = sightings.of(again), seen[:, again], agreeing[:, again]
    return solution


# -------------------------------------------------------------------------------- consensus


def _consensus(sightings: Sightings, seen: np.ndarray, options: TriangulationOptions) -> _Solution:
    """Find for each point the views that agree on it, and solve it from these."""
    solution = _Solution.none(*seen.shape)
    shuffled = np.where(seen, np.random.default_rng(0).random(seen.shape), 1).argsort(0)
    index: np.ndarray = np.arange(seen.shape[1])
    for views, share in ((QUICK_VIEWS, QUICK_SHARE), (THOROUGH_VIEWS, options.minimum_share)):
        here, visible = sightings.of(index), seen[:, index]
        start = _best_pair(here, visible, shuffled[:views, index], options)
        squared, depth = residuals(here, start)
        close = visible & (squared <= (SLACK * options.outlier_threshold) ** 2) & (depth > 0)
        found = _agree(here, visible, close, start, options)
        done = found.settled & (found.inliers.sum(0) >= _needed(visible.sum(0), share))
        solution.put(index[done], found, done)
        index = index[~done]
        if not len(index):
            break
    return solution


def _best_pair(
    sightings: Sightings, seen: np.ndarray, chosen: np.ndarray, options: TriangulationOptions
) -> np.ndarray:
    """The point [3, P] of that pair of the chosen views [M, P] which all views like best; NaN if there is none."""
    normal, right = normal_of_each(sightings)
    normal = Symmetric(*(np.take_along_axis(entry, chosen, 0) for entry in normal))
    right = np.take_along_axis(right, chosen[None], 1)
    valid = np.take_along_axis(seen, chosen, 0)
    pairs = np.array(list(combinations(range(len(chosen)), 2)))
    count, ceiling = seen.shape[1], (options.outlier_threshold * SLACK) ** 2
    best, cost = np.full((3, count), np.nan), np.full(count, np.inf)
    size = max(1, HYPOTHESES // seen.size)
    for block in np.split(pairs, range(size, len(pairs), size)):
        i, j = block.T
        points = solve(Symmetric(*(entry[i] + entry[j] for entry in normal)), right[:, i] + right[:, j])
        squared, depth = residuals(sightings, points[:, :, None])
        costs = np.where((squared < ceiling) & (depth > 0), squared, ceiling).sum(1)
        costs[~(valid[i] & valid[j] & np.isfinite(points).all(0))] = np.inf
        winner, everyone = costs.argmin(0), np.arange(count)
        better = costs[winner, everyone] < cost
        cost = np.where(better, costs[winner, everyone], cost)
        best = np.where(better, points[:, winner, everyone], best)
    return best


# ------------------------------------------------------------------------------------ angles


def _towards_cameras(views: Views, frame: Frame, points: np.ndarray) -> np.ndarray:
    centres = (views.world_from_camera[:, :, 3] - frame.origin).T / frame.unit
    return centres[:, :, None] - points[:, None]


def _rays(sightings: Sightings) -> np.ndarray:
    """Directions [3, V, P] of the measured rays: what is normal to both rows."""
    rays = np.cross(sightings.rows[:3, 0], sightings.rows[:3, 1], axis=0)
    return rays * np.sign((rays * sightings.depth[:3]).sum(0))


def _widest(directions: np.ndarray, used: np.ndarray) -> np.ndarray:
    """The largest angle [P] between two of the used [V, P] directions [3, V, P]; 0 where there are not two."""
    length = np.sqrt((directions * directions).sum(0))
    unit = np.where(used, directions / length, 0.0)
    least = np.zeros(used.shape[1])
    for view in range(len(used) - 1):
        others = slice(view + 1, None)
        cosine = (unit[:, view, None] * unit[:, others]).sum(0)
        least = np.minimum(least, (cosine - (used[view] & used[others])).min(0))
    return np.arccos(np.clip(1 + least, -1, 1))
