"""Sightings: what many views see of many points, as rows that are linear in the unknown points.

A view with rotation (r1, r2, r3) and centre c sees a point X at the undistorted image point m = (x, y). With the
depth z = r3·(X - c), how far the projection lies from the measurement is

    m - π(X) = (m r3 - (r1, r2)) · (X - c) / z .

The Jacobian of the undistortion at the measured pixel turns that into pixels, and division by the standard
deviation into a whitened residual e = (a·X - b) / z, exact to first order in the lens; all else is exact. Hence
de/dX = (a - e r3) / z, and one pass over `a`, `b` and `r3` gives residuals, Jacobians, normal equations and, with
z set to 1, the linear (DLT) solution. Views stand before points, so that every operation runs over contiguous
points and sums over views are sums of rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from preface.geometry import Views, lens

# Last Newton step of the undistortion, relative to the radius, whose square is below the rounding of a pixel.
SMALL_STEP = 1e-6


class Symmetric(NamedTuple):
    """Symmetric 3x3 matrices, entry by entry, each [...]."""

    xx: np.ndarray
    xy: np.ndarray
    xz: np.ndarray
    yy: np.ndarray
    yz: np.ndarray
    zz: np.ndarray


class Sightings(NamedTuple):
    """V views of P points; a point that a view does not see has zeros, and depth 1, so that it adds nothing.

    Attributes:
        rows: [4, 2, V, P], a (three) and b, of the whitened residuals in x and in y.
        depth: [4, V, P], so that z = depth[:3]·X + depth[3].
    """

    rows: np.ndarray
    depth: np.ndarray

    def of(self, points: np.ndarray) -> Sightings:
        """Those of some points: a mask or indices."""
        return Sightings(self.rows[..., points], self.depth[..., points])

    def only(self, kept: np.ndarray) -> Sightings:
        """The same without those where `kept` [V, P] is False."""
        depth = np.where(kept, self.depth, 0.0)
        depth[3] += ~kept
        return Sightings(np.where(kept, self.rows, 0.0), depth)


class Frame(NamedTuple):
    """Where the arithmetic is done: X = origin + unit · local, so that far or large scenes lose no digits."""

    origin: np.ndarray
    unit: float

    @staticmethod
    def about(centres: np.ndarray) -> Frame:
        """The frame about camera centres [V, 3] with their spread as the unit."""
        origin = centres.mean(0)
        spread = float(np.sqrt(((centres - origin) ** 2).sum(-1).mean()))
        return Frame(origin, spread if spread > 0 else 1.0)


class _Undistorted(NamedTuple):
    """Image points [V, P] at depth 1, d_pixel/d_point there without the focal lengths, and where they exist."""

    x: np.ndarray
    y: np.ndarray
    xx: np.ndarray
    xy: np.ndarray
    yy: np.ndarray
    seen: np.ndarray


def _undistort(views: Views, pixels: np.ndarray) -> _Undistorted:
    """Undistort pixels [V, P, 2] by two Newton steps from the distorted point.

    That is enough for ordinary lenses: the step that remains is the square of the last. Where the last was not
    small, or the pixel is beyond the lens, `lens.unproject` decides.
    """
    intrinsics = views.intrinsics[:, None]
    fx, fy, cx, cy = (intrinsics[..., i] for i in range(4))
    distorted_x, distorted_y = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    x, y = distorted_x, distorted_y
    for _ in range(2):
        at = lens.distort(intrinsics, x, y)
        error_x, error_y = distorted_x - at.x, distorted_y - at.y
        scale = 1 / (at.xx * at.yy - at.xy * at.xy)
        step_x = (at.yy * error_x - at.xy * error_y) * scale
        step_y = (at.xx * error_y - at.xy * error_x) * scale
        x, y = x + step_x, y + step_y
    squared = x * x + y * y
    step = step_x * step_x + step_y * step_y
    fast = (step < SMALL_STEP**2 * (squared + SMALL_STEP)) & (
        squared < 0.81 * views.monotonic_radius[:, None] ** 2
    )
    result = _Undistorted(x, y, at.xx, at.xy, at.yy, fast)
    slow = ~fast & np.isfinite(pixels).all(-1)
    if slow.any():
        view = np.nonzero(slow)[0]
        exact, _, found = lens.unproject(views.intrinsics[view], views.monotonic_radius[view], pixels[slow])
        at = lens.distort(views.intrinsics[view], exact[:, 0], exact[:, 1])
        for array, values in zip(result, (*exact.T, at.xx, at.xy, at.yy, found), strict=True):
            array[slow] = values
    return result


def sight(views: Views, frame: Frame, pixels: np.ndarray, sigmas: np.ndarray) -> tuple[Sightings, np.ndarray]:
    """Form the sightings of pixels [V, P, 2] with standard deviations [V, P], and where there are any [V, P].

    There is none where a pixel is not finite or the lens maps no direction to it.
    """
    image = _undistort(views, pixels)
    seen, missing = image.seen, ~image.seen
    along_x, along_y = views.intrinsics[:, 0, None] / sigmas, views.intrinsics[:, 1, None] / sigmas
    gains = np.stack([along_x * image.xx, along_y * image.xy, along_x * image.xy, along_y * image.yy])
    np.copyto(gains, 0.0, where=missing)
    by_x, by_y = gains.reshape(2, 2, *seen.shape)  # of the residuals in (x, y), each [2, V, P]
    forward = by_x * image.x + by_y * image.y
    np.copyto(forward, 0.0, where=missing)
    poses = views.world_from_camera
    r1, r2, r3 = (poses[:, :, axis].T[:, None, :, None] for axis in range(3))  # each [3, 1, V, 1]
    centres = (poses[:, :, 3] - frame.origin).T[:, :, None] / frame.unit  # [3, V, 1]
    rows = np.empty((4, *forward.shape))
    np.multiply(forward, r3, out=rows[:3])
    rows[:3] -= by_x * r1
    rows[:3] -= by_y * r2
    rows[3] = rows[0] * centres[0] + rows[1] * centres[1] + rows[2] * centres[2]
    depth = np.empty((4, *seen.shape))
    depth[:3] = r3[:, 0] * seen
    depth[3] = missing - (r3[:, 0] * centres).sum(0) * seen
    return Sightings(rows, depth), seen


class Linearised(NamedTuple):
    """Residuals at some points, and the normal equations of a Gauss-Newton step from there.

    Attributes:
        squared: [V, P], squared length of the whitened residuals.
        depth: [V, P], in the frame's unit.
        normal: of `Symmetric`, each [P].
        gradient: [3, P], J^T e.
    """

    squared: np.ndarray
    depth: np.ndarray
    normal: Symmetric
    gradient: np.ndarray


def linearise(sightings: Sightings, points: np.ndarray) -> Linearised:
    """Evaluate at points [3, P] of the local frame."""
    a, r3 = sightings.rows, sightings.depth
    z = _dot(r3, points) + r3[3]
    inverse = 1 / z
    e = (_dot(a, points) - a[3]) * inverse
    jacobian = np.empty((3, *e.shape))
    for axis in range(3):
        np.multiply(e, r3[axis], out=jacobian[axis])
        np.subtract(a[axis], jacobian[axis], out=jacobian[axis])
        jacobian[axis] *= inverse
    flat = jacobian.reshape(3, 2 * e.shape[1], e.shape[2])
    squares = e * e
    return Linearised(
        squared=squares[0] + squares[1],
        depth=z,
        normal=_gram(flat),
        gradient=np.stack([(row * e.reshape(row.shape)).sum(0) for row in flat]),
    )


def residuals(sightings: Sightings, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared whitened residuals and depths at points [3, ...] that broadcast: sightings [..., V, P]."""
    a, r3 = sightings.rows, sightings.depth
    z = _dot(r3, points) + r3[3]
    x = _dot(a[:, 0], points) - a[3, 0]
    y = _dot(a[:, 1], points) - a[3, 1]
    return (x * x + y * y) / (z * z), z


