"""Step functions along rays: dilation, resampling, annealing, and the bound that trains the proposals.

Shapes and meaning, kept throughout: a step function has edges `t` [..., n + 1], ascending along the last
axis, and on its n intervals either weights `w` [..., n], >= 0, that sum to at most 1, or densities `p`
[..., n], weights per length. Leading dimensions of the arguments agree.
"""

from __future__ import annotations

import torch
from torch import Tensor

from preface.model.safe_math import (
    FP32_EPS,
    enclosing_indices,
    full_precision,
    interpolate_sorted,
    log_of_weight,
)

UNBOUNDED = (-torch.inf, torch.inf)
_SHORTEST_INTERVAL = FP32_EPS**2  # multinerf's floor under the length that weights are divided by


def require_ascending(t: Tensor, name: str) -> None:
    """Refuse edges that are not in ascending order, or not numbers.

    Only where looking is free: on an accelerator it would make every step wait for the device.

    Raises:
        ValueError: the edges of some ray descend or are NaN.
    """
    if t.device.type != "cpu" or torch.compiler.is_compiling():
        return
    descending = ~(t[..., 1:] >= t[..., :-1])
    if descending.any():
        place = tuple(int(i) for i in descending.nonzero()[0])
        before, after = (float(t[(*place[:-1], place[-1] + k)]) for k in (0, 1))
        raise ValueError(f"{name}: edges must ascend, but {before} is followed by {after} at {place}")


@full_precision
def lossfun_outer(t: Tensor, w: Tensor, t_env: Tensor, w_env: Tensor, eps: float = FP32_EPS) -> Tensor:
    """Penalise weights that exceed their envelope (Mip-NeRF 360, equation 13).

    The envelope of an interval is the sum of the weights of all intervals of (t_env, w_env) that it
    overlaps; one that starts where the interval ends counts too, as in multinerf.

    Args:
        t, w: the histogram to be bounded, [..., n + 1] and [..., n].
        t_env, w_env: the bounding histogram, [..., m + 1] and [..., m].
        eps: added to the weight divided by.

    Returns:
        [..., n], max(0, w - envelope)^2 / (w + eps).

    Raises:
        ValueError: edges that do not ascend.
    """
    require_ascending(t, "t")
    require_ascending(t_env, "t_env")
    low, high = enclosing_indices(t_env, t)
    summed = torch.nn.functional.pad(torch.cumsum(w_env, dim=-1), (1, 0))
    envelope = summed.gather(-1, high[..., 1:]) - summed.gather(-1, low[..., :-1])
    excess = (w - envelope).clamp_min(0)
    return excess * (excess / (w + eps))  # squared first, 1e-20 would vanish


@full_precision
def max_dilate_weights(
    t: Tensor,
    w: Tensor,
    dilation: float,
    domain: tuple[float, float] = UNBOUNDED,
    renormalize: bool = False,
) -> tuple[Tensor, Tensor]:
    """Widen every interval on both sides, keeping its density, and take the highest where they overlap.

    The weights that come out bound those that went in, so that resampling also looks beside a surface
    (Mip-NeRF 360, supplement, "Dilation").

    Args:
        t, w: [..., n + 1], [..., n].
        dilation: added on each side, in units of t.
        domain: limits of the result, in units of t.
        renormalize: make the weights sum to one; all-zero weights stay zero.

    Returns:
        edges [..., 3 n + 1] and weights [..., 3 n].

    Raises:
        ValueError: edges that do not ascend.
    """
    require_ascending(t, "t")
    lengths = t[..., 1:] - t[..., :-1]
    starts, ends = t[..., :-1] - dilation, t[..., 1:] + dilation
    edges = torch.cat([t, starts, ends], dim=-1).sort(dim=-1).values.clamp(*domain)
    # Pieces that nothing covers, past the last end, have no length and so no weight.
    dilated = _sliding_max(w / lengths.clamp_min(_SHORTEST_INTERVAL), starts, ends, edges[..., :-1])
    weights = dilated * (edges[..., 1:] - edges[..., :-1])
    if renormalize:
        weights = weights / weights.sum(dim=-1, keepdim=True).clamp_min(_SHORTEST_INTERVAL)
    return edges, weights


def _sliding_max(p: Tensor, starts: Tensor, ends: Tensor, x: Tensor) -> Tensor:
    """Return the largest p[i] with starts[i] <= x < ends[i]; where there is none, one of them.

    Starts and ends ascend, so those i are a run of neighbours, and its maximum that of two power-of-two
    runs: n log n values per ray in place of the n^2 of comparing all with all.

    Args:
        p, starts, ends: [..., n].
        x: [..., m].
    """
    x = x.detach().contiguous()
    first = torch.searchsorted(ends.detach(), x, right=True)
    last = torch.searchsorted(starts.detach(), x, right=True)  # one past
    n = p.shape[-1]
    tables = [p]
    while 2 ** len(tables) <= n:
        run, shift = tables[-1], 2 ** (len(tables) - 1)
        tables.append(
            torch.cat([torch.maximum(run[..., :-shift], run[..., shift:]), run[..., -shift:]], dim=-1)
        )
    count = (last - first).clamp_min(1)
    exponent = torch.frexp(count.to(torch.float32)).exponent.to(torch.int64) - 1
    flat = torch.cat(tables, dim=-1)
    left = flat.gather(-1, exponent * n + first.clamp_max(n - 1))
    right = flat.gather(-1, exponent * n + (last - 2**exponent).clamp(0, n - 1))
    return torch.maximum(left, right)


