"""MediaPipe FaceMesh as an independent observer of the studio's images."""

from functools import cache
from typing import Any

import numpy as np

from preface.geometry import Rigid


def detect(image: np.ndarray) -> np.ndarray | None:
    """Return the 478 landmarks ``[478, 2]`` of the face in an RGB image, in pixels with the top-left centre at
    (0.5, 0.5), or None when FaceMesh finds no face.
    """
    result = _face_mesh().process(np.ascontiguousarray(image))
    if not result.multi_face_landmarks:
        return None
    height, width, _ = image.shape
    return np.array(
        [(point.x * width, point.y * height) for point in result.multi_face_landmarks[0].landmark]
    )


def look_at(azimuth: float, elevation: float, distance: float = 1.0) -> Rigid:
    """Return ``camera_from_studio`` of a camera that looks at the origin; angles in degrees, distance in metres."""
    a, e = np.radians([azimuth, elevation])
    centre = distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    forward = -centre / distance
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Rigid(rotation, -rotation @ centre)


@cache
def _face_mesh() -> Any:
    import mediapipe

    return mediapipe.solutions.face_mesh.FaceMesh(
        static_image_mode=True, max_num_faces=1, refine_landmarks=True, min_detection_confidence=0.5
    )
