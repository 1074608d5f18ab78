"""Which pixels a step trains on: pure functions of (seed, step), whatever the number of processes.

A sampler draws groups of pixels, each group of one view. The groups of a step are numbered, and rank r of w
draws groups r*G//w to (r+1)*G//w - 1 without drawing the others; together the ranks draw exactly what one
process would, in order. Nothing is remembered from step to step: the step is all there is to resume from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from preface.shards.format import PixelOrder
from preface.shards.streams import below, compiled_draws, permutation, stream_key, without_replacement

# What the streams of a step are for; part of what makes a run repeatable, so never renumbered.
_IDENTITIES, _VIEWS, _PIXELS, _CHOICE = 1, 2, 3, 4


@dataclass(frozen=True, eq=False)
class Pick:
    """Pixels to read.

    Attributes:
        identity, view: int64 [G].
        pixel: int64 [G, P], raster indices y * width + x.
        slot: int64 [G, P], where these pixels are stored within the view.
    """

    identity: np.ndarray
    view: np.ndarray
    pixel: np.ndarray
    slot: np.ndarray


@dataclass(frozen=True, eq=False)
class ViewIndex:
    """What there is to sample.

    Attributes:
        valid: bool [N, V], the views that exist; False for all views of identities that are left out.
        width, height: pixels.
        pixel_order: how pixels are stored.
        foreground_box: int [N, V, 4], x0 y0 x1 y1, the upper ends exclusive.
    """

    valid: np.ndarray
    width: int
    height: int
    pixel_order: PixelOrder
    foreground_box: np.ndarray

    def only(self, identities: Sequence[int] | np.ndarray) -> ViewIndex:
        """The same with only these identities, such as those of a split."""
        valid = np.zeros_like(self.valid)
        valid[np.asarray(identities)] = self.valid[np.asarray(identities)]
        return ViewIndex(valid, self.width, self.height, self.pixel_order, self.foreground_box)

    @cached_property
    def identities(self) -> np.ndarray:
        """Identities that have a view, int64 [n]."""
        return np.flatnonzero(self.valid.any(axis=1))

    @cached_property
    def pairs(self) -> np.ndarray:
        """Identity and view of each valid view, int64 [n, 2]."""
        return np.argwhere(self.valid)

    def pick(self, identity: np.ndarray, view: np.ndarray, pixel: np.ndarray) -> Pick:
        """The pick of raster pixels, with the slots that they are stored in."""
        if self.pixel_order == "raster":
            return Pick(identity, view, pixel, pixel)
        return Pick(identity, view, pixel, permutation(self.width * self.height)[1][pixel])

    def require_views(self) -> None:
        """Raise ValueError if there is nothing to sample."""
        if not self.valid.any():
            raise ValueError("index: no identity has a valid view; check the split and the shards")


class Sampler(Protocol):
    """Draws the pixels of a step."""

    @property
    def groups(self) -> int:
        """Groups of a step, of all ranks together."""
        ...

    def pick(self, step: int, rank: int, world: int) -> Pick:
        """Draw the groups of a rank."""
        ...


def groups_of(rank: int, world: int, groups: int) -> tuple[int, int]:
    """The first group of a rank, and the one after its last."""
    if not 0 <= rank < world:
        raise ValueError(f"rank: {rank} is not among the {world} of world")
    return rank * groups // world, (rank + 1) * groups // world


@dataclass(frozen=True, eq=False)
class PaperPattern:
    """The paper's batches: `rays` pixels of each of `views` views of each of `identities` identities.

    Identities are drawn without repetition, and views of an identity too, unless there are fewer than asked for;
    then each comes once before any comes twice. Pixels are drawn uniformly with repetition. In permuted shards
    they are a run of consecutive slots from a random one on, which is as random and a page instead of many.

    Attributes:
        index: what to sample.
        seed: of the stream.
        identities, views, rays: per step, per identity, per view.
    """

    index: ViewIndex
    seed: int
    identities: int = 64
    views: int = 8
    rays: int = 128

    def __post_init__(self) -> None:
        self.index.require_views()

    @property
    def groups(self) -> int:
        """Views of a step."""
        return self.identities * self.views

    def pick(self, step: int, rank: int, world: int) -> Pick:
        """Draw the groups of a rank."""
        begin, end = groups_of(rank, world, self.groups)
        population = self.index.identities
        everyone = np.ones((1, len(population)), dtype=bool)
        chosen = without_replacement(stream_key(self.seed, step, _IDENTITIES), 1, everyone, self.identities)
        people = population[chosen[0]]
        key = stream_key(self.seed, step, _VIEWS)
        views = without_replacement(key, self.identities, self.index.valid[people], self.views)
        identity, view = np.repeat(people, self.views)[begin:end], views.reshape(-1)[begin:end]
        return self._pixels(stream_key(self.seed, step, _PIXELS), begin, identity, view)

    def _pixels(self, key: int, begin: int, identity: np.ndarray, view: np.ndarray) -> Pick:
        """Draw the pixels of groups that begin with number `begin`."""
        groups, total = len(identity), self.index.width * self.index.height
        if self.index.pixel_order == "raster":
            pixel = below(key, begin * self.rays, groups * self.rays, total).reshape(groups, self.rays)
            return self.index.pick(identity, view, pixel)
        slot = (below(key, begin, groups, total)[:, None] + np.arange(self.rays)) % total
        return Pick(identity, view, permutation(total)[0][slot], slot)


@dataclass(frozen=True, eq=False)
class SingleRays:
    """Rays of single heads: each uniform over all pixels of all valid views, or over foreground boxes.

    Weighting is by box: a foreground draw is uniform over the bounding boxes of the views' foregrounds, so that
    some of the pixels between a head and the corners of its box come with it. That takes nothing but the tables
    of the shards, where a draw from the masks themselves would have to read every pixel first.

    Attributes:
        index: what to sample.
        seed: of the stream.
        rays: per step.
        foreground_share: the share of rays, in expectation, that are drawn uniformly from the foreground boxes
            of all views instead; 0 is uniform over all pixels.
    """

    index: ViewIndex
    seed: int
    rays: int = 8192
    foreground_share: float = 0.0

    def __post_init__(self) -> None:
        self.index.require_views()
        if not 0 <= self.foreground_share <= 1:
            raise ValueError(f"foreground_share: {self.foreground_share} is not between 0 and 1")
        if self.foreground_share > 0 and self._areas[-1] == 0:
            raise ValueError("foreground_share: no view has a foreground; use 0")

    @property
    def groups(self) -> int:
        """Rays of a step."""
        return self.rays

    @cached_property
    def _columns(self) -> np.ndarray:
        """Identities and views of the valid views, int64 [2, n]."""
        return np.ascontiguousarray(self.index.pairs.T)

    @cached_property
    def _boxes(self) -> np.ndarray:
        """Left, top and width of the valid views' foreground boxes, int64 [3, n]."""
        x0, y0, x1, _ = self.index.foreground_box[tuple(self._columns)].astype(np.int64).T
        return np.stack([x0, y0, x1 - x0])

    @cached_property
    def _areas(self) -> np.ndarray:
        """The area of each box and those before, int64 [n]."""
        boxes = self.index.foreground_box[tuple(self._columns)].astype(np.int64)
        return np.cumsum(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1))

    def pick(self, step: int, rank: int, world: int) -> Pick:
        """Draw the groups of a rank."""
        begin, end = groups_of(rank, world, self.groups)
        draws = compiled_draws(end - begin)
        draw = draws.single_rays if draws else single_rays_by_numpy
        uniform, chance, boxed = (stream_key(self.seed, step, word) for word in (_PIXELS, _CHOICE, _VIEWS))
        pair, pixel = draw(
            (uniform, chance, boxed),
            round(self.foreground_share * 2**53),
            begin,
            end - begin,
            (self.index.width, self.index.height),
            self._boxes,
            self._areas,
        )
        identity, view = self._columns.take(pair, axis=1)
        return self.index.pick(identity, view, pixel[:, None])


