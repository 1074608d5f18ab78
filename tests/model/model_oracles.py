"""Slow, obvious references for the model's functions: loops in float64, and mpmath where that overflows.

Each is written from the definition, for one ray, and shares nothing with what it checks.
"""

import itertools
from collections.abc import Sequence

import mpmath
import numpy as np
from mpmath import mpf

mpmath.mp.dps = 60


def frustum_moments(t0: float, t1: float, radius: float) -> tuple[float, float, float]:
    """Moments of the uniform density in a cone's frustum: integrals of t^k weighted with the area ~ t^2."""
    if t0 == t1:
        return t0, 0.0, t0 * t0 * radius * radius / 4
    mean, along, across = _exact_moments(mpf(t0), mpf(t1), mpf(radius))
    return float(mean), float(along), float(across)


def _exact_moments(a: mpf, b: mpf, r: mpf) -> tuple[mpf, mpf, mpf]:
    volume = (b**3 - a**3) / 3
    mean = (b**4 - a**4) / 4 / volume
    second = (b**5 - a**5) / 5 / volume
    # Across: a disc of radius r t has variance (r t)^2 / 4 in each direction.
    return mean, second - mean * mean, r * r * second / 4


def frustum_slopes(t0: float, t1: float, radius: float) -> list[tuple[float, float]]:
    """Derivatives of the three moments by t0 and by t1, by central differences at 60 digits."""
    if t0 == t1:
        # The limit of a disc: its mean is the midpoint, it has no length to change at first order.
        return [(0.5, 0.5), (0.0, 0.0), (t0 * radius**2 / 4,) * 2]
    step = (mpf(t1) - mpf(t0)) * mpf(10) ** -15
    exact = []
    for moment in range(3):
        ends = [(mpf(t0) + i * step, mpf(t1) + j * step) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        values = [_exact_moments(a, b, mpf(radius))[moment] for a, b in ends]
        slopes = (values[0] - values[1]) / (2 * step), (values[2] - values[3]) / (2 * step)
        exact.append((float(slopes[0]), float(slopes[1])))
    return exact


def projected_gaussian(origin, direction, t0, t1, radius, basis) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance along basis columns [3, b], by the full covariance matrix at 60 digits."""
    o, d = ([mpf(float(x)) for x in v] for v in (origin, direction))
    t_mean, t_var, r_var = (mpf(x) for x in frustum_moments(float(t0), float(t1), float(radius)))
    squared = sum(x * x for x in d)
    means, variances = [], []
    for column in np.asarray(basis).T:
        b = [mpf(float(x)) for x in column]
        along = sum(x * y for x, y in zip(b, d, strict=True))
        means.append(sum(x * y for x, y in zip(b, o, strict=True)) + t_mean * along)
        variances.append(t_var * along**2 + r_var * (sum(x * x for x in b) - along**2 / squared))
    return np.array(means, dtype=np.float64), np.array(variances, dtype=np.float64)


def expected_waves(mean: float, var: float, level: int) -> tuple[float, float]:
    """E[sin 2^l x] and E[cos 2^l x] for x ~ N(mean, var)."""
    if np.isinf(var):
        return 0.0, 0.0
    shrink = mpmath.exp(-mpf(var) * mpf(4) ** level / 2)
    angle = mpf(mean) * mpf(2) ** level
    return float(shrink * mpmath.sin(angle)), float(shrink * mpmath.cos(angle))


def alpha_weights(
    density: Sequence[float], lengths: Sequence[float], cost: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Weights of one ray, and the derivative of sum(cost * weights) by each density."""
    depth = [mpf(s) * mpf(x) if x > 0 else mpf(0) for s, x in zip(density, lengths, strict=True)]
    reaching = [mpmath.exp(-sum(depth[:k], mpf(0))) for k in range(len(depth) + 1)]
    # By expm1: 60 digits are not enough to subtract 1e-83 from one.
    weights = [-mpmath.expm1(-x) * t for x, t in zip(depth, reaching, strict=False)]
    gradient = []
    for j, length in enumerate(lengths):
        behind = sum((mpf(c) * w for c, w in zip(cost[j + 1 :], weights[j + 1 :], strict=True)), mpf(0))
        gradient.append(mpf(length) * (mpf(cost[j]) * reaching[j + 1] - behind))
    return np.array(weights, dtype=np.float64), np.array(gradient, dtype=np.float64)


def density(raw: float) -> tuple[float, float]:
    """softplus(raw - 1) and its derivative."""
    x = mpf(raw) - 1
    return float(mpmath.log1p(mpmath.exp(x))), float(1 / (1 + mpmath.exp(-x)))


def outer_loss(t, w, t_env, w_env, eps) -> np.ndarray:
    """For each interval, collect the envelope's intervals that it meets, then the half-quadratic penalty."""
    losses = []
    for start, end, weight in zip(t[:-1], t[1:], w, strict=True):
        # An interval counts if it ends after the start and begins at or before the end, as in multinerf.
        pieces = zip(t_env[:-1], t_env[1:], w_env, strict=True)
        envelope = sum(float(v) for a, b, v in pieces if b > start and a <= end and b > a)
        losses.append(max(0.0, float(weight) - envelope) ** 2 / (float(weight) + eps))
    return np.array(losses)


def dilated(t, w, dilation, domain) -> tuple[np.ndarray, np.ndarray]:
    """Density at each place as the largest of the widened intervals that cover it; then its integral."""
    lengths = np.diff(t)
    p = w / np.maximum(lengths, np.finfo(np.float32).eps ** 2)
    starts, ends = t[:-1] - dilation, t[1:] + dilation
    edges = np.clip(np.sort(np.concatenate([t, starts, ends])), *domain)
    weights = []
    for left, right in itertools.pairwise(edges):
        covering = [p[i] for i in range(len(p)) if starts[i] <= left < ends[i]]
        weights.append(max(covering, default=0.0) * (right - left))
    return edges, np.array(weights)


def places_of_shares(u, t, w) -> np.ndarray:
    """Walk along the step function until each share of its mass has been passed."""
    total, places = float(np.sum(w)), []
    for share in u:
        passed = 0.0
        for start, end, weight in zip(t[:-1], t[1:], w, strict=True):
            mass = float(weight) / total
            if share < passed + mass:
                places.append(start + (end - start) * (share - passed) / mass)
                break
            passed += mass
    return np.array(places)


def intervals(t, w, num_samples, domain) -> np.ndarray:
    """Points at the middle of equal shares, edges half way between them, mirrored at the ends."""
    points = places_of_shares((np.arange(num_samples) + 0.5) / num_samples, t, w)
    middles = (points[1:] + points[:-1]) / 2
    first = max(domain[0], 2 * points[0] - middles[0])
    last = min(domain[1], 2 * points[-1] - middles[-1])
    return np.concatenate([[first], middles, [last]])
