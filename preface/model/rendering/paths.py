"""Where cameras go: orbits about a head.

Angles as a photographer has them: azimuth 0 is in front of the face, positive towards the subject's left;
elevation is positive above.
"""

from __future__ import annotations

import numpy as np

from preface.geometry import Camera, GeometryError, Rigid

UP = np.array([0.0, 1.0, 0.0])  # canonical frame


def look_at(center: np.ndarray, target: np.ndarray) -> Rigid:
    """The pose canonical_from_camera of an upright camera.

    Args:
        center: of the camera [3], canonical frame, metres.
        target: what it looks at [3].

    Raises:
        GeometryError: the two are one point, or one is above the other, so that nothing says what is upright.
    """
    center, target = np.asarray(center, np.float64), np.asarray(target, np.float64)
    forward = target - center
    right = np.cross(forward, UP)
    size = np.linalg.norm(right)
    if not size > 1e-9 * np.linalg.norm(forward):
        raise GeometryError(
            f"center: a camera at {center.tolist()} that looks at {target.tolist()} has no upright"
        )
    forward, right = forward / np.linalg.norm(forward), right / size
    return Rigid(np.stack([right, np.cross(forward, right), forward], axis=1), center)


def on_sphere(target: np.ndarray, azimuth: float, elevation: float, distance: float) -> Rigid:
    """The pose of a camera at angles (radians) and a distance (metres) from what it looks at [3].

    Raises:
        GeometryError: straight above or below, or the distance is not positive.
    """
    if not distance > 0:
        raise GeometryError(f"distance: {distance} is not positive")
    direction = [
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
        np.cos(elevation) * np.cos(azimuth),
    ]
    return look_at(target + distance * np.array(direction), target)


def orbit(target: np.ndarray, frames: int, distance: float, azimuth: float, elevation: float) -> list[Rigid]:
    """A closed path of cameras around what they look at: an ellipse of angles about the front.

    Args:
        target: [3], canonical frame, metres.
        frames: how many.
        distance: metres.
        azimuth, elevation: the ellipse's half axes, radians; an azimuth of pi or more is a full turn at constant
            height, with the elevation as its height.

    Raises:
        GeometryError: as `on_sphere`, or no frame.
    """
    if frames < 1:
        raise GeometryError(f"frames: {frames} is not positive")
    phase = 2 * np.pi * np.arange(frames) / frames
    if azimuth >= np.pi:
        return [on_sphere(target, angle, elevation, distance) for angle in phase]
    return [
        on_sphere(target, azimuth * np.sin(angle), elevation * np.cos(angle), distance) for angle in phase
    ]


def framing_camera(half_sides: np.ndarray, distance: float, width: int, height: int) -> Camera:
    """A pinhole for portraits: the middle of the box just fills the image's height, and its sides may be cut.

    Args:
        half_sides: of the box [3], metres.
        distance: of the camera from its centre, metres.
        width, height: pixels.

    Raises:
        GeometryError: the camera would stand inside the box's sphere.
    """
    radius = float(np.linalg.norm(half_sides))
    if distance <= radius:
        raise GeometryError(
            f"distance: a camera {distance:.3g} m from the middle of a box that reaches {radius:.3g} m stands "
            "inside it; move it away"
        )
    focal = height / 2 / float(half_sides[1]) * distance
    return Camera("PINHOLE", width, height, np.array([focal, focal, width / 2, height / 2]))