def linear_points(sightings: Sightings) -> np.ndarray:
    """The points [3, P] of least sum of (e z)²: exact without noise, the start of everything else."""
    _, _, views, count = sightings.rows.shape
    flat = sightings.rows.reshape(4, 2 * views, count)
    return solve(_gram(flat[:3]), np.stack([(row * flat[3]).sum(0) for row in flat[:3]]))


def normal_of_each(sightings: Sightings) -> tuple[Symmetric, np.ndarray]:
    """The linear normal equations of each view alone: matrices [V, P] and right-hand sides [3, V, P]."""
    a = sightings.rows
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    normal = Symmetric(*(a[i, 0] * a[j, 0] + a[i, 1] * a[j, 1] for i, j in pairs))
    return normal, (a[:3] * a[3]).sum(1)


def _dot(rows: np.ndarray, points: np.ndarray) -> np.ndarray:
    return rows[0] * points[0] + rows[1] * points[1] + rows[2] * points[2]


def _gram(rows: np.ndarray) -> Symmetric:
    """Sum of products [P] of rows [3, M, P]."""
    x, y, z = rows
    return Symmetric(*((p * q).sum(0) for p, q in ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))))


def _factor(n: Symmetric) -> tuple[np.ndarray, ...]:
    """L D L^T: unit lower (xy, xz, yz) and the pivots (x, y, z). A pivot that is not positive is NaN."""
    dx = np.where(n.xx > 0, n.xx, np.nan)
    lxy, lxz = n.xy / dx, n.xz / dx
    dy = n.yy - lxy * n.xy
    dy = np.where(dy > 0, dy, np.nan)
    lyz = (n.yz - lxz * n.xy) / dy
    dz = n.zz - lxz * n.xz - lyz * lyz * dy
    return lxy, lxz, lyz, dx, dy, np.where(dz > 0, dz, np.nan)


def solve(normal: Symmetric, right: np.ndarray) -> np.ndarray:
    """Solve normal · x = right [3, ...]; NaN where the matrix is not positive definite."""
    lxy, lxz, lyz, dx, dy, dz = _factor(normal)
    u = right[0]
    v = right[1] - lxy * u
    w = right[2] - lxz * u - lyz * v
    z = w / dz
    y = v / dy - lyz * z
    return np.stack([u / dx - lxy * y - lxz * z, y, z])


def inverse(normal: Symmetric) -> np.ndarray:
    """Invert: [..., 3, 3]; NaN where the matrix is not positive definite."""
    lxy, lxz, lyz, dx, dy, dz = _factor(normal)
    mxy, myz = -lxy, -lyz  # the inverse of L
    mxz = lxy * lyz - lxz
    ix, iy, iz = 1 / dx, 1 / dy, 1 / dz
    xx = ix + mxy * mxy * iy + mxz * mxz * iz
    xy = mxy * iy + mxz * myz * iz
    xz = mxz * iz
    yy = iy + myz * myz * iz
    yz = myz * iz
    return np.stack([np.stack(row, -1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, iz))], -2)
