"""What the detector gets wrong by direction, taken out of photographs whose poses are about known."""

from dataclasses import replace

import numpy as np

from preface.align.landmark_bias import LandmarkBias, expected_at
from preface.align.photos.face import FacePrior, keypoint_weights
from preface.align.photos.noise import Observations
from preface.align.photos.projection import Scene, project
from preface.geometry import Similarity


def corrected(
    observations: Observations, scene: Scene, face: FacePrior, bias: LandmarkBias | None
) -> Observations:
    """The landmarks as they were found, without the bias.

    Args:
        observations: of V views, as found.
        scene: V cameras and the coefficients of the face.
        face: whose coefficients they are.
        bias: None leaves everything as it is.
    """
    if bias is None:
        return observations
    points = face.points(scene.shape)
    right, left = (keypoint_weights() @ points)[:2]
    size = float(np.linalg.norm(left - right))
    centres = -np.einsum("vji,vj->vi", scene.rotation, scene.translations())
    expected = expected_at(bias, Similarity(np.array(size), np.eye(3), np.zeros(3)), points / size, centres)
    marked = np.concatenate(
        [
            project(scene.views(np.arange(len(centres)) == view), points + offsets)
            for view, offsets in enumerate(expected.offsets)
        ]
    )
    shifts = project(scene, points) - marked
    return replace(observations, image=observations.image + np.where(np.isfinite(shifts), shifts, 0.0))
