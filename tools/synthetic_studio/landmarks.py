"""True positions of facial landmarks: the five canonical keypoints and FaceMesh's points on the surface.

The places of FaceMesh's indices on the template come from `tools/locate_facemesh_landmarks.py`; an
identity's own positions are exact, since the table follows its surface.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np

from synthetic_studio.eyes import Eyeball
from synthetic_studio.regions import SurfacePoints
from synthetic_studio.template import HeadTemplate

FACEMESH_TABLE = Path(__file__).parent / "facemesh_on_template.json"
# FaceMesh's indices of the canonical keypoints; several are averaged.
KEYPOINT_INDICES = {
    "right_eye_outer": (33,),
    "left_eye_outer": (263,),
    "nose_tip": (1,),
    "mouth_center": (13, 14),
    "chin": (152,),
}
IRIS_INDICES = {"right": 468, "left": 473}


def facemesh_landmarks(
    fine: np.ndarray, template: HeadTemplate, eyeballs: dict[str, Eyeball]
) -> dict[str, np.ndarray]:
    """Return FaceMesh's points on one head: names "0" to "467" on the skin, "468" and "473" at the irises.

    Args:
        fine: ``[V, 3]`` vertices of the finest skin.
        template: The head template.
        eyeballs: Right and left eyeball.

    Returns:
        Positions ``[3]`` by FaceMesh index, in the frame of ``fine``.
    """
    points = _facemesh_points().at(fine, template.triangles)
    found = {str(index): point for index, point in enumerate(points)}
    for side, index in IRIS_INDICES.items():
        found[str(index)] = eyeballs[side].centre + eyeballs[side].radius * eyeballs[side].gaze
    return found


def keypoints(landmarks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the five canonical keypoints ``[3]`` by name from FaceMesh's points."""
    return {
        name: np.mean([landmarks[str(index)] for index in indices], axis=0)
        for name, indices in KEYPOINT_INDICES.items()
    }


@cache
def _facemesh_points() -> SurfacePoints:
    rows = json.loads(FACEMESH_TABLE.read_text())["landmarks"]
    return SurfacePoints(
        np.array([row["triangle"] for row in rows]), np.array([row["weights"] for row in rows])
    )
