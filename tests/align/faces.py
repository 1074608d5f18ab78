"""Faces of iBUG's 68 points whose canonical keypoints are known, and views of them."""

import numpy as np
from cameras_around import LENS

from preface.align.keypoints import CANONICAL_KEYPOINTS, IBUG68
from preface.align.landmarks import ViewLandmarks, box_around

# A face of 90 mm between the outer eye corners: right eye, left eye, nose, mouth, chin; metres.
FACE = np.array(
    [(-0.045, 0.03, 0.0), (0.045, 0.03, 0.0), (0.0, -0.01, 0.04), (0.0, -0.045, 0.02), (0.0, -0.085, 0.0)]
)
EYE_DISTANCE = 0.09


def landmarks(keypoints=FACE, seed=0):
    """68 points [68, 3] that are symmetric as a face is, with these keypoints [5, 3] among them."""
    points = np.random.default_rng(seed).uniform(-0.05, 0.05, (IBUG68.size, 3))
    mirrored = points[IBUG68.mirror] * (-1, 1, 1)
    points = (points + mirrored) / 2
    for name, place in zip(CANONICAL_KEYPOINTS, keypoints, strict=True):
        members = list(IBUG68.keypoints[name])
        points[members] = place
    return points


def view(points, pose, sigma=0.5, rng=None, camera=LENS):
    """What a camera sees of points [68, 3], with noise when there is a generator."""
    pixels, _ = camera.project(pose.apply(points))
    if rng is not None:
        pixels = pixels + rng.normal(0, sigma, pixels.shape)
    return of_pixels(pixels, sigma)


def of_pixels(pixels, sigma=0.5):
    seen = np.isfinite(pixels).all(-1)
    return ViewLandmarks(
        "ibug68", pixels, np.where(seen, sigma, np.nan), seen.astype(float), box_around(pixels)
    )


def views(points, poses, **options):
    return {f"cam{index:02d}": view(points, pose, **options) for index, pose in enumerate(poses)}


def flipped(found, width=LENS.width):
    """The same view found in the mirrored image."""
    pixels = found.pixels[IBUG68.mirror] * (-1, 1) + (width, 0)
    return of_pixels(pixels)


def swapped(found):
    """The same view with left and right landmarks exchanged."""
    return of_pixels(found.pixels[IBUG68.mirror])
