"""The surface of a model as a triangle mesh: marching cubes on its density, then cleaned.

The surface is where a centimetre stops a share of the light that enters it, half by default. A field says nothing
about the inside of what no ray passes, so that it may be hollow or full of clutter there; only the largest connected
surface is kept.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from preface.artifacts import ArtifactError, write_bytes
from preface.model import coord, volume
from preface.model.model import PriorModel
from preface.model.rendering.image import Space
from preface.model.rendering.samples import encode_points

MESH_SUFFIXES = (".ply", ".glb", ".obj")
SURFACE_DEPTH = 0.01  # metres over which opacity at the surface is meant
SLAB_POINTS = 65_536  # positions that are evaluated together


@dataclass(frozen=True, eq=False)
class Field:
    """A model's density and colour at points, seen with the resolution of a voxel.

    Attributes:
        density: [n, 3] positions in scene units to [n] densities per scene unit.
        color: [n, 3] positions and [n, 3] directions of view, of length one, to [n, 3] colours in [0, 1].
    """

    density: Callable[[Tensor], Tensor]
    color: Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles.

    Attributes:
        vertices: float64 [n, 3], canonical frame, metres.
        triangles: int64 [m, 3], counter-clockwise as seen from outside.
        colors: float64 [n, 3], sRGB-encoded in [0, 1], as seen along the surface's normal.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray


def model_field(model: PriorModel, code: Tensor | None, voxel: float) -> Field:
    """The field of a model and a code [latent], None for one without codes, for voxels of a side in scene units.

    Positions are encoded as Gaussians with the variance of a voxel, side^2 / 12 along each axis.
    """
    one = None if code is None else code[None]

    def features(points: Tensor) -> tuple[Tensor, list[Tensor]]:
        biases = model.nerf.biases(one, None, 1)
        encoded = encode_points(points, voxel**2 / 12, model.basis, model.levels)
        return model.nerf.trunk(encoded, biases, model.products), biases

    def density(points: Tensor) -> Tensor:
        with torch.no_grad():
            found, biases = features(points)
            return volume.density_from_raw(model.nerf.raw_density(found, biases[len(model.nerf.layers)]))

    def color(points: Tensor, directions: Tensor) -> Tensor:
        with torch.no_grad():
            found, biases = features(points)
            view = coord.pos_enc(directions, 0, model.config.view_levels)
            bias = biases[len(model.nerf.layers) + 1].expand(len(points), -1)
            return volume.color_from_raw(model.nerf.raw_color(found, bias, view, model.products))

    return Field(density, color)


def extract_mesh(
    field: Field, space: Space, resolution: int, opacity: float = 0.5, device: torch.device | str = "cpu"
) -> Mesh:
    """Find the surface of a field inside the box.

    Args:
        field: for voxels of `voxel_side(space, resolution)`.
        space: of the model.
        resolution: voxels along the box's longest side.
        opacity: what a centimetre stops of the light at the surface, between 0 and 1.
        device: where the field computes.

    Raises:
        ValueError: the resolution is below 2, or there is no surface in the box.
    """
    import open3d as o3d

    if resolution < 2:
        raise ValueError(f"resolution: {resolution} is below 2")
    side = voxel_side(space, resolution)
    first = space.box.minimum * space.scale
    counts = np.ceil((space.box.maximum - space.box.minimum) * space.scale / side - 1e-9).astype(int) + 1
    # Optical depth of a centimetre, with a rim of nothing, so that the surface is closed at the box.
    depth = np.pad(_sampled(field, first, counts, side, device) * (SURFACE_DEPTH * space.scale), 1)
    # The logarithm is better behaved than the density, which spans decades.
    height = np.log(np.maximum(depth, 1e-6) / -math.log1p(-opacity)).astype(np.float32)
    surface = o3d.t.geometry.TriangleMesh.create_isosurfaces(o3d.core.Tensor(height), [0.0])
    legacy = surface.to_legacy()
    if len(legacy.triangles) == 0:
        raise ValueError("density: no surface in the box; the model is empty there")
    _keep_largest(legacy)
    vertices = first + (np.asarray(legacy.vertices) - 1) * side
    triangles = _outwards(vertices, np.asarray(legacy.triangles).astype(np.int64), field, side, device)
    colors = _colored(field, vertices, _normals(vertices, triangles), device)
    return Mesh(vertices / space.scale, triangles, colors)


def voxel_side(space: Space, resolution: int) -> float:
    """The side of a voxel in scene units, with `resolution` of them along the box's longest side."""
    return float((space.box.maximum - space.box.minimum).max()) * space.scale / resolution


