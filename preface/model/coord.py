"""From pieces of rays to what the networks see: frustums as Gaussians, their projection, the encodings.

Shapes: rays [...], intervals along a ray n, basis directions b. Positions are in scene units (canonical
metres times `scene_scale`); `t` is the ray parameter, in lengths of the direction, which need not be one.

The networks take the route `project_frustums` -> `integrated_pos_enc`. It is `conical_frustum_to_gaussian`
-> `lift_and_diagonalize` without the 3x3 covariances: the tests hold the two together.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from preface.model.safe_math import full_precision, normalize

_GOLDEN = (1 + math.sqrt(5)) / 2
_SHORTEST_DIRECTION = 1e-30  # squared; a direction shorter than 1e-15 counts as none


def icosahedron_basis(dtype: torch.dtype = torch.float32) -> Tensor:
    """Return the 21 unit directions [3, 21] on which positions are projected, one of each opposite pair.

    The six vertices and fifteen edge midpoints of an icosahedron (Mip-NeRF 360, supplement, "off-axis
    positional encoding"), in multinerf's order, so that its weights can be loaded.
    """
    g, s = _GOLDEN, _GOLDEN - 1  # g and 1/g
    rows = [
        (g, 0, 1), (g, 1, s), (1, g, 0), (2, 0, 0), (g, 1, -s), (g, 0, -1), (s, g, -1),
        (0, 1, -g), (1, s, -g), (0, 2, 0), (-1, g, 0), (-s, g, -1), (0, 1, g), (-s, g, 1),
        (s, g, 1), (1, s, g), (1, -s, g), (0, 0, 2), (-1, s, g), (-g, 1, s), (-g, 1, -s),
    ]  # fmt: skip
    directions = torch.tensor(rows, dtype=torch.float64)
    return (directions / directions.norm(dim=-1, keepdim=True)).T.to(dtype).contiguous()


@full_precision
def frustum_moments(t0: Tensor, t1: Tensor, base_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and variances of a uniform density in a conical frustum (Mip-NeRF, equation 7).

    Written in the ratio c of half width to midpoint, which lies in [0, 1]: neither thin and distant nor
    tiny frustums cancel, overflow or need a floor.

    Args:
        t0, t1: [..., n], 0 <= t0 <= t1, ray parameters of the ends.
        base_radius: [..., 1], radius of the cone at t = 1, in scene units.

    Returns:
        t_mean: [..., n], along the axis.
        t_var: [..., n], along the axis, in units of t squared.
        r_var: [..., n], across the axis, in each of the two directions, in scene units squared.
    """
    lag, t_var, r_var = _frustum_shape(t0, t1, base_radius)
    return (t0 + t1) / 2 + lag, t_var, r_var


def _frustum_shape(t0: Tensor, t1: Tensor, base_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How far the mean lies past the midpoint, and the variances, of `frustum_moments`."""
    middle, half = (t0 + t1) / 2, (t1 - t0) / 2
    c = half / middle.clamp_min(torch.finfo(middle.dtype).tiny)
    c2 = c * c
    lag = 2 * half * c / (3 + c2)
    t_var = half * half * (1 / 3 - (4 / 15) * c2 * (12 - c2) / (3 + c2) ** 2)
    radius = base_radius * middle
    return lag, t_var, radius * radius * (1 / 4 + (5 / 12) * c2 - (4 / 15) * c2 * c2 / (3 + c2))


@full_precision
def conical_frustum_to_gaussian(
    directions: Tensor, t0: Tensor, t1: Tensor, base_radius: Tensor, diag: bool = False
) -> tuple[Tensor, Tensor]:
    """Approximate frustums of cones from the origin by Gaussians (Mip-NeRF, equations 7 and 8).

    Args:
        directions: [..., 3], axes, of any length.
        t0, t1: [..., n], ray parameters of the ends.
        base_radius: [..., 1], radius at t = 1.
        diag: return only the diagonals of the covariances, as multinerf's argument of this name does.

    Returns:
        mean: [..., n, 3], relative to the ray's origin.
        cov: [..., n, 3, 3], or [..., n, 3] with `diag`.
    """
    t_mean, t_var, r_var = frustum_moments(t0, t1, base_radius)
    axis = normalize(directions, _SHORTEST_DIRECTION)
    mean = directions[..., None, :] * t_mean[..., None]
    if diag:
        along, across = directions * directions, 1 - axis * axis
        return mean, t_var[..., None] * along[..., None, :] + r_var[..., None] * across[..., None, :]
    along = directions[..., :, None] * directions[..., None, :]
    identity = torch.eye(3, dtype=axis.dtype, device=axis.device)
    across = identity - axis[..., :, None] * axis[..., None, :]
    cov = t_var[..., None, None] * along[..., None, :, :] + r_var[..., None, None] * across[..., None, :, :]
    return mean, cov


@full_precision
def lift_and_diagonalize(mean: Tensor, cov: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Project Gaussians on basis directions, keeping the variance along each.

    Args:
        mean: [..., 3].
        cov: [..., 3, 3].
        basis: [3, b], columns of length one.

    Returns:
        mean [..., b] and variance [..., b].
    """
    basis = basis.to(mean)
    columns = [_project(cov[..., row, :], basis) for row in range(3)]
    return _project(mean, basis), sum(basis[row] * columns[row] for row in range(3))  # type: ignore[return-value]


@full_precision
def project_frustums(
    origins: Tensor, directions: Tensor, tdist: Tensor, radii: Tensor, basis: Tensor
) -> tuple[Tensor, Tensor]:
    """Approximate the frustums between ray parameters by Gaussians and project these on basis directions.

    With p = b.d and q = |b x d|/|d|, constant along a ray, the mean is b.o + p t_mean and the variance
    p^2 t_var + q^2 r_var: the covariance is never formed, and the cross product keeps the variance of
    frustums that point along a basis direction free of cancellation, hence never negative.

    The mean is taken from the middle of the ray, found in float64 once per ray: seen from a camera far
    outside, b.o and p t_mean are large and cancel, and the encoding multiplies what is lost by 2048.

    Args:
        origins, directions: [..., 3], scene units.
        tdist: [..., n + 1], ascending ray parameters.
        radii: [..., 1], of the cones at t = 1.
        basis: [3, b].

    Returns:
        mean [..., n, b] and variance [..., n, b].
    """
    anchor, offset, t_var, r_var = frustums_about_anchor(tdist, radii)
    middle, along, across = (x[..., None, :] for x in project_axes(origins, directions, anchor, basis))
    mean = middle + offset[..., None] * along
    return mean, t_var[..., None] * (along * along) + r_var[..., None] * across


@full_precision
def frustums_about_anchor(tdist: Tensor, radii: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The part of `project_frustums` that belongs to intervals [..., n] and not to directions.

    Returns:
        anchor [..., 1], the middle of the ray; means less the anchor, variances along and across [..., n].
    """
    t0, t1 = tdist[..., :-1], tdist[..., 1:]
    lag, t_var, r_var = _frustum_shape(t0, t1, radii)
    anchor = (tdist[..., :1] + tdist[..., -1:]) / 2
    return anchor, ((t0 - anchor) + (t1 - anchor)) / 2 + lag, t_var, r_var


@full_precision
def project_axes(
    origins: Tensor, directions: Tensor, anchor: Tensor, basis: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The part of `project_frustums` that belongs to rays [...] and not to their intervals.

    Returns:
        b.(o + anchor d), b.d and |b x d|^2/|d|^2 for every direction b of the basis, [..., b].
    """
    basis = basis.to(origins)
    middle = _project(origins.double() + anchor.double() * directions.double(), basis.double()).to(basis)
    axis = normalize(directions, _SHORTEST_DIRECTION)
    across = torch.linalg.cross(axis[..., None, :], basis.T.expand(*axis.shape[:-1], -1, -1))
    return middle, _project(directions, basis), (across * across).sum(dim=-1)


def _project(vectors: Tensor, basis: Tensor) -> Tensor:
    """Inner products of vectors [..., 3] with columns [3, b]; no matrix product, which TF32 would round."""
    if basis.shape[0] != 3 or vectors.shape[-1] != 3:
        raise ValueError(
            f"vectors {tuple(vectors.shape)} cannot be projected on a basis {tuple(basis.shape)}; "
            "pass vectors [..., 3] and the basis as [3, directions]"
        )
    return vectors[..., :1] * basis[0] + vectors[..., 1:2] * basis[1] + vectors[..., 2:] * basis[2]


@full_precision
def integrated_pos_enc(mean: Tensor, var: Tensor, min_deg: int, max_deg: int) -> Tensor:
    """Expected sine and cosine of 2^l x for Gaussian x and l in [min_deg, max_deg) (Mip-NeRF, equation 14).

    Scaling by powers of two is exact and the cosine is taken as a cosine: a level adds no error to that of
    the mean. (sin(x + pi/2) in float32 loses 5e-4 at 1e4.)

    Args:
        mean: [..., b], finite.
        var: [..., b], >= 0; inf encodes as 0.
        min_deg, max_deg: the lowest level and one past the highest.

    Returns:
        [..., 2 L b] for L levels: all sines, level by level, then all cosines.
    """
    scales = powers_of_two(min_deg, max_deg, mean)
    angles = mean[..., None, :] * scales
    attenuation = torch.exp(-0.5 * (var[..., None, :] * (scales * scales)))
    return torch.cat([(attenuation * wave).flatten(-2) for wave in (angles.sin(), angles.cos())], dim=-1)


@full_precision
def pos_enc(x: Tensor, min_deg: int, max_deg: int, append_identity: bool = True) -> Tensor:
    """Encode values by sine and cosine of 2^l x for l in [min_deg, max_deg) (NeRF, equation 4).

    Args:
        x: [..., b], finite.
        min_deg, max_deg: the lowest level and one past the highest.
        append_identity: also return x itself, in front.

    Returns:
        [..., b + 2 L b], or [..., 2 L b] without the identity.
    """
    angles = (x[..., None, :] * powers_of_two(min_deg, max_deg, x)).flatten(-2)
    return torch.cat(
        [x, angles.sin(), angles.cos()] if append_identity else [angles.sin(), angles.cos()], dim=-1
    )


def powers_of_two(min_deg: int, max_deg: int, like: Tensor) -> Tensor:
    """2^l for l in [min_deg, max_deg), as a column [L, 1] to scale rows by."""
    if not 0 <= min_deg <= max_deg:
        raise ValueError(f"min_deg: levels from {min_deg} to {max_deg}; they must ascend from 0 or more")
    levels = torch.arange(min_deg, max_deg, device=like.device)
    # Shifted, because a GPU's exp2 may be two roundings off, which angles of 1e4 would show.
    return torch.bitwise_left_shift(torch.ones_like(levels), levels).to(like.dtype)[:, None]
