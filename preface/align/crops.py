"""Upright square crops from a photograph of any size: where they lie, and their pixels without aliasing."""

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, eq=False)
class Region:
    """A square in an image, turned about its centre.

    Attributes:
        centre: [2] in pixels; the centre of the top-left pixel is (0.5, 0.5).
        side: in pixels.
        roll: radians by which its upper side is turned clockwise.
        mirrored: whether its crop shows the image in a mirror.
    """

    centre: np.ndarray
    side: float
    roll: float = 0.0
    mirrored: bool = False

    def image_from_crop(self, crop_side: int) -> np.ndarray:
        """The matrix [2, 3] that takes pixels of a crop of this many pixels a side to the image's."""
        cos, sin = np.cos(self.roll), np.sin(self.roll)
        across = np.array([-1.0 if self.mirrored else 1.0, 1.0])
        linear = self.side / crop_side * np.array([[cos, -sin], [sin, cos]]) * across
        return np.c_[linear, self.centre - linear @ np.full(2, crop_side / 2)]

    def moved(self, shift: np.ndarray, scale: float, turn: float, mirrored: bool) -> "Region":
        """Shifted by parts of its side, along the image's axes, scaled, turned by radians, perhaps mirrored."""
        return Region(self.centre + shift * self.side, self.side * scale, self.roll + turn, mirrored)

    @classmethod
    def around(cls, pixels: np.ndarray, roll: float, factor: float) -> "Region":
        """The upright square about points [N, 2], ``factor`` times as large as the longer side of their box."""
        cos, sin = np.cos(roll), np.sin(roll)
        rotation = np.array([[cos, -sin], [sin, cos]])
        upright = pixels @ rotation
        low, high = upright.min(0), upright.max(0)
        return cls(rotation @ ((low + high) / 2), factor * float((high - low).max()), roll)


class Picture:
    """An image with its halvings, made when they are first asked for."""

    def __init__(self, pixels: np.ndarray):
        """Take an image, uint8 [height, width, 3]."""
        self._levels = [pixels]
        self.height, self.width = pixels.shape[:2]

    def crop(self, region: Region, side: int) -> np.ndarray:
        """The pixels [side, side, 3] of a region; beyond the border the image is continued by its last pixels.

        They are read from a halving that still has two pixels per pixel of the crop along each axis, and
        averaged by area.
        """
        fine = 2 * side
        level = self._level(region.side / fine)
        to_level = np.array([level.shape[1] / self.width, level.shape[0] / self.height])
        matrix = region.image_from_crop(fine) * to_level[:, None]
        # OpenCV counts from the centre of the top-left pixel.
        matrix[:, 2] += matrix[:, :2] @ [0.5, 0.5] - 0.5
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        pixels = cv2.warpAffine(level, matrix, (fine, fine), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return cv2.resize(pixels, (side, side), interpolation=cv2.INTER_AREA)

    def _level(self, reduction: float) -> np.ndarray:
        """The smallest halving that is reduced by no more than this factor."""
        wanted = max(0, int(np.floor(np.log2(max(reduction, 1.0)))))
        while len(self._levels) <= wanted and min(self._levels[-1].shape[:2]) > 1:
            last = self._levels[-1]
            size = -(-last.shape[1] // 2), -(-last.shape[0] // 2)
            self._levels.append(cv2.resize(last, size, interpolation=cv2.INTER_AREA))
        return self._levels[min(wanted, len(self._levels) - 1)]


def to_image(points: np.ndarray, region: Region, crop_side: int) -> np.ndarray:
    """Points [N, 2] or [N, 3] of a crop in the image; z, in pixels of the crop, is scaled alike."""
    matrix = region.image_from_crop(crop_side)
    pixels = points[:, :2] @ matrix[:, :2].T + matrix[:, 2]
    return np.c_[pixels, points[:, 2:] * (region.side / crop_side)]
