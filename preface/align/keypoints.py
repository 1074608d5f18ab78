"""The five canonical keypoints, and the landmark schemes in which they are found.

"Right" is the subject's right, at the left of an image that was taken from the front.

FaceMesh numbers 468 points of the skin and ten of the irises. Its canonical face model (MediaPipe,
`canonical_face_model.obj`) is symmetric, and numbers the points of the left half in the order of the right
half's: the twin of every point follows from the list of those on the middle line. iBUG's 68 points are those
of the 300-W annotations (Sagonas et al., 2016).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

CANONICAL_KEYPOINTS = ("right_eye_outer", "left_eye_outer", "nose_tip", "mouth_center", "chin")


@dataclass(frozen=True, eq=False)
class Scheme:
    """A way to number the landmarks of a face.

    Attributes:
        name: as landmark files say it.
        size: N, the number of landmarks.
        keypoints: canonical keypoint to the landmarks whose mean it is, from 0.
        mirror: [N] int, the twin of each landmark on the other half of the face; a landmark on the middle
            line is its own. ``pixels[mirror]`` are the landmarks of the mirrored image, but for their x.
    """

    name: str
    size: int
    keypoints: Mapping[str, tuple[int, ...]]
    mirror: np.ndarray

    def keypoint_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """The five keypoints [..., 5, 2] of landmarks [..., N, 2]; NaN where one of its landmarks is NaN."""
        return np.stack([pixels[..., list(self.keypoints[k]), :].mean(-2) for k in CANONICAL_KEYPOINTS], -2)


def _twins(pairs: Iterator[tuple[int, int]], size: int) -> np.ndarray:
    mirror = np.arange(size)
    for right, left in pairs:
        mirror[right], mirror[left] = left, right
    mirror.setflags(write=False)
    return mirror


FACEMESH_SKIN = 468  # points; the irises follow
_FACEMESH_FIRST_LEFT = 248  # all before it lie on the right half or on the middle line
_FACEMESH_MIDDLE = frozenset(
    (
        0,
        1,
        2,
        4,
        5,
        6,
        8,
        9,
        10,
        11,
        12,
        13,
        14,
        15,
        16,
        17,
        18,
        19,
        94,
        151,
        152,
        164,
        168,
        175,
        195,
        197,
        199,
        200,
    )
)
# Centre, then the rim towards the subject's left, up, towards the right, down.
_FACEMESH_IRISES = ((468, 473), (469, 476), (470, 475), (471, 474), (472, 477))


def _facemesh_pairs() -> Iterator[tuple[int, int]]:
    right = (index for index in range(_FACEMESH_FIRST_LEFT) if index not in _FACEMESH_MIDDLE)
    yield from zip(right, range(_FACEMESH_FIRST_LEFT, FACEMESH_SKIN), strict=True)
    yield from _FACEMESH_IRISES


def _ibug_pairs() -> Iterator[tuple[int, int]]:
    for first, last in ((0, 16), (17, 26), (31, 35), (48, 54), (55, 59), (60, 64), (65, 67)):
        yield from zip(range(first, last + 1), range(last, first - 1, -1), strict=True)
    yield from ((36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46))


FACEMESH478 = Scheme(
    "facemesh478",
    478,
    {
        "right_eye_outer": (33,),
        "left_eye_outer": (263,),
        "nose_tip": (1,),
        "mouth_center": (13, 14),  # the inner edges of the lips
        "chin": (152,),
    },
    _twins(_facemesh_pairs(), 478),
)
IBUG68 = Scheme(
    "ibug68",
    68,
    {
        "right_eye_outer": (36,),
        "left_eye_outer": (45,),
        "nose_tip": (30,),
        "mouth_center": (62, 66),
        "chin": (8,),
    },
    _twins(_ibug_pairs(), 68),
)
SCHEMES: Mapping[str, Scheme] = {scheme.name: scheme for scheme in (FACEMESH478, IBUG68)}
