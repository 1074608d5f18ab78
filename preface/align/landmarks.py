"""The landmarks of one face in one image, and the absence of a face: what every detector and file gives."""

from dataclasses import dataclass, field

import numpy as np

from preface.align.keypoints import SCHEMES, Scheme


@dataclass(frozen=True, eq=False)
class ViewLandmarks:
    """The landmarks of the subject's face in one view. NaN means not seen, in pixels and sigma together.

    Attributes:
        scheme: the name of one of `SCHEMES`; N is its size.
        pixels: float64 [N, 2] in the full-resolution image; the centre of the top-left pixel is (0.5, 0.5).
        sigma: float64 [N], the standard deviation of each coordinate in pixels, positive.
        confidence: float64 [N] in 0 to 1: 1 for a landmark that faces the camera and on which jittered crops
            agree, towards 0 for one that the head hides or on which they do not; 0 where not seen.
        face_box: [4] left, top, right, bottom of the landmarks that are seen, in pixels.
        rotation: degrees by which the image was turned clockwise before the face was found, 0 where it stood.
        others: how many other faces are in the image.
        warnings: whole sentences for the user.
    """

    scheme: str
    pixels: np.ndarray
    sigma: np.ndarray
    confidence: np.ndarray
    face_box: np.ndarray
    rotation: float = 0.0
    others: int = 0
    warnings: tuple[str, ...] = field(default=())

    @property
    def layout(self) -> Scheme:
        """The scheme itself."""
        return SCHEMES[self.scheme]

    @property
    def seen(self) -> np.ndarray:
        """Bool [N]: which landmarks have pixels."""
        return np.isfinite(self.pixels).all(-1)

    @property
    def keypoints(self) -> np.ndarray:
        """The five canonical keypoints [5, 2] in pixels, in the order of `CANONICAL_KEYPOINTS`; NaN if unseen."""
        return self.layout.keypoint_pixels(self.pixels)


@dataclass(frozen=True)
class NoFace:
    """A view without landmarks.

    Attributes:
        reason: why, as part of a sentence: "no face found at any scale or rotation".
    """

    reason: str


def box_around(pixels: np.ndarray) -> np.ndarray:
    """Left, top, right, bottom [4] of the seen points of [N, 2].

    Raises:
        ValueError: no point is seen.
    """
    seen = pixels[np.isfinite(pixels).all(-1)]
    if not len(seen):
        raise ValueError("no landmark is seen")
    return np.concatenate([seen.min(0), seen.max(0)])
