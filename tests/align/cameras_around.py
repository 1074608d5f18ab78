"""Cameras on arcs around the origin with real lenses, and what they see of points."""

import numpy as np

from preface.capture.rig import Rig, RigCamera
from preface.geometry import Camera, Rigid, Views

SIZE = (1024, 1536)
LENS = Camera("OPENCV", *SIZE, np.array([3550.0, 3548.0, 517.0, 760.0, -0.08, 0.03, 4e-4, -3e-4]))


def looking_at_origin(azimuth, elevation=0.0, distance=1.0):
    """camera_from_rig of a camera at angles in degrees, to the left of and above a face that looks along z."""
    azimuth, elevation = np.radians([azimuth, elevation])
    back = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    right = np.cross(-back, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return Rigid(np.stack([right, np.cross(-back, right), -back]), np.array([0.0, 0.0, distance]))


def arc(count, reach=60.0):
    """Poses from the far right to the far left of the face, alternately above and below."""
    return [
        looking_at_origin(azimuth, 15 * (-1) ** i)
        for i, azimuth in enumerate(np.linspace(-reach, reach, count))
    ]


def stack(poses, camera=LENS):
    return Views.stack([camera] * len(poses), [pose.inverse for pose in poses])


def rig(poses, camera=LENS):
    return Rig("take00", {f"cam{i:02d}": RigCamera.at(camera, pose) for i, pose in enumerate(poses)})


def see(points, poses, camera=LENS):
    """Pixels [P, V, 2] of points [P, 3], without noise."""
    return np.stack([camera.project(pose.apply(points))[0] for pose in poses], axis=1)


def information(points, poses, used, sigma, camera=LENS):
    """The inverse of the Cramer-Rao bound [P, 3, 3], from the Jacobians of the camera model view by view."""
    total = np.zeros((len(points), 3, 3))
    for index, pose in enumerate(poses):
        jacobian = camera.projection_jacobians(pose.apply(points))[0] @ pose.rotation
        total += np.where(used[:, index, None, None], np.swapaxes(jacobian, 1, 2) @ jacobian, 0) / sigma**2
    return total
