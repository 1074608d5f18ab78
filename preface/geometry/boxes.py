"""Axis-aligned boxes and where rays enter and leave them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace

from preface.geometry.arrays import Array, floating, matching
from preface.geometry.errors import GeometryError


@dataclass(frozen=True, eq=False)
class Box:
    """The points between two corners, faces included.

    Attributes:
        minimum, maximum: float64 [3], metres.

    Raises:
        GeometryError: a corner is not three finite numbers, or the box is empty along an axis.
    """

    minimum: np.ndarray
    maximum: np.ndarray

    def __post_init__(self) -> None:
        for field in ("minimum", "maximum"):
            corner = np.array(getattr(self, field), dtype=np.float64)
            if corner.shape != (3,) or not np.isfinite(corner).all():
                raise GeometryError(f"{field}: {getattr(self, field)} is not three finite numbers (x, y, z)")
            object.__setattr__(self, field, corner)
        if not (self.minimum < self.maximum).all():
            axis = int(np.argmin(self.minimum < self.maximum))
            raise GeometryError(
                f"maximum: the box is empty along {'xyz'[axis]}, from {self.minimum[axis]} to "
                f"{self.maximum[axis]}; each maximum must exceed its minimum"
            )

    @property
    def center(self) -> np.ndarray:
        """The centre [3]."""
        return self.minimum + self.half_sides

    @property
    def half_sides(self) -> np.ndarray:
        """Half the side lengths [3]."""
        return (self.maximum - self.minimum) / 2

    def contains(self, points: Array) -> Array:
        """Whether points [..., 3] lie in the box or on its faces, [...]."""
        points = floating(points)
        xp = array_namespace(points)
        inside = (points >= matching(self.minimum, points)) & (points <= matching(self.maximum, points))
        return xp.all(inside, axis=-1)

    def intersect(self, origins: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Intersect rays with the box; see `intersect_box`."""
        origins, directions = floating(origins), floating(directions)
        corners = matching(self.minimum, origins), matching(self.maximum, origins)
        return intersect_box(*corners, origins, directions)


@np.errstate(all="ignore")  # Division by a zero component is replaced below.
def intersect_box(
    minimum: Array, maximum: Array, origins: Array, directions: Array
) -> tuple[Array, Array, Array]:
    """Intersect rays origin + t direction, t >= 0, with boxes, by slabs (Kay and Kajiya 1986).

    A ray parallel to a slab is inside it always or never, and the faces belong to the box. Numpy or torch.

    Args:
        minimum, maximum: corners [..., 3].
        origins, directions: [..., 3]; the directions may have any length.

    Returns:
        near, far: [...], t at entrance (0 for rays that start inside) and exit, in units of the direction's
            length; NaN where not hit.
        hit: [...], whether a piece of positive length lies in the box. Rays that only touch an edge or a
            corner, have zero direction or NaN anywhere, do not hit.
    """
    xp = array_namespace(minimum, origins, directions)
    parallel = directions == 0
    within = (origins >= minimum) & (origins <= maximum)
    to_minimum, to_maximum = (minimum - origins) / directions, (maximum - origins) / directions
    enter = xp.where(parallel, xp.where(within, -xp.inf, xp.inf), xp.minimum(to_minimum, to_maximum))
    leave = xp.where(parallel, xp.where(within, xp.inf, -xp.inf), xp.maximum(to_minimum, to_maximum))
    near = xp.clip(xp.max(enter, axis=-1), 0.0, None)
    far = xp.min(leave, axis=-1)
    hit = (near < far) & xp.isfinite(far)
    return xp.where(hit, near, xp.nan), xp.where(hit, far, xp.nan), hit
