"""Catmull-Clark subdivision, held against properties that the scheme is known to have."""

import numpy as np
import pytest

from synthetic_studio.subdivision import (
    adjacency_average,
    catmull_clark,
    subdivide_corner_uvs,
    triangulate,
    vertex_normals,
)

CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def grid(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 2] and quads [Q, 4] of a flat grid of unit squares."""
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1, 1)
    return np.c_[x.ravel(), y.ravel()], corner + np.array([[0, 1, columns + 2, columns + 1]])


def test_each_quad_becomes_four_and_every_vertex_is_used():
    fine = catmull_clark(CUBE_QUADS, len(CUBE))
    assert fine.quads.shape == (24, 4)
    assert fine.operator.shape == (8 + 12 + 6, 8)
    assert set(fine.quads.ravel()) == set(range(26))


def test_first_level_of_a_cube_has_the_published_positions():
    # Face points at the faces' centres, edge points at 3/4, corners at 5/9 of the cube's half side.
    fine = catmull_clark(CUBE_QUADS, len(CUBE)).operator @ CUBE
    radii = np.sort(np.round(np.linalg.norm(fine, axis=1), 9))
    corner, edge, face = np.sqrt(3) * 5 / 9, np.sqrt(2) * 0.75, 1.0
    np.testing.assert_allclose(radii, np.sort([corner] * 8 + [edge] * 12 + [face] * 6), atol=1e-9)


def test_subdivision_reproduces_affine_functions_away_from_corners():
    vertices, quads = grid(5, 4)
    level = catmull_clark(quads, len(vertices))
    rows = np.asarray(level.operator.sum(axis=1)).ravel()
    np.testing.assert_allclose(rows, 1.0, atol=1e-12)
    fine = level.operator @ vertices
    inside = ((fine > 1.2) & (fine < 2.8)).all(axis=1)
    assert inside.sum() > 5
    np.testing.assert_allclose(fine[inside] * 2, np.round(fine[inside] * 2), atol=1e-12)


def test_open_edges_stay_where_they_are():
    vertices, quads = grid(4, 4)
    fine = catmull_clark(quads, len(vertices)).operator @ vertices
    assert fine.min() == 0.0
    assert fine.max() == 4.0


def test_subdivided_uvs_follow_the_subdivided_faces():
    # In the middle of a flat grid the scheme is linear, so both must agree corner by corner.
    vertices, quads = grid(6, 5)
    level = catmull_clark(quads, len(vertices))
    corners = subdivide_corner_uvs(vertices[quads])
    positions = (level.operator @ vertices)[level.quads]
    middle = ((positions > 1.2) & (positions < 3.8)).all(axis=(1, 2))
    assert middle.sum() >= 16
    np.testing.assert_allclose(corners[middle], positions[middle], atol=1e-12)


@pytest.mark.parametrize("levels", [1, 2])
def test_normals_of_a_subdivided_cube_point_outwards(levels):
    vertices, quads = CUBE, CUBE_QUADS
    for _ in range(levels):
        level = catmull_clark(quads, len(vertices))
        vertices, quads = level.operator @ vertices, level.quads
    normals = vertex_normals(vertices, triangulate(quads))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    outward = (normals * vertices).sum(axis=1) / np.linalg.norm(vertices, axis=1)
    assert abs(outward).min() > 0.8
    assert len(set(np.sign(outward))) == 1


def test_averaging_over_neighbours_keeps_constants_and_contracts():
    triangles = triangulate(CUBE_QUADS)
    average = adjacency_average(triangles, len(CUBE))
    np.testing.assert_allclose(average @ np.ones(8), 1.0)
    values = np.arange(8.0)
    assert np.ptp(average @ values) < np.ptp(values)