def single_rays_by_numpy(
    keys: tuple[int, int, int],
    bound: int,
    begin: int,
    count: int,
    size: tuple[int, int],
    boxes: np.ndarray,
    areas: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """What `SingleRays` draws, by numpy, which runs anywhere; `compiled_draws.single_rays` is the compiled twin.

    Args:
        keys: of the streams of pixels, of chance, and of places within the boxes.
        bound: a ray is drawn from the boxes if its number of chance, of 53 bits, is below.
        begin, count: the first ray, and how many.
        size: width and height of the views.
        boxes: int64 [3, n], left, top and width of the views' foreground boxes.
        areas: int64 [n], the area of each box and those before.

    Returns:
        The views' numbers and raster pixels, int64 [count] each.
    """
    uniform, chance, boxed = keys
    width, height = size
    number = below(uniform, begin, count, len(areas) * width * height)
    pair = number // (width * height)
    pixel = number - pair * (width * height)  # in a tenth of the time of `np.divmod`
    if bound > 0:
        chosen = np.flatnonzero(below(chance, begin, count, 2**53) < bound)
        number = below(boxed, begin, count, int(areas[-1]))[chosen]
        pair[chosen] = box = np.searchsorted(areas, number, side="right")
        left, top, across = boxes[:, box]
        within = number - np.concatenate([[0], areas])[box]
        down = within // across
        pixel[chosen] = (top + down) * width + left + within - down * across
    return pair, pixel


@dataclass(frozen=True, eq=False)
class Patches:
    """Square patches, each uniform over the valid views and over its positions within the image.

    Attributes:
        index: what to sample.
        seed: of the stream.
        patches: per step.
        size: side in pixels. Pixels of a patch follow each other row by row.
    """

    index: ViewIndex
    seed: int
    patches: int = 8
    size: int = 32

    def __post_init__(self) -> None:
        self.index.require_views()
        if not 0 < self.size <= min(self.index.width, self.index.height):
            raise ValueError(f"size: a patch of {self.size} does not fit into the images")

    @property
    def groups(self) -> int:
        """Patches of a step."""
        return self.patches

    def pick(self, step: int, rank: int, world: int) -> Pick:
        """Draw the groups of a rank."""
        begin, end = groups_of(rank, world, self.groups)
        count, pairs = end - begin, self.index.pairs
        identity, view = pairs[below(stream_key(self.seed, step, _VIEWS), begin, count, len(pairs))].T
        across, down = self.index.width - self.size + 1, self.index.height - self.size + 1
        corner = below(stream_key(self.seed, step, _PIXELS), begin, count, across * down)
        y, x = np.divmod(corner, across)
        inside = np.arange(self.size)
        rows = (y[:, None] + inside) * self.index.width + x[:, None]
        return self.index.pick(identity, view, (rows[:, :, None] + inside).reshape(count, -1))
