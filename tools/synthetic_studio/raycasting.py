"""Triangles that rays are cast at: the one way in which the studio fills open3d's scene."""

from collections.abc import Sequence

import numpy as np
import open3d as o3d


def raycasting_scene(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> o3d.t.geometry.RaycastingScene:
    """Fill a scene with meshes: vertices ``[V, 3]`` and triangles ``[T, 3]``; part k is its geometry k.

    One thread: the worker processes are as many as the cores.
    """
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for vertices, triangles in parts:
        scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    return scene
