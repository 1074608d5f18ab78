"""The lens: every perspective model of COLMAP as one function of twelve numbers.

    intrinsics = (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6)        COLMAP's FULL_OPENCV

The other models are this one with zeros, so a stack of 12-vectors [..., 12] mixes models freely, and all
functions broadcast its leading dimensions against those of the points. With m = (X/Z, Y/Z), u = |m|² and
p = (p2, p1), the Brown-Conrady model with OpenCV's rational denominator is

    distorted(m) = radial(u) m + 2 (p·m) m + u p,
    radial(u)    = (1 + k1 u + k2 u² + k3 u³) / (1 + k4 u + k5 u² + k6 u³),
    pixel        = (fx, fy) distorted(m) + (cx, cy).

`distorted` is the gradient of a potential, hence its Jacobian is symmetric; on a convex set where that is
positive definite it is one-to-one. `monotonic_radius` is the radius of such a disc. Inside it every function
here is exact to rounding; outside it, and behind the camera, results are NaN and `valid` is False.
"""

from typing import Any, NamedTuple

import numpy as np
from array_api_compat import array_namespace

from preface.geometry.arrays import Array, on_cpu

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

# Newton needs 3 to 6 steps inside an ordinary image; the rest is for within 1e-6 of a fold or a pole.
NEWTON_STEPS = 32
# Residuals, in roundings of the arithmetic: of a solution (34 is the worst seen, next to folds), and of one
# that is not worth another step (1 is usual).
SOLVED_ROUNDINGS = 64
FINISHED_ROUNDINGS = 2

# Overflow, 0/0 and their like only arise in entries that are masked as invalid.
quietly = np.errstate(all="ignore")


class Distorted(NamedTuple):
    """A distorted point (x, y) and the symmetric Jacobian ((xx, xy), (xy, yy)) of the distortion there."""

    x: Array
    y: Array
    xx: Array
    xy: Array
    yy: Array


def distort(intrinsics: Array, x: Array, y: Array) -> Distorted:
    """Distort normalised points x, y [...] by lenses [..., 12]; the equation stands in the header."""
    p1, p2 = intrinsics[..., 6], intrinsics[..., 7]
    u = x * x + y * y
    radial, slope, _ = _radial(intrinsics, u)
    gain = radial + 2 * (p2 * x + p1 * y)
    return Distorted(
        x=gain * x + u * p2,
        y=gain * y + u * p1,
        xx=gain + 2 * slope * x * x + 4 * p2 * x,
        xy=2 * (slope * x * y + p1 * x + p2 * y),
        yy=gain + 2 * slope * y * y + 4 * p1 * y,
    )


def _radial(intrinsics: Array, u: Array) -> tuple[Array, Array, Array]:
    """Return the radial factor, its derivative by u, and its denominator, at squared radii u [...]."""
    k1, k2, k3, k4, k5, k6 = (intrinsics[..., i] for i in (4, 5, 8, 9, 10, 11))
    denominator = 1 + u * (k4 + u * (k5 + u * k6))
    radial = (1 + u * (k1 + u * (k2 + u * k3))) / denominator
    slope = (k1 + u * (2 * k2 + 3 * u * k3) - radial * (k4 + u * (2 * k5 + 3 * u * k6))) / denominator
    return radial, slope, denominator


@quietly
def project(intrinsics: Array, monotonic_radius: Array, points: Array) -> tuple[Array, Array]:
    """Project points in front of the camera.

    Args:
        intrinsics: [..., 12], focal lengths and principal point in pixels.
        monotonic_radius: [...], of these lenses, normalised units.
        points: [..., 3], camera frame (x right, y down, z forward), any unit.

    Returns:
        pixels [..., 2] with the top-left pixel's centre at (0.5, 0.5), NaN where not valid; valid [...].
    """
    xp = array_namespace(intrinsics, points)
    _, _, _, lens, valid = _at_points(intrinsics, monotonic_radius, points)
    fx, fy, cx, cy = (intrinsics[..., i] for i in range(4))
    pixels = xp.stack((fx * lens.x + cx, fy * lens.y + cy), axis=-1)
    return xp.where(valid[..., None], pixels, xp.nan), valid