def anneal_exponent(train_frac: float, slope: float = 10.0) -> float:
    """Power to which weights are raised before resampling (Mip-NeRF 360, section 3; Schlick's bias).

    From 0 (weights count for nothing) at train_frac 0, steeply, to 1 at the end; a slope of 0 switches
    annealing off.

    Args:
        train_frac: the fraction of training done, in [0, 1].
        slope: 10 in Mip-NeRF 360.
    """
    return slope * train_frac / ((slope - 1) * train_frac + 1) if slope > 0 else 1.0


@full_precision
def resampling_logits(t: Tensor, w: Tensor, anneal: float = 1.0) -> Tensor:
    """Logarithm of w^anneal, for `sample_intervals`; -inf where an interval has no weight or no length.

    Args:
        t, w: [..., n + 1], [..., n].
        anneal: see `anneal_exponent`. At 0 all intervals with weight and length count alike.

    Returns:
        [..., n].
    """
    usable = (t[..., 1:] > t[..., :-1]) & (w != 0)
    return torch.where(usable, anneal * log_of_weight(torch.where(usable, w, 1.0)), -torch.inf)


@full_precision
def invert_cdf(u: Tensor, t: Tensor, w_logits: Tensor) -> Tensor:
    """Find the places at which a step function has reached shares u of its mass.

    A ray without mass (every logit -inf) is taken as uniform over its length: nothing is known of it.

    Args:
        u: [..., m], ascending shares in [0, 1).
        t: [..., n + 1], edges.
        w_logits: [..., n], logarithms of the weights up to a constant, < inf.

    Returns:
        [..., m], ascending.
    """
    empty = (w_logits == -torch.inf).all(dim=-1, keepdim=True)
    lengths = t[..., 1:] - t[..., :-1]
    pointlike = (lengths == 0).all(dim=-1, keepdim=True)  # near = far: every share lies at the same place
    uniform = log_of_weight(torch.where(pointlike, 1.0, lengths.detach()))
    w = torch.softmax(torch.where(empty, uniform, w_logits), dim=-1)
    cdf = torch.cumsum(w, dim=-1)
    # Dividing by the last value, rather than setting it to one, leaves no mass to intervals without any.
    cdf = torch.nn.functional.pad((cdf / cdf[..., -1:]).clamp_max(1.0), (1, 0))
    return interpolate_sorted(u, cdf, t)


@full_precision
def sample_intervals(
    t: Tensor,
    w_logits: Tensor,
    num_samples: int,
    jitter: Tensor | None = None,
    domain: tuple[float, float] = UNBOUNDED,
) -> Tensor:
    """Draw intervals from a step function, shorter where it is higher (Mip-NeRF 360, section 3).

    The mass is cut into `num_samples` equal shares, one point taken of each, and intervals made that meet
    half way between points; the outermost reach as far beyond their point as within it, but not out of
    the domain. A single sample is the whole step function within the domain.

    Args:
        t: [..., n + 1], edges.
        w_logits: [..., n], see `resampling_logits`.
        num_samples: intervals per ray, >= 1.
        jitter: where in its share to take a point, in [0, 1): one number per ray [..., 1] or per sample
            [..., num_samples]. Without it the middle, and the result is a function of (t, w_logits).
        domain: limits of the result, in units of t.

    Returns:
        [..., num_samples + 1], ascending edges.

    Raises:
        ValueError: edges that do not ascend, or no samples asked for.
    """
    if num_samples < 1:
        raise ValueError(f"num_samples: {num_samples}; at least one interval is needed")
    require_ascending(t, "t")
    if num_samples == 1:
        return torch.cat([t[..., :1], t[..., -1:]], dim=-1).clamp(*domain)
    shares = torch.arange(num_samples, dtype=t.dtype, device=t.device)
    u = ((shares + (0.5 if jitter is None else jitter)) / num_samples).clamp_max(1 - FP32_EPS / 2)
    points = invert_cdf(u.expand(*t.shape[:-1], num_samples), t, w_logits)
    middles = (points[..., 1:] + points[..., :-1]) / 2
    first = (2 * points[..., :1] - middles[..., :1]).clamp_min(domain[0])
    last = (2 * points[..., -1:] - middles[..., -1:]).clamp_max(domain[1])
    return torch.cat([first, middles, last], dim=-1)
