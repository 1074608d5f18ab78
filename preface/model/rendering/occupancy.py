"""Where a model is dense enough to be seen: a grid of cubes over its box, learned from its density.

A ray then need not search for the head: what lies in empty cubes is skipped, and the densities of the others say
where light may stop, which is what proposal rounds are for. A grid belongs to one code; another code, another grid.
It is not kept on the disk: it takes about as long as reading it back would be worth (`Shortcuts.occupancy`).

How the bounds are found, and what they miss. The density is evaluated at the corners of all cubes, as a Gaussian
with the variance of a cube, side^2 / 12 along each axis: as a render sees it in samples of a cube's length. The
largest of a cube's eight corners is taken for its highest density, the least for its lowest. A cube is empty if, at
its highest density, its longest diagonal stops at most `empty_alpha` of the light, and the same holds for its 26
neighbours. So a place is never dropped whose density passes the threshold at any corner of its cube or of one beside
it. What passes it only between corners may be: matter thinner than a cube, such as a lone strand of hair. What is
dropped of a ray adds up to at most `empty_alpha` for every cube that it crosses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from preface.model.rays import Rays
from preface.model.rendering.image import Space

POINTS = 4096  # positions that are evaluated together

Density = Callable[[Tensor], Tensor]  # positions [p, 3] in scene units to densities [p] per scene unit


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Cubes over a box, in scene units.

    Attributes:
        first: [3], the lower corner of the box and of the first cube.
        side: of a cube.
        steps: equal pieces into which rays are cut; no piece of a ray within the box is longer than a side.
        highest, lowest: float32 [x, y, z], densities of the cubes.
        occupied: bool [x, y, z], cubes that are not empty or touch one that is not.
    """

    first: Tensor
    side: float
    steps: int
    highest: Tensor
    lowest: Tensor
    occupied: Tensor

    @property
    def share(self) -> float:
        """Of the cubes, how many are occupied."""
        return float(self.occupied.float().mean())

    def cubes(self, rays: Rays) -> Tensor:
        """Numbers int32 [m, steps] of the cubes in which the middles of the pieces of rays lie."""
        middles = (torch.arange(self.steps, device=rays.near.device) + 0.5) / self.steps
        t = rays.near + middles * (rays.far - rays.near)
        found = torch.zeros_like(t, dtype=torch.int32)
        for axis, count in enumerate(self.occupied.shape):
            first = (rays.origins[:, axis : axis + 1] - self.first[axis]) / self.side
            place = torch.addcmul(first, t, rays.directions[:, axis : axis + 1] / self.side)
            # Conversion cuts towards zero; what rounding puts outside belongs to the outermost cubes.
            found.mul_(count).add_(place.clamp_(0, count - 1).to(torch.int32))
        return found

    def weight_bounds(self, rays: Rays, cubes: Tensor) -> Tensor:
        """At most how much of a ray's light each of its pieces gives, float32 [m, steps].

        The opacity of a piece at the highest density of its cube, times what the pieces before let through at the
        lowest of theirs. It bounds the weights as far as the densities bound the model's; what is behind a ray's
        first opaque cubes has next to none, while the edge of one that it only grazes hides nothing.

        Args:
            rays: m of them.
            cubes: as `cubes` returns them.
        """
        lengths = (rays.far - rays.near) * (rays.directions.norm(dim=-1, keepdim=True) / self.steps)
        empty = ~self._at(self.occupied, cubes)
        highest, lowest = (self._at(of, cubes).masked_fill_(empty, 0) for of in (self.highest, self.lowest))
        before = pad(lowest.mul_(lengths).cumsum(dim=-1)[:, :-1], (1, 0))
        return torch.expm1(-highest.mul_(lengths)).neg_().mul_(before.neg_().exp_())

    def meets(self, cubes: Tensor) -> Tensor:
        """Which pieces are in occupied cubes, bool [m, steps]."""
        return self._at(self.occupied, cubes)

    @staticmethod
    def _at(grid: Tensor, cubes: Tensor) -> Tensor:
        return grid.view(-1).index_select(0, cubes.view(-1)).view(cubes.shape)


def learn_occupancy(
    density: Density, space: Space, cubes: int, empty_alpha: float, device: torch.device | str = "cpu"
) -> Occupancy:
    """Evaluate a density at the corners of cubes over a box.

    Args:
        density: of a head, as cubes of that side see it (`preface.model.rendering.mesh.model_field`).
        space: of the model.
        cubes: along the box's longest side.
        empty_alpha: see above, in [0, 1).
        device: where `density` computes.

    Raises:
        ValueError: no cube, or an `empty_alpha` that is no share.
    """
    if cubes < 1 or not 0 <= empty_alpha < 1:
        raise ValueError(
            f"occupancy: {cubes} cubes and an alpha of {empty_alpha}; 1 or more, and 0 to below 1"
        )
    size = (space.box.maximum - space.box.minimum) * space.scale
    side = float(size.max()) / cubes
    shape = [max(1, math.ceil(length / side - 1e-9)) for length in size.tolist()]
    first = torch.from_numpy((space.box.minimum * space.scale).astype(np.float32)).to(device)
    corners = _at_corners(density, first, side, [count + 1 for count in shape])
    highest = max_pool3d(corners[None], 2, stride=1)[0]
    lowest = -max_pool3d(-corners[None], 2, stride=1)[0]
    seen = -torch.expm1(-highest * (math.sqrt(3) * side)) > empty_alpha
    widened = max_pool3d(seen[None].float(), 3, stride=1, padding=1)[0] > 0
    steps = math.ceil(float(np.linalg.norm(size)) / side)
    return Occupancy(first, side, steps, highest, lowest, widened)


@torch.no_grad()
def _at_corners(density: Density, first: Tensor, side: float, shape: list[int]) -> Tensor:
    """Densities [x, y, z] at the places first + side (i, j, k)."""
    found = first.new_empty(math.prod(shape))
    for begin in range(0, len(found), POINTS):
        number = torch.arange(begin, min(begin + POINTS, len(found)), device=first.device)
        place = torch.stack(torch.unravel_index(number, shape), dim=-1)
        found[begin : begin + len(number)] = density(first + side * place)
    return found.view(shape)