@quietly
def projection_jacobians(intrinsics: Array, monotonic_radius: Array, points: Array) -> tuple[Array, Array]:
    """Differentiate `project`, whose arguments these are.

    Returns:
        d_pixels/d_point [..., 2, 3] and d_pixels/d_intrinsics [..., 2, 12]; NaN where `project` is not valid.
    """
    xp = array_namespace(intrinsics, points)
    x, y, z, lens, valid = _at_points(intrinsics, monotonic_radius, points)
    fx, fy = intrinsics[..., 0], intrinsics[..., 1]
    by_point = (
        (fx * lens.xx / z, fx * lens.xy / z, -fx * (lens.xx * x + lens.xy * y) / z),
        (fy * lens.xy / z, fy * lens.yy / z, -fy * (lens.xy * x + lens.yy * y) / z),
    )
    u = x * x + y * y
    radial, _, denominator = _radial(intrinsics, u)
    by_numerator = [u**i / denominator for i in (1, 2, 3)]
    by_coefficients = by_numerator + [-radial * term for term in by_numerator]  # k1 k2 k3, k4 k5 k6

    def row(affine: tuple, focal: Array, along: Array, by_p1: Array, by_p2: Array) -> tuple:
        k1, k2, k3, k4, k5, k6 = (focal * along * factor for factor in by_coefficients)
        return (*affine, k1, k2, focal * by_p1, focal * by_p2, k3, k4, k5, k6)

    zero, one = xp.zeros_like(u), xp.ones_like(u)
    by_intrinsics = (
        row((lens.x, zero, one, zero), fx, x, 2 * x * y, u + 2 * x * x),
        row((zero, lens.y, zero, one), fy, y, u + 2 * y * y, 2 * x * y),
    )
    keep = valid[..., None, None]
    return (
        xp.where(keep, _matrix(xp, by_point), xp.nan),
        xp.where(keep, _matrix(xp, by_intrinsics), xp.nan),
    )


