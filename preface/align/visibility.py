"""Which landmarks of FaceMesh the head itself hides, from the relative depth that comes with them.

The points of the skin are the corners of a mesh. A landmark is seen where the mesh faces the camera, and no
triangle lies in front of it.
"""

from functools import cache

import numpy as np

from preface.align.keypoints import FACEMESH_SKIN

# The cosine between the normal and the direction to the camera at which a landmark counts as hidden and as
# seen in full; FaceMesh's depth is too coarse for a sharp border.
GRAZING, FACING = 0.0, 0.35
# A triangle hides a landmark when it lies this part of the face's width in front of it.
OCCLUDING_GAP = 0.03
# The irises lie within the rims of the eyes, whose normals they borrow: centre and rim of each.
_EYE_RIMS = {
    468: (33, 133, 159, 145, 158, 153, 160, 144),
    473: (263, 362, 386, 374, 385, 380, 387, 373),
}


def facing(points: np.ndarray) -> np.ndarray:
    """The cosine [478] between the normal of each landmark and the direction to the camera.

    Args:
        points: [478, 3] landmarks of FaceMesh: x right, y down, z away from the camera, one unit for all.
    """
    triangles = mesh_triangles()
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # by area
    total = np.zeros((FACEMESH_SKIN, 3))
    for corner in range(3):
        np.add.at(total, triangles[:, corner], normals)
    length = np.maximum(np.linalg.norm(total, axis=1), np.finfo(float).tiny)
    cosine = np.empty(len(points))
    cosine[:FACEMESH_SKIN] = -total[:, 2] / length
    for centre, rim in _EYE_RIMS.items():
        cosine[centre : centre + 5] = cosine[list(rim)].mean()
    return cosine


def visibility(points: np.ndarray) -> np.ndarray:
    """How well each landmark is seen, [478] from 0 (hidden by the head) to 1.

    Args:
        points: as for `facing`.
    """
    seen = np.clip((facing(points) - GRAZING) / (FACING - GRAZING), 0.0, 1.0)
    return np.where(_covered(points), 0.0, seen)


def _covered(points: np.ndarray) -> np.ndarray:
    """Bool [478]: whether a triangle lies clearly in front of the landmark."""
    triangles = mesh_triangles()
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    flat = np.abs(area) < np.finfo(float).tiny
    area = np.where(flat, 1.0, area)
    to_point = points[:, None, :2] - a[:, :2]  # [478, T, 2]
    u = (to_point[..., 0] * ac[:, 1] - to_point[..., 1] * ac[:, 0]) / area
    v = (ab[:, 0] * to_point[..., 1] - ab[:, 1] * to_point[..., 0]) / area
    inside = (u > 0) & (v > 0) & (u + v < 1) & ~flat
    depth = a[:, 2] + u * ab[:, 2] + v * ac[:, 2]
    width = np.ptp(points[:FACEMESH_SKIN, :2], axis=0).max()
    return (inside & (depth < points[:, None, 2] - OCCLUDING_GAP * width)).any(1)


@cache
def mesh_triangles() -> np.ndarray:
    """The triangles [T, 3] of FaceMesh's skin, all turned alike: normals point out of the face.

    MediaPipe ships the edges; three that close are a triangle. The holes at eyes and mouth have more corners.
    """
    from mediapipe.python.solutions.face_mesh_connections import FACEMESH_TESSELATION

    neighbours: dict[int, set[int]] = {index: set() for index in range(FACEMESH_SKIN)}
    for first, second in FACEMESH_TESSELATION:
        neighbours[first].add(second)
        neighbours[second].add(first)
    loose = {
        tuple(sorted((a, b, c)))
        for a in neighbours
        for b in neighbours[a]
        for c in neighbours[a] & neighbours[b]
    }
    by_edge: dict[frozenset[int], list[tuple[int, ...]]] = {}
    for triangle in loose:
        for skipped in range(3):
            by_edge.setdefault(frozenset(triangle) - {triangle[skipped]}, []).append(triangle)
    return np.array(_turned_alike(loose, by_edge))


def _turned_alike(
    loose: set[tuple[int, ...]], by_edge: dict[frozenset[int], list[tuple[int, ...]]]
) -> list[tuple[int, ...]]:
    """Neighbouring triangles run along their common edge in opposite directions."""
    # The right eye's outer corner, the skin above it, the skin outwards: in an image, whose y points down,
    # anticlockwise, which makes the cross product of the edges point towards the camera.
    start = (33, 247, 130)
    turned = {tuple(sorted(start)): start}
    waiting = [start]
    while waiting:
        triangle = waiting.pop()
        for first, second in zip(triangle, (*triangle[1:], triangle[0]), strict=True):
            for other in by_edge[frozenset((first, second))]:
                if other not in turned:
                    (third,) = set(other) - {first, second}
                    turned[other] = (second, first, third)
                    waiting.append(turned[other])
    return sorted(turned.values())
