"""Rays of pixels out of a table of views: `preface.geometry.rays.cast_rays` at the speed of a training loop.

The definitions are those of `preface.geometry.rays` and `preface.geometry.boxes`, and the tests hold this file
against them. It differs in how it gets there:

- the numbers of a view are gathered once per group of rays that share the view, not once per ray;
- distortion is undone by as many Newton steps, from a series expansion, as the worst of the views needs to
  be solved to rounding, a number found when the table is made, so that there is no residual to wait for;
- rays go through in blocks that stay in the cache;
- distorted pixels, the sum with the displacement that undoes the distortion, and directions are float64. The
  displacement itself is float32, and so is what follows from the rounded directions: view directions, radii and
  depths at the box's faces, from differences box - origin that were formed in float64.

The lenses of a shard are one-to-one over their images (the writer refuses others), hence every pixel has a ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

# Rays per block: a few float64 arrays of this length fit into a core's second-level cache, and the cost of
# calling torch is small against that of computing.
BLOCK = 16384
# A displacement is solved when another step would be below this, in normalised units: next to nothing against
# the rounding of the direction's 1, or so many roundings of itself.
SOLVED, _ROUNDINGS = 1e-10, 1e-6
# The radii are those of the point before the last step, which may be this far, and are so much less exact.
JACOBIAN = 1e-5
MAX_STEPS = 12
_SAMPLES = 33  # per axis, on which the steps are counted, outline included


class LensError(ValueError):
    """A lens whose distortion Newton's method does not undo; the message says which."""


@dataclass(frozen=True, eq=False)
class RayTable:
    """What the rays of M views need, on one device.

    Attributes:
        exact: float64 [13, M], see `_columns`.
        columns: float32 [30, M], see there.
        width: of the images, pixels.
        steps: Newton steps that all lenses are solved in; 0 if none distorts.
        rational: whether a lens has a denominator.
    """

    exact: Tensor
    columns: Tensor
    width: int
    steps: int
    rational: bool

    @staticmethod
    def build(
        intrinsics: np.ndarray,
        canonical_from_camera: np.ndarray,
        box: np.ndarray,
        near_far: np.ndarray,
        size: tuple[int, int],
        scale: float,
        device: torch.device,
    ) -> RayTable:
        """Build the table.

        Args:
            intrinsics: [M, 12], pixels.
            canonical_from_camera: [M, 3, 4], metres.
            box: [M, 2, 3], metres.
            near_far: [M, 2], metres.
            size: width and height of the images, pixels.
            scale: what lengths are multiplied with, 1 for metres or the dataset's `scene_scale`.
            device: where the rays are formed; it must know float64.

        Raises:
            LensError: a lens that is not undone in `MAX_STEPS` steps.
        """
        width, height = size
        lenses = np.unique(intrinsics, axis=0)
        rational = bool(lenses[:, 9:12].any())
        steps = _count_steps(lenses, width, height, rational) if lenses[:, 4:].any() else 0
        exact, columns = _columns(intrinsics, canonical_from_camera, box * scale, near_far * scale, scale)
        return RayTable(exact.to(device), columns.to(device), width, steps, rational)

    @property
    def device(self) -> torch.device:
        """Where the rays are formed."""
        return self.exact.device


@dataclass(frozen=True)
class RayBuffers:
    """Where rays [n] are written to, float32 and contiguous, and `hit` bool."""

    origins: Tensor
    directions: Tensor
    viewdirs: Tensor
    radii: Tensor
    near: Tensor
    far: Tensor
    hit: Tensor


