"""Made-up people and photographs of them: a face of the prior plus its own asymmetry, cameras on an arc, noise."""

from dataclasses import dataclass

import numpy as np

from preface.align.landmarks import ViewLandmarks, box_around
from preface.align.photos import PhotoView
from preface.align.photos.face import face_prior, keypoint_weights
from preface.geometry import Camera, Rigid

WIDTH, HEIGHT = 1200, 1600


@dataclass(frozen=True)
class Shoot:
    """A person [478, 3], the true cameras, and the photographs."""

    points: np.ndarray
    camera: Camera
    poses: list[Rigid]
    views: list[PhotoView]

    @property
    def keypoints(self) -> np.ndarray:
        return keypoint_weights() @ self.points

    @property
    def eyes(self) -> float:
        return float(np.linalg.norm(self.keypoints[0] - self.keypoints[1]))


def person(seed: int) -> np.ndarray:
    coefficients = np.random.default_rng(seed).normal(size=face_prior().basis.shape[-1])
    return face_prior().points(coefficients)


def shoot(
    azimuths: tuple[float, ...],
    seed: int = 0,
    focal: float = 0.8,
    distance: float = 0.5,
    noise: float = 0.5,
    exif: float | None = None,
) -> Shoot:
    """Photograph a person from azimuths in degrees; focal length in longer sides, distance in metres."""
    random = np.random.default_rng(seed + 1000)
    points = person(seed)
    params = np.array([focal * HEIGHT, focal * HEIGHT, WIDTH / 2, HEIGHT / 2])
    camera = Camera("PINHOLE", WIDTH, HEIGHT, params)
    poses, views = [], []
    for index, azimuth in enumerate(azimuths):
        pose = look(azimuth, random.uniform(-5, 5), distance, random.normal(0, 0.01, 2))
        pixels, valid = camera.project(pose.apply(points))
        assert valid.all()
        views.append(view(f"photo{index}", pixels + random.normal(0, noise, pixels.shape), noise, exif))
        poses.append(pose)
    return Shoot(points, camera, poses, views)


def view(name: str, pixels: np.ndarray, sigma: float = 0.5, exif: float | None = None) -> PhotoView:
    seen = np.isfinite(pixels).all(-1)
    marks = ViewLandmarks(
        scheme="facemesh478",
        pixels=pixels,
        sigma=np.where(seen, max(sigma, 0.1), np.nan),
        confidence=seen.astype(float),
        face_box=box_around(pixels) if seen.any() else np.full(4, np.nan),
    )
    return PhotoView(name, marks, WIDTH, HEIGHT, exif)


def look(azimuth: float, elevation: float, distance: float, aside: np.ndarray) -> Rigid:
    a, e = np.radians([azimuth, elevation])
    centre = distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    forward = -centre / distance
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Rigid(rotation, -rotation @ centre + [*aside, 0.0])
