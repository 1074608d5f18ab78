"""Catmull-Clark subdivision as a sparse linear operator.

The topology of the head never changes, only its vertices do, so one level of subdivision is one
matrix (Catmull and Clark, 1978) that is built once and applied to every identity.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp


class Subdivision(NamedTuple):
    """One level of Catmull-Clark subdivision.

    Attributes:
        operator: Sparse ``[new_vertices, vertices]``; fine positions are ``operator @ positions``.
        quads: ``[4 * quads, 4]`` vertex indices of the fine mesh.
    """

    operator: sp.csr_matrix
    quads: np.ndarray


def catmull_clark(quads: np.ndarray, vertex_count: int) -> Subdivision:
    """Return one subdivision level of a quad mesh, with the smooth-boundary rule on open edges.

    Args:
        quads: ``[Q, 4]`` vertex indices, consistently wound.
        vertex_count: Number of vertices; all of them are kept, in order, as the first rows.

    Fine vertices are ordered: old vertices, edge points, face points.
    """
    face_count = len(quads)
    corners = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, edge_of_corner = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
    edge_of_corner = edge_of_corner.reshape(face_count, 4)
    edge_count = len(edges)
    faces_of_edge = np.bincount(edge_of_corner.ravel(), minlength=edge_count)
    boundary = faces_of_edge == 1

    face_points = _average(np.arange(face_count).repeat(4), quads.ravel(), face_count, vertex_count)
    midpoints = _average(np.arange(edge_count).repeat(2), edges.ravel(), edge_count, vertex_count)
    edge_faces = _average(edge_of_corner.ravel(), np.arange(face_count).repeat(4), edge_count, face_count)
    # Interior edge point: mean of the two ends and the two face points.
    smooth = 0.5 * midpoints + 0.5 * (edge_faces @ face_points)
    edge_points = _select(boundary, midpoints, smooth)

    vertex_points = _vertex_points(quads, edges, boundary, face_points, midpoints, vertex_count)
    operator = sp.vstack([vertex_points, edge_points, face_points]).tocsr()

    e = edge_of_corner + vertex_count
    centre = np.repeat((np.arange(face_count) + vertex_count + edge_count)[:, None], 4, axis=1)
    fine = np.stack([quads, e, centre, np.roll(e, 1, axis=1)], axis=-1)
    return Subdivision(operator, fine.reshape(-1, 4))


def subdivide_corner_uvs(corner_uvs: np.ndarray) -> np.ndarray:
    """Subdivide per-corner texture coordinates ``[Q, 4, 2]`` linearly to ``[4 * Q, 4, 2]``.

    Corners keep their seams, and linear interpolation keeps the texture where its author painted it.
    The order of faces and corners is that of :func:`catmull_clark`.
    """
    after = 0.5 * (corner_uvs + np.roll(corner_uvs, -1, axis=1))
    before = np.roll(after, 1, axis=1)
    centre = np.broadcast_to(corner_uvs.mean(axis=1, keepdims=True), corner_uvs.shape)
    return np.stack([corner_uvs, after, centre, before], axis=2).reshape(-1, 4, 2)


def triangulate(quads: np.ndarray) -> np.ndarray:
    """Split quads ``[Q, 4]`` into triangles ``[2 * Q, 3]``: triangles ``2 * q`` and ``2 * q + 1`` per quad."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return area-weighted unit normals ``[V, 3]``; isolated vertices get a zero normal."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    incidence = sp.csr_matrix(
        (np.ones(triangles.size), (triangles.ravel(), np.arange(len(triangles)).repeat(3))),
        shape=(len(vertices), len(triangles)),
    )
    normals = incidence @ face
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def adjacency_average(triangles: np.ndarray, vertex_count: int) -> sp.csr_matrix:
    """Return the sparse operator that replaces each vertex value by the mean over itself and its neighbours."""
    i = triangles[:, [0, 1, 2]].ravel()
    j = triangles[:, [1, 2, 0]].ravel()
    own = np.arange(vertex_count)
    rows, columns = np.concatenate([i, j, own]), np.concatenate([j, i, own])
    ones = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(vertex_count, vertex_count))
    ones.data[:] = 1.0
    return sp.diags(1.0 / np.asarray(ones.sum(axis=1)).ravel()) @ ones


def _average(rows: np.ndarray, columns: np.ndarray, row_count: int, column_count: int) -> sp.csr_matrix:
    counts = np.bincount(rows, minlength=row_count)
    weights = 1.0 / np.maximum(counts, 1)[rows]
    return sp.csr_matrix((weights, (rows, columns)), shape=(row_count, column_count))


def _select(mask: np.ndarray, where_true: sp.csr_matrix, where_false: sp.csr_matrix) -> sp.csr_matrix:
    return sp.diags(mask.astype(float)) @ where_true + sp.diags((~mask).astype(float)) @ where_false


def _vertex_points(
    quads: np.ndarray,
    edges: np.ndarray,
    boundary: np.ndarray,
    face_points: sp.csr_matrix,
    midpoints: sp.csr_matrix,
    vertex_count: int,
) -> sp.csr_matrix:
    face_count, edge_count = len(quads), len(edges)
    identity = sp.identity(vertex_count, format="csr")
    around_faces = _average(quads.ravel(), np.arange(face_count).repeat(4), vertex_count, face_count)
    around_edges = _average(edges.ravel(), np.arange(edge_count).repeat(2), vertex_count, edge_count)
    valence = np.maximum(np.bincount(edges.ravel(), minlength=vertex_count), 1)
    interior = (
        sp.diags(1.0 / valence) @ (around_faces @ face_points)
        + sp.diags(2.0 / valence) @ (around_edges @ midpoints)
        + sp.diags((valence - 3.0) / valence) @ identity
    )
    rim = edges[boundary]
    rim_edges = np.flatnonzero(boundary)
    rim_average = _average(rim.ravel(), rim_edges.repeat(2), vertex_count, edge_count)
    # Cubic B-spline along the boundary: 6/8 of the vertex and 1/8 of each neighbour on the rim.
    open_rule = 0.5 * identity + 0.5 * (rim_average @ midpoints)
    on_rim = np.zeros(vertex_count, dtype=bool)
    on_rim[rim.ravel()] = True
    isolated = np.bincount(quads.ravel(), minlength=vertex_count) == 0
    return _select(isolated, identity, _select(on_rim, open_rule, interior))
