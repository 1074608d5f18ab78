"""What calibration works on: which point of a board was seen where, by which camera, at which instant.

Observations do not say how they were made. A detector's corners, corners that another program wrote to
``corners.json``, and the projections of a simulation are all the same to the solver.
"""

from dataclasses import dataclass, field, replace

import numpy as np


class ObservationError(ValueError):
    """Arrays that cannot be observations; the message says the field, the problem and the remedy."""


@dataclass(frozen=True)
class Observations:
    """M sightings of the P points of one board by C cameras in F frames, in any order.

    Pixels are COLMAP's: continuous, the centre of the top-left pixel at (0.5, 0.5).

    Attributes:
        camera_ids: C names.
        image_sizes: (width, height) of each camera's images, pixels.
        frame_ids: F names; all cameras' sightings of one frame are of one instant, thus of one board pose.
        board_points: [P, 3] metres in the board's frame: x right, y down along the print, z into the board,
            0 for a flat one.
        camera: [M] int32, index into `camera_ids`.
        frame: [M] int32, index into `frame_ids`.
        point: [M] int32, index into `board_points`.
        pixels: [M, 2] float64.

    Raises:
        ObservationError: shapes or indices that do not fit, a number that is not finite, a name or a
            sighting twice.
    """

    camera_ids: tuple[str, ...]
    image_sizes: tuple[tuple[int, int], ...]
    frame_ids: tuple[str, ...]
    board_points: np.ndarray = field(repr=False)
    camera: np.ndarray = field(repr=False)
    frame: np.ndarray = field(repr=False)
    point: np.ndarray = field(repr=False)
    pixels: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        for name in ("camera", "frame", "point"):
            object.__setattr__(self, name, _indices(name, getattr(self, name)))
        for name, width in (("board_points", 3), ("pixels", 2)):
            object.__setattr__(self, name, _coordinates(name, getattr(self, name), width))
        self._check_names()
        self._check_sightings()

    def __len__(self) -> int:
        return len(self.camera)

    @property
    def counts(self) -> np.ndarray:
        """[C, F] how many points each camera sees in each frame."""
        counts = np.zeros((len(self.camera_ids), len(self.frame_ids)), np.int64)
        np.add.at(counts, (self.camera, self.frame), 1)
        return counts

    @property
    def points(self) -> np.ndarray:
        """[M, 3] the board point of every sighting, metres."""
        return self.board_points[self.point]

    def subset(self, mask: np.ndarray) -> "Observations":
        """The sightings that a boolean mask [M], or an array of indices, keeps.

        All cameras, frames and board points stay, so that indices keep their meaning.
        """
        return replace(
            self,
            camera=self.camera[mask],
            frame=self.frame[mask],
            point=self.point[mask],
            pixels=self.pixels[mask],
        )

    def view(self, camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """What one camera sees in one frame: indices [N] of board points, pixels [N, 2]."""
        seen = (self.camera == camera) & (self.frame == frame)
        return self.point[seen], self.pixels[seen]

    def _check_names(self) -> None:
        for name, ids in (("camera_ids", self.camera_ids), ("frame_ids", self.frame_ids)):
            if len(set(ids)) < len(ids):
                twice = next(item for item in ids if ids.count(item) > 1)
                raise ObservationError(f"{name}: '{twice}' appears twice; rename one")
        if len(self.image_sizes) != len(self.camera_ids):
            raise ObservationError(
                f"image_sizes: has {len(self.image_sizes)} entries for {len(self.camera_ids)} cameras; "
                "give (width, height) for each"
            )
        for camera, size in zip(self.camera_ids, self.image_sizes, strict=True):
            if len(size) != 2 or min(size) < 1:
                raise ObservationError(f"image_sizes: {size} of '{camera}' is no size; give (width, height)")

    def _check_sightings(self) -> None:
        lengths = {name: len(getattr(self, name)) for name in ("camera", "frame", "point", "pixels")}
        if len(set(lengths.values())) > 1:
            found = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise ObservationError(f"pixels: lengths differ ({found}); give one entry of each per sighting")
        limits = {
            "camera": len(self.camera_ids),
            "frame": len(self.frame_ids),
            "point": len(self.board_points),
        }
        for name, limit in limits.items():
            values = getattr(self, name)
            if len(values) and not (values.min() >= 0 and values.max() < limit):
                wrong = values[(values < 0) | (values >= limit)][0]
                raise ObservationError(f"{name}: {wrong} is not an index below {limit}; count from 0")
        keys = np.stack([self.camera, self.frame, self.point], axis=1)
        unique, counts = np.unique(keys, axis=0, return_counts=True)
        if len(unique) < len(keys):
            camera, frame, point = unique[counts > 1][0]
            raise ObservationError(
                f"point: {point} is seen twice by '{self.camera_ids[camera]}' in '{self.frame_ids[frame]}'; "
                "keep one sighting"
            )


def _indices(name: str, values: np.ndarray) -> np.ndarray:
    values = np.asarray(values)
    if values.ndim != 1 or (values.size and not np.issubdtype(values.dtype, np.integer)):
        raise ObservationError(
            f"{name}: has the shape {values.shape} and type {values.dtype}; give whole numbers [M]"
        )
    return values.astype(np.int32)


def _coordinates(name: str, values: np.ndarray, width: int) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.size == 0:
        values = values.reshape(-1, width)
    if values.ndim != 2 or values.shape[1] != width:
        raise ObservationError(f"{name}: has the shape {values.shape}; give [N, {width}]")
    if not np.isfinite(values).all():
        raise ObservationError(f"{name}: holds a number that is not finite; leave that sighting out")
    return values