def form_rays(table: RayTable, views: Tensor, pixels: Tensor, out: RayBuffers) -> None:
    """Form the rays of pixels and write them, group by group.

    Args:
        table: of the views.
        views: int64 [G], columns of the table.
        pixels: int64 [G, P], raster indices y * width + x.
        out: buffers of G * P rays.
    """
    groups, per_group = pixels.shape
    # Gathering along rows is several times as fast as indexing columns.
    exact = table.exact.gather(1, views.expand(len(table.exact), -1)).unsqueeze(-1)  # [13, G, 1]
    columns = table.columns.gather(1, views.expand(len(table.columns), -1)).unsqueeze(-1)
    _repeat(columns[ORIGIN : ORIGIN + 3, :, 0].T, out.origins.view(groups, per_group, 3))
    block = max(1, BLOCK // per_group)
    buffers = [getattr(out, field.name) for field in fields(RayBuffers)]
    for begin in range(0, groups, block):
        some = slice(begin, begin + block)
        part = slice(begin * per_group, min(begin + block, groups) * per_group)
        parts = _Columns(exact[:, some].unbind(0), columns[:, some].unbind(0))
        _form_block(table, parts, pixels[some], RayBuffers(*(buffer[part] for buffer in buffers)))


def _repeat(rows: Tensor, out: Tensor) -> None:
    """Copy rows [G, 3] to [G, P, 3], in stretches as long as divide P, since short ones are slow."""
    groups, per_group, _ = out.shape
    stretch = math.gcd(per_group, 16)
    out.view(groups, per_group // stretch, 3 * stretch).copy_(rows.repeat(1, stretch)[:, None])


def _form_block(table: RayTable, columns: _Columns, pixels: Tensor, out: RayBuffers) -> None:
    """Form the rays of one block: columns [g, 1], pixels [g, P], out [g * P]."""
    shape = pixels.shape
    x, y = _distorted(columns, pixels, table.width)
    if table.steps:
        x, y, radii = _undistort(columns, x, y, table)
        out.radii.view(shape).copy_(radii)
    else:
        out.radii.view(shape).copy_((columns.single[0] + columns.single[1]) * RADIUS)
    directions = [x * r0 + y * r1 + r2 for r0, r1, r2 in columns.axes()]
    singles = [direction.float() for direction in directions]
    length_inverse = torch.rsqrt(singles[0] * singles[0] + singles[1] * singles[1] + singles[2] * singles[2])
    for axis in range(3):
        out.directions[:, axis].view(shape).copy_(singles[axis])
        torch.mul(singles[axis], length_inverse, out=out.viewdirs[:, axis].view(shape))
    _depths(columns, singles, out)


def _depths(columns: _Columns, directions: list[Tensor], out: RayBuffers) -> None:
    """Write near, far and hit of rays with direction components [g, P] (`preface.geometry.boxes`)."""
    shape = directions[0].shape
    enter = leave = None
    for axis, direction in enumerate(directions):
        inverse = direction.reciprocal()
        one, other = columns.single[MINIMUM + axis] * inverse, columns.single[MAXIMUM + axis] * inverse
        low, high = torch.minimum(one, other), torch.maximum(one, other)
        enter = low if enter is None else torch.maximum(enter, low)
        leave = high if leave is None else torch.minimum(leave, high)
    assert enter is not None
    assert leave is not None
    near, far = enter.clamp_(0.0, FINITE), leave.clamp_(-FINITE, FINITE)
    # A product with 0 or 1 chooses without a branch per ray, which costs a processor ten times as much.
    hit = far.clone().gt_(near)
    missed = 1 - hit
    torch.add(near * hit, columns.single[NEAR] * missed, out=out.near.view(shape))
    torch.add(far * hit, columns.single[FAR] * missed, out=out.far.view(shape))
    out.hit.view(shape).copy_(hit)


# ---------------------------------------------------------------------------------------- the table's columns

# float64: 1/fx 1/fy cx-½ cy-½, then the rotation by rows.
_ROTATION = 4
# float32: 1/fx 1/fy, k1 k2 p1 p2 k3 k4 k5 k6, what follows from them (see `_columns`), the camera's centre, the
# box's faces less the centre, and the view's own depths. `preface.shards.compiled` picks its columns by them.
COEFFICIENTS, SERIES, DERIVED = 2, 10, 12
ORIGIN, MINIMUM, MAXIMUM, NEAR, FAR = 19, 22, 25, 28, 29
FINITE, _TINY = 1e30, 1e-30  # beyond any scene, and within float32
RADIUS = 0.5 * 2 / math.sqrt(12)  # of the mean of two footprints


class _Columns:
    """The columns of a block, one tensor [g, 1] each, of float64 (`double`) and of float32 (`single`)."""

    def __init__(self, double: Sequence[Tensor], single: Sequence[Tensor]):
        self.double, self.single = double, single

    def axes(self) -> list[Sequence[Tensor]]:
        """The three rows of the rotation."""
        return [self.double[_ROTATION + 3 * axis : _ROTATION + 3 * axis + 3] for axis in range(3)]


def _columns(
    intrinsics: np.ndarray, poses: np.ndarray, box: np.ndarray, near_far: np.ndarray, scale: float
) -> tuple[Tensor, Tensor]:
    """The numbers that rays need, float64 [13, M] and float32 [30, M]; box and near_far are scaled, poses not."""
    lens = intrinsics.T
    k1, k2, p1, p2, k3, k4, k5, _ = lens[4:]
    # radial(u) = 1 + a u + b u² + ..., so that r = r_d (1 - a u_d + (3a² - b) u_d² + ...)
    a = k1 - k4
    b = k2 - k5 - k4 * a
    affine = [1 / lens[0], 1 / lens[1], lens[2] - 0.5, lens[3] - 0.5]
    derived = [2 * p1, 2 * p2, 4 * k2, 6 * k3, 2 * k1, 4 * p1, 4 * p2]
    origin = poses[:, :, 3].T * scale
    rotation = poses[:, :, :3].transpose(1, 2, 0).reshape(9, -1)
    # A camera in the plane of a face sees it at depth 0 and not at 0/0 along rays within that plane.
    below, above = box[:, 0].T - origin, box[:, 1].T - origin
    faces = [*np.where(below == 0, -_TINY, below), *np.where(above == 0, _TINY, above)]
    coefficients = [*affine[:2], *lens[4:12], -a, 3 * a * a - b, *derived]
    exact = np.stack([*affine, *rotation])
    columns = np.stack([*coefficients, *origin, *faces, *near_far.T]).astype(np.float32)
    return torch.from_numpy(exact), torch.from_numpy(columns)


# ------------------------------------------------------------------------------------------------ distortion


def _distorted(columns: _Columns, pixels: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """The distorted normalised points of pixels [g, P], float64."""
    fx_inverse, fy_inverse, cx, cy = columns.double[:4]
    index = pixels.double()
    row = torch.floor((index + 0.5) * (1 / width))  # exact: indices are far below 2^52
    return (index - row * width - cx) * fx_inverse, (row - cy) * fy_inverse


def _undistort(columns: _Columns, xd: Tensor, yd: Tensor, table: RayTable) -> tuple[Tensor, Tensor, Tensor]:
    """Undistort xd, yd [g, P]: x, y and the radii, whose Jacobian is that of the point before the last step.

    What is solved for is the displacement x - xd, in float32: it is as much smaller than x as the distortion is
    weak, and so is its rounding.
    """
    x, y = xd.float(), yd.float()
    dx, dy = _series(columns, x, y)
    for _ in range(table.steps):
        step_x, step_y, jacobian = _newton_step(columns, x, y, dx, dy, table.rational)
        dx, dy = dx + step_x, dy + step_y
    xx, xy, yy, inverse = jacobian
    square = xy * xy
    along_x = torch.sqrt(yy * yy + square) * columns.single[0]
    along_y = torch.sqrt(xx * xx + square) * columns.single[1]
    return xd + dx.double(), yd + dy.double(), (along_x + along_y) * inverse * RADIUS


def _series(columns: _Columns, xd: Tensor, yd: Tensor) -> tuple[Tensor, Tensor]:
    """The first terms of the displacement, right to the second power of the radial coefficients; float32."""
    c = columns.single
    p1, p2, twice_p1, twice_p2 = c[COEFFICIENTS + 2], c[COEFFICIENTS + 3], c[DERIVED], c[DERIVED + 1]
    u = xd * xd + yd * yd
    gain = u * (c[SERIES] + u * c[SERIES + 1]) - (twice_p2 * xd + twice_p1 * yd)
    return gain * xd - u * p2, gain * yd - u * p1


def _newton_step(
    columns: _Columns, xd: Tensor, yd: Tensor, dx: Tensor, dy: Tensor, rational: bool
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Newton's step from the point xd + dx, yd + dy to where the lens sees xd, yd.

    The lens is that of `preface.geometry.lens`, written as distorted(m) = m + excess m + u p, with the excess
    radial - 1 + 2 p·m, so that the residual is a sum of small numbers.

    Returns:
        the step in x and in y, and the Jacobian xx, xy, yy with 1 / its determinant; float32.
    """
    c = columns.single
    k1, k2, p1, p2, k3, k4, k5, k6 = c[COEFFICIENTS : COEFFICIENTS + 8]
    twice_p1, twice_p2, four_k2, six_k3, twice_k1, four_p1, four_p2 = c[DERIVED : DERIVED + 7]
    x, y = xd + dx, yd + dy
    u = x * x + y * y
    radial = u * (k1 + u * (k2 + u * k3))  # less one
    slope = twice_k1 + u * (four_k2 + u * six_k3)  # twice its derivative by u
    if rational:
        below = u * (k4 + u * (k5 + u * k6))
        inverse = (1 + below).reciprocal()
        radial = (radial - below) * inverse
        slope = (slope - 2 * (1 + radial) * (k4 + u * (2 * k5 + u * (3 * k6)))) * inverse
    tangential = twice_p2 * x + twice_p1 * y
    excess = radial + tangential
    error_x = dx + excess * x + u * p2
    error_y = dy + excess * y + u * p1
    gain = 1 + excess
    slope_x = slope * x
    xx = gain + slope_x * x + four_p2 * x
    xy = slope_x * y + (twice_p1 * x + twice_p2 * y)
    yy = gain + slope * (y * y) + four_p1 * y
    inverse = (xx * yy - xy * xy).reciprocal()
    step_x = (xy * error_y - yy * error_x) * inverse
    step_y = (xy * error_x - xx * error_y) * inverse
    return step_x, step_y, (xx, xy, yy, inverse)


def _count_steps(lenses: np.ndarray, width: int, height: int, rational: bool) -> int:
    """How many Newton steps solve all lenses [m, 12] everywhere in their images, by trying a grid of pixels.

    Raises:
        LensError: `MAX_STEPS` are not enough, or the Jacobian is not positive definite where they end.
    """
    identity = np.tile(np.eye(3, 4), (len(lenses), 1, 1))
    nothing = np.zeros((len(lenses), 2, 3))
    double, single = (t.unsqueeze(-1) for t in _columns(lenses, identity, nothing, nothing[:, :, 0], 1.0))
    columns = _Columns(double.unbind(0), single.unbind(0))
    across, down = np.linspace(0, width, _SAMPLES), np.linspace(0, height, _SAMPLES)
    grid = torch.from_numpy(np.stack(np.meshgrid(across, down), -1).reshape(-1, 2) - 0.5)
    xd = ((grid[:, 0] - double[2]) * double[0]).float()
    yd = ((grid[:, 1] - double[3]) * double[1]).float()
    dx, dy = _series(columns, xd, yd)
    applied = math.inf
    for steps in range(MAX_STEPS + 1):
        step_x, step_y, (xx, _, yy, inverse) = _newton_step(columns, xd, yd, dx, dy, rational)
        # A few roundings of the displacement and of the terms that make it up are as near as float32 comes.
        solved = SOLVED + _ROUNDINGS * (dx.abs() + dy.abs())
        unsolved = ~((torch.hypot(step_x, step_y) <= solved) & (xx + yy > 0) & (inverse > 0))
        if steps and applied < JACOBIAN and not bool(unsolved.any()):
            return steps
        dx, dy, applied = dx + step_x, dy + step_y, float(torch.hypot(step_x, step_y).max())
    worst = int(unsolved.any(-1).nonzero()[0])
    raise LensError(
        f"the lens {lenses[worst].tolist()} folds inside its {width}x{height} image, or nearly so"
    )
