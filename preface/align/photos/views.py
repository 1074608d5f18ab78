"""What goes in and what comes out: photographs with landmarks, options, and an alignment with its trust."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from preface.align.errors import AlignmentError
from preface.align.keypoints import CANONICAL_KEYPOINTS, FACEMESH478
from preface.align.landmark_bias import LandmarkBias
from preface.align.landmarks import ViewLandmarks
from preface.align.photos.noise import Observations
from preface.capture.rig import Rig

Source = Literal["photographs", "exif", "expectation", "given", "assumption"]
HARDLY = "hardly the photographs"
# A deviation of more than this share of its number is no settled number, whatever it rests on.
LOOSE = 0.1


@dataclass(frozen=True, eq=False)
class PhotoView:
    """One photograph.

    Attributes:
        id: its name in the rig.
        landmarks: FaceMesh's, in the photograph's pixels.
        width, height: of the photograph, pixels.
        exif_focal: focal length in pixels by EXIF, None where EXIF says nothing.
    """

    id: str
    landmarks: ViewLandmarks
    width: int
    height: int
    exif_focal: float | None = None

    @property
    def longer_side(self) -> int:
        """The unit of image coordinates here, pixels."""
        return max(self.width, self.height)


@dataclass(frozen=True)
class PhotoOptions:
    """How to align photographs.

    Attributes:
        known_distance: two canonical keypoints, or two photographs for their cameras, and the distance between
            them in metres; sets the scale. Without it the scale comes from the size that faces have.
        known_distance_deviation: one standard deviation of that distance, metres.
        exif_deviation: relative standard deviation of EXIF's focal length: equivalents are rounded, and
            stabilisation crops.
        focal_prior: focal length in longer sides that is expected without EXIF, and its relative deviation
            (of the logarithm). Main and selfie cameras of phones have 0.65 to 1, their films 0.8 to 1.1, portrait
            lenses 1.5 and more.
        metric_cameras: whether the unit of given cameras is the metre; otherwise the face sets their scale.
        bias: what the detector gets wrong by direction; None leaves landmarks as they are.
    """

    known_distance: tuple[str, str, float] | None = None
    known_distance_deviation: float = 0.001
    exif_deviation: float = 0.05
    focal_prior: tuple[float, float] = (0.85, 0.30)
    metric_cameras: bool = False
    bias: LandmarkBias | None = None


def rests_on(source: Source, value: float | None, deviation: float | None) -> str:
    """What a number rests on, as every page has it: the source, or `HARDLY` where it is the photographs and these
    leave the number loose.
    """
    loose = value is not None and deviation is not None and deviation > LOOSE * abs(value)
    return HARDLY if source == "photographs" and loose else source


@dataclass(frozen=True)
class Trust:
    """How far one choice is trusted.

    Attributes:
        what: "focal length", "scale", "nose_tip", ...
        value, deviation: the number and one standard deviation, in ``unit``; None where there is none.
        unit: "px", "mm", ...
        source: what it rests on most.
        text: a whole sentence for the user.
    """

    what: str
    value: float | None
    deviation: float | None
    unit: str
    source: Source
    text: str

    @property
    def rests_on(self) -> str:
        """See `rests_on`."""
        return rests_on(self.source, self.value, self.deviation)


@dataclass(frozen=True, eq=False)
class PhotoAlignment:
    """Cameras and face of photographs of one still person.

    Without given cameras the frame is the face's own: origin at the mean of the five keypoints of the expected
    face, x to the subject's left, y up, z out of the face. With given cameras it is theirs, scaled to metres.

    Attributes:
        rig: a camera for each used photograph, with covariances.
        points: [478, 3] landmarks, metres; NaN where nothing determines them.
        covariance: [478, 3, 3] of each, metres², in this frame: the part of the scale included.
        keypoints: [5, 3] in the order of `CANONICAL_KEYPOINTS`, and keypoint_covariance [5, 3, 3].
        from_photographs: [5] share of the variance among faces that the photographs removed, 0 to 1; 1 where no
            expected face takes part.
        views: ids in the rig's order; the next two follow it.
        inliers: bool [V, 478], landmarks that agree with the face.
        residuals: [V, 478] distance in pixels between landmark and projection, NaN where not seen.
        excluded: why a photograph was not used, by id.
        trust: how far each choice is trusted.
        warnings: whole sentences for the user.
    """

    rig: Rig
    points: np.ndarray
    covariance: np.ndarray
    keypoints: np.ndarray
    keypoint_covariance: np.ndarray
    from_photographs: np.ndarray
    views: tuple[str, ...]
    inliers: np.ndarray
    residuals: np.ndarray
    excluded: Mapping[str, str]
    trust: tuple[Trust, ...]
    warnings: tuple[str, ...] = field(default=())


def check_views(views: Sequence[PhotoView], options: PhotoOptions) -> None:
    """Refuse what cannot be photographs of one person.

    Raises:
        AlignmentError: none, ids twice, another scheme, impossible sizes, or an unknown name in known_distance.
    """
    ids = [view.id for view in views]
    if not views:
        raise AlignmentError(
            "photographs: there are none with landmarks; give at least one that shows the face"
        )
    if len(set(ids)) < len(ids):
        raise AlignmentError(f"photographs: ids {ids} are not all different; rename one")
    for view in views:
        if view.landmarks.scheme != FACEMESH478.name or view.landmarks.pixels.shape != (FACEMESH478.size, 2):
            raise AlignmentError(
                f"{view.id}: landmarks of scheme '{view.landmarks.scheme}' "
                f"{list(view.landmarks.pixels.shape)}; photographs without cameras need {FACEMESH478.name}, "
                "for which the expected face is known"
            )
        if view.width <= 0 or view.height <= 0:
            raise AlignmentError(f"{view.id}: {view.width}x{view.height} is no image size; give its pixels")
    if options.known_distance is None:
        return
    first, second, metres = options.known_distance
    names = CANONICAL_KEYPOINTS if first in CANONICAL_KEYPOINTS else tuple(ids)
    if first == second or first not in names or second not in names or not (0 < metres < np.inf):
        raise AlignmentError(
            f"known_distance: {first}, {second}, {metres}; give two of {', '.join(CANONICAL_KEYPOINTS)}, or two "
            "photographs, and a positive distance in metres"
        )


def observe(views: Sequence[PhotoView]) -> Observations:
    """The landmarks in longer sides about the images' centres; what is not finite is not seen."""
    image, sigma, confidence = [], [], []
    for view in views:
        marks, side = view.landmarks, view.longer_side
        usable = marks.seen & np.isfinite(marks.sigma) & (marks.sigma > 0) & (marks.confidence > 0)
        centred = (marks.pixels - [view.width / 2, view.height / 2]) / side
        image.append(np.where(usable[:, None], centred, np.nan))
        sigma.append(np.where(usable, marks.sigma, 1.0) / side)
        confidence.append(np.where(usable, marks.confidence, 1.0))
    return Observations(np.stack(image), np.stack(sigma), np.stack(confidence))