@quietly
def unproject(intrinsics: Array, monotonic_radius: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Undistort pixels: invert `project` up to depth.

    Damped Newton from the radius at which the cubic lens with the same fold would see the pixel. It
    starts with the right square-root behaviour at the fold, hence converges there too.

    Args:
        intrinsics: [..., 12].
        monotonic_radius: [...], of these lenses.
        pixels: [..., 2], top-left pixel's centre at (0.5, 0.5).

    Returns:
        normalised [..., 2]: the point of the pixel's ray at depth 1; d_normalised/d_pixels [..., 2, 2];
        valid [...]. Pixels outside the image of the monotonic disc are not valid and NaN.
    """
    xp = array_namespace(intrinsics, pixels)
    fx, fy, cx, cy = (intrinsics[..., i] for i in range(4))
    target_x, target_y = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    x, y, lens, solved = _undistort(intrinsics, monotonic_radius, target_x, target_y)
    determinant = lens.xx * lens.yy - lens.xy * lens.xy
    jacobian = _matrix(
        xp,
        (
            (lens.yy / determinant / fx, -lens.xy / determinant / fy),
            (-lens.xy / determinant / fx, lens.xx / determinant / fy),
        ),
    )
    normalised = xp.where(solved[..., None], xp.stack((x, y), axis=-1), xp.nan)
    return normalised, xp.where(solved[..., None, None], jacobian, xp.nan), solved


def _undistort(
    intrinsics: Array, monotonic_radius: Array, target_x: Array, target_y: Array
) -> tuple[Array, Array, Distorted, Array]:
    """Solve distort(x, y) = target inside the monotonic disc: x, y, the lens there, and whether solved.

    Inside the disc this minimises a strictly convex function; halving a step that does not bring the
    residual down makes Newton's method safe, and there is only one point that it can converge to.
    """
    xp = array_namespace(intrinsics, target_x)
    target = xp.hypot(target_x, target_y)
    x, y = _starting_point(xp, intrinsics, monotonic_radius, target_x, target_y)
    lens = distort(intrinsics, x, y)
    step_x, step_y, residual = _newton_step(xp, lens, target_x, target_y)
    for _ in range(NEWTON_STEPS):
        # One rounding of the target, and one of (x, y) as the lens (of trace xx + yy) magnifies it.
        rounding = xp.finfo(target.dtype).eps * (target + (lens.xx + lens.yy) * xp.hypot(x, y))
        if on_cpu(residual) and not bool(xp.any(residual > FINISHED_ROUNDINGS * rounding)):
            break
        try_x, try_y = x + step_x, y + step_y
        try_lens = distort(intrinsics, try_x, try_y)
        try_step_x, try_step_y, try_residual = _newton_step(xp, try_lens, target_x, target_y)
        better = (try_residual < residual) & (xp.hypot(try_x, try_y) < monotonic_radius)
        x, y = xp.where(better, try_x, x), xp.where(better, try_y, y)
        lens = Distorted(*(xp.where(better, new, old) for new, old in zip(try_lens, lens, strict=True)))
        step_x = xp.where(better, try_step_x, step_x / 2)
        step_y = xp.where(better, try_step_y, step_y / 2)
        residual = xp.where(better, try_residual, residual)
    return x, y, lens, residual <= SOLVED_ROUNDINGS * rounding


def _newton_step(xp: Any, lens: Distorted, target_x: Array, target_y: Array) -> tuple[Array, Array, Array]:
    """Newton's step towards the target from where the lens was evaluated, and the residual's length."""
    error_x, error_y = target_x - lens.x, target_y - lens.y
    determinant = lens.xx * lens.yy - lens.xy * lens.xy
    step_x = (lens.yy * error_x - lens.xy * error_y) / determinant
    step_y = (lens.xx * error_y - lens.xy * error_x) / determinant
    return step_x, step_y, xp.hypot(error_x, error_y)


def _starting_point(
    xp: Any, intrinsics: Array, monotonic_radius: Array, target_x: Array, target_y: Array
) -> tuple[Array, Array]:
    """Undistort the target by the simplest lens that ends as the true one does.

    Where the distorted radius has a fold at R: r - r³/3R², scaled to reach it, whose inverse is
    2R sin(asin(q)/3) (the trigonometric root of a cubic). Where it has a pole: r/(1 - r²/R²), inverted
    by the quadratic formula. A lens that never ends starts from the distorted point itself.
    """
    ends = xp.isfinite(monotonic_radius)
    end = xp.where(ends, monotonic_radius, 1.0)
    radial, slope, _ = _radial(intrinsics, end * end)
    at_fold = radial + 2 * end * end * slope < radial
    target = xp.hypot(target_x, target_y)
    below_one = 1 - 4 * xp.finfo(target.dtype).eps
    before_fold = 2 * xp.sin(xp.asin(xp.clip(target / (end * radial), 0.0, below_one)) / 3)
    before_pole = 2 * (target / end) / (1 + xp.hypot(xp.ones_like(target), 2 * target / end))
    ratio = xp.where(at_fold, before_fold, before_pole) * end / target
    ratio = xp.where(ends & (target > 0), ratio, 1.0)
    return ratio * target_x, ratio * target_y


def _at_points(
    intrinsics: Array, monotonic_radius: Array, points: Array
) -> tuple[Array, Array, Array, Distorted, Array]:
    """Return x, y = (X, Y)/Z, depth Z, the lens there, and validity, of points [..., 3].

    Points that are not valid are replaced by one on the axis, to keep gradients of the others finite.
    """
    xp = array_namespace(intrinsics, points)
    z = xp.where(points[..., 2] > 0, points[..., 2], 1.0)
    x, y = points[..., 0] / z, points[..., 1] / z
    inside = (points[..., 2] > 0) & (xp.hypot(x, y) < monotonic_radius)
    x, y = xp.where(inside, x, 0.0), xp.where(inside, y, 0.0)
    lens = distort(intrinsics, x, y)
    return x, y, z, lens, inside & xp.isfinite(lens.x) & xp.isfinite(lens.y)


def _matrix(xp: Any, rows: tuple[tuple[Array, ...], ...]) -> Array:
    """Stack entries of one shape [...] into matrices [..., rows, columns]."""
    return xp.stack([xp.stack(xp.broadcast_arrays(*row), axis=-1) for row in rows], axis=-2)


@quietly
def monotonic_radius(intrinsics: np.ndarray) -> np.ndarray:
    """Find the largest disc on which each lens is known to be one-to-one.

    Without tangential distortion it ends where the distorted radius r·radial(r²) stops growing or the
    denominator vanishes: the usual fold. Tangential terms take at most 6|p|r off the eigenvalues of the
    Jacobian (exactly that in the direction of -p), so with them the disc ends at the first root of

        d(r·radial)/dr = 6|p|r    or    radial = 6|p|r    or    denominator = 0.

    Args:
        intrinsics: [..., 12].

    Returns:
        [...], normalised units; inf for a lens that never folds.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = np.moveaxis(np.asarray(intrinsics, dtype=np.float64)[..., 4:], -1, 0)
    tangential = 6 * np.hypot(p1, p2)
    # Measure r in units in which no coefficient exceeds 1, so that the roots are of moderate size.
    sizes = [np.abs(k) ** (1 / (2 * i)) for i, k in ((1, k1), (2, k2), (3, k3), (1, k4), (2, k5), (3, k6))]
    unit = np.max([*sizes, tangential], axis=0)
    safe = np.where(unit > 0, unit, 1.0)
    above, below = _in_units(safe, k1, k2, k3), _in_units(safe, k4, k5, k6)
    pull = np.stack([np.zeros_like(safe), tangential / safe], axis=-1)

    growth = _times(above * (1, 3, 5, 7), below) - _times(above, below * (0, 2, 4, 6))
    boundaries = (
        _minus(_in_radius(growth), _times(pull, _in_radius(_times(below, below)))),
        _minus(_in_radius(above), _times(pull, _in_radius(below))),
        _in_radius(below),
    )
    return np.min([_first_positive_root(b) for b in boundaries], axis=0) / safe


def _in_units(unit: np.ndarray, *coefficients: np.ndarray) -> np.ndarray:
    """Return the polynomial 1 + c1 u + c2 u² + ... of u = r² [..., n + 1] for r in units of 1/unit."""
    terms = [np.ones_like(unit)]
    for i, coefficient in enumerate(coefficients, start=1):
        for _ in range(2 * i):  # unit**6 might underflow
            coefficient = coefficient / unit
        terms.append(coefficient)
    return np.stack(terms, axis=-1)


def _in_radius(polynomial: np.ndarray) -> np.ndarray:
    """Rewrite coefficients [..., n] of powers of u = r² as coefficients [..., 2n - 1] of powers of r."""
    spread = np.zeros((*polynomial.shape[:-1], 2 * polynomial.shape[-1] - 1))
    spread[..., ::2] = polynomial
    return spread


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Multiply polynomials given by ascending coefficients."""
    product = np.zeros((*a.shape[:-1], a.shape[-1] + b.shape[-1] - 1))
    for i in range(a.shape[-1]):
        product[..., i : i + b.shape[-1]] += a[..., i, None] * b
    return product


def _minus(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Subtract polynomials given by ascending coefficients."""
    difference = np.zeros((*a.shape[:-1], max(a.shape[-1], b.shape[-1])))
    difference[..., : a.shape[-1]] += a
    difference[..., : b.shape[-1]] -= b
    return difference


def _first_positive_root(polynomial: np.ndarray) -> np.ndarray:
    """Return the smallest positive root [...] of 1 + c1 r + ... + cn r^n [..., n + 1], inf if there is none.

    The reciprocals of the roots are the eigenvalues of a companion matrix, whatever the true degree is.
    """
    degree = polynomial.shape[-1] - 1
    companion = np.zeros((*polynomial.shape[:-1], degree, degree))
    companion[..., 0, :] = -polynomial[..., 1:]
    companion[..., np.arange(1, degree), np.arange(degree - 1)] = 1
    roots = 1 / np.linalg.eigvals(companion).astype(complex)

    powers = np.arange(degree + 1)
    terms = polynomial[..., None, :] * roots.real[..., None] ** powers
    slopes = (terms * powers).sum(-1) / roots.real
    polished = roots.real - terms.sum(-1) / slopes
    # A double root (growth that only touches zero) comes out as a pair with imaginary parts of sqrt(eps).
    # Roots of high multiplicity at infinity come out as large numbers that solve nothing.
    is_root = (
        (np.abs(roots.imag) <= 1e-6 * np.abs(roots.real))
        & (roots.real > 0)
        & (np.abs(terms.sum(-1)) <= 1e-8 * np.abs(terms).sum(-1))
    )
    settled = np.abs(polished - roots.real) <= 1e-6 * np.abs(roots.real)
    return np.where(is_root, np.where(settled, polished, roots.real), np.inf).min(-1)
