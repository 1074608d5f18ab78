"""What mapping finds: tracks of image points, and the cameras, poses and points that explain them."""

from dataclasses import dataclass, replace

import numpy as np

from preface.geometry import lens
from preface.geometry.cameras import Camera, stack_intrinsics
from preface.geometry.transforms import Rigid


@dataclass(frozen=True)
class Tracks:
    """M sightings of P points in N photographs.

    Attributes:
        camera_of_image: [N] index of each photograph's camera.
        image: [M] index of the photograph.
        point: [M] index of the point.
        pixels: [M, 2] float64, top-left pixel's centre at (0.5, 0.5).
    """

    camera_of_image: np.ndarray
    image: np.ndarray
    point: np.ndarray
    pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.image)

    def subset(self, mask: np.ndarray) -> "Tracks":
        """The sightings that a boolean mask [M] keeps; photographs and points keep their indices."""
        return replace(self, image=self.image[mask], point=self.point[mask], pixels=self.pixels[mask])


@dataclass(frozen=True)
class Structure:
    """Cameras, poses and points, up to one similarity transform.

    Attributes:
        cameras: the lenses; photographs may share one.
        camera_from_world: N poses, one batch.
        points: [P, 3] world.
    """

    cameras: tuple[Camera, ...]
    camera_from_world: Rigid
    points: np.ndarray

    def in_cameras(self, tracks: Tracks) -> np.ndarray:
        """The point of every sighting in its camera's frame, [M, 3]."""
        pose, points = self.camera_from_world, self.points[tracks.point]
        return np.einsum("mij,mj->mi", pose.rotation[tracks.image], points) + pose.translation[tracks.image]

    def reprojection_errors(self, tracks: Tracks) -> np.ndarray:
        """Distances in pixels [M] between sightings and projected points; inf where a point has no image."""
        intrinsics, radii = stack_intrinsics(self.cameras)
        camera = tracks.camera_of_image[tracks.image]
        pixels, valid = lens.project(intrinsics[camera], radii[camera], self.in_cameras(tracks))
        return np.where(valid, np.linalg.norm(pixels - tracks.pixels, axis=1), np.inf)

    def in_frame_of_image(self, image: int, scale: float) -> "Structure":
        """The same structure in the camera frame of one photograph, lengths multiplied by ``scale``."""
        pose = self.camera_from_world
        origin = Rigid(pose.rotation[image], pose.translation[image])
        moved = pose @ origin.inverse
        return Structure(
            self.cameras, Rigid(moved.rotation, scale * moved.translation), scale * origin.apply(self.points)
        )

    @property
    def centres(self) -> np.ndarray:
        """Camera centres in the world, [N, 3]."""
        return self.camera_from_world.inverse.translation


def rms(errors: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(errors**2)))