def write_mesh(path: str | os.PathLike[str], mesh: Mesh) -> Path:
    """Write a mesh with its colours as PLY, GLB or OBJ, by the suffix; the write is atomic.

    Raises:
        ArtifactError: another suffix, or the disk refuses.
    """
    import trimesh

    path = Path(path)
    if path.suffix not in MESH_SUFFIXES:
        problem = f"'{path.suffix}' is not one of {', '.join(MESH_SUFFIXES)}"
        raise ArtifactError(path, "suffix", problem, "Choose one of them")
    colors = np.rint(mesh.colors * 255).astype(np.uint8)
    made = trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=colors, process=False)
    content: Any = made.export(file_type=path.suffix[1:])  # text for OBJ, bytes for the others
    return write_bytes(path, content.encode() if isinstance(content, str) else content)


def _sampled(
    field: Field, first: np.ndarray, counts: np.ndarray, side: float, device: torch.device | str
) -> np.ndarray:
    """Densities [z, y, x] at the corners of all voxels."""
    nx, ny, nz = counts.tolist()
    x, y = (torch.arange(n, dtype=torch.float64) * side + f for n, f in zip((nx, ny), first[:2], strict=True))
    layer = torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], dim=-1).reshape(-1, 2)
    out = np.empty((nz, ny * nx), np.float32)
    for level in range(nz):
        z = torch.full((len(layer), 1), first[2] + level * side, dtype=torch.float64)
        out[level] = _in_slabs(field.density, torch.cat([layer, z], dim=1), device=device).numpy()
    return out.reshape(nz, ny, nx)


def _in_slabs(
    evaluate: Callable[..., Tensor], *points: Tensor | np.ndarray, device: torch.device | str
) -> Tensor:
    """A function of points and what belongs to them, each [n, 3], some at a time; on the CPU."""
    slabs = zip(*(torch.as_tensor(values).float().split(SLAB_POINTS) for values in points), strict=True)
    return torch.cat([evaluate(*(part.to(device) for part in slab)).cpu() for slab in slabs])


def _keep_largest(mesh: object) -> None:
    """Remove all but the connected surface with the largest area, and vertices that nothing uses."""
    clusters, _, areas = (np.asarray(part) for part in mesh.cluster_connected_triangles())  # type: ignore[attr-defined]
    mesh.remove_triangles_by_mask(clusters != int(np.argmax(areas)))  # type: ignore[attr-defined]
    mesh.remove_unreferenced_vertices()  # type: ignore[attr-defined]


def _outwards(
    vertices: np.ndarray, triangles: np.ndarray, field: Field, side: float, device: torch.device | str
) -> np.ndarray:
    """Turn all triangles round if more of them face what is dense than what is empty."""
    step = _normals(vertices, triangles) * side
    ahead, behind = (_in_slabs(field.density, vertices + sign * step, device=device) for sign in (1, -1))
    return triangles[:, ::-1].copy() if bool((ahead > behind).double().mean() > 0.5) else triangles


def _normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Normals of vertices [n, 3], weighted by area."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(total, triangles[:, i], face)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.divide(total, length, out=np.zeros_like(total), where=length > 0)


def _colored(
    field: Field, vertices: np.ndarray, normals: np.ndarray, device: torch.device | str
) -> np.ndarray:
    """Colours of vertices as seen straight on."""
    colors = _in_slabs(field.color, vertices, -normals, device=device)
    return np.clip(colors.double().numpy(), 0, 1)
