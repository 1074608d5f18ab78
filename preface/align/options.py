"""What a user may choose about alignment; the field docs are the command line's help."""

from dataclasses import dataclass, field
from typing import Literal

# The paper's template is the median "across the first 260 identities" (section 4, Preprocessing).
PAPER_IDENTITIES = 260


@dataclass(frozen=True)
class TriangulationOptions:
    """How points are triangulated and when they are given up."""

    outlier_threshold: float = 4.0
    """Distance between measured and projected point, in standard deviations, beyond which a view is an outlier
    of that point; 4 loses one good view in 3,000."""
    minimum_angle_degrees: float = 2.0
    """Smallest angle that the two most different rays of a point must make; below it the depth is a guess."""
    minimum_share: float = 1 / 3
    """Smallest share of the views of a point that must agree on it; never fewer than three where three exist."""


@dataclass(frozen=True)
class AlignmentOptions:
    """How landmarks in calibrated views become a face in the canonical frame."""

    triangulation: TriangulationOptions = field(default_factory=TriangulationOptions)
    """How points are triangulated."""
    landmark_error: float = 0.01
    """By how much landmarks of different views mark different points of the skin: one standard deviation, as a
    share of the distance between the outer eye corners; added to the detector's own in quadrature."""
    landmark_correlation: float = 1.0
    """Correlation, from 0 to 1, of the errors that neighbouring landmarks have in one view. Detectors place
    them together, so that averaging them removes little: 0.6 was measured between FaceMesh's two lips on synthetic
    heads. 1 claims no gain from averaging, which errs on the safe side."""
    view_tolerance: float = 0.03
    """How far each of the five keypoints of a view may be from where the other views put it, as a share of the
    distance between the outer eye corners. Keypoints beyond are left out, and views with fewer than three left."""
    credible_deviation: float = 0.016
    """Largest standard deviation of a keypoint that a view contributes, as a share of the distance between the outer
    eye corners, where the detector's errors by direction are known; the three best views of a keypoint always do."""
    minimum_keypoints: int = 4
    """Keypoints that a subject needs; those with fewer are excluded. Three determine a similarity and four
    check it."""
    keypoint_deviation: float = 0.05
    """Largest standard deviation of a good keypoint in its worst direction, as a share of the distance between
    the outer eye corners."""
    template_identities: int = PAPER_IDENTITIES
    """How many identities the template is the median of: the first usable ones in the manifest's order."""
    procrustes: bool = False
    """Bring the identities together (generalised Procrustes) before taking the median; for captures whose
    takes share no rig frame, or where people sit at different places."""
    scale: Literal["free", "fixed"] = "free"
    """Whether a subject's scale is fitted, as in the paper, or kept at 1 because the rig is metric."""
    shape_deviation: float = 0.003
    """By how much faces differ from the template in each keypoint: one standard deviation in metres, added to
    the keypoint's own when the keypoints are weighted."""
    shape_tolerance: float = 0.2
    """Distance to the template, as a share of its distance between the outer eye corners, beyond which a
    keypoint does not take part in the placement and is flagged."""
    scale_tolerance: float = 1.3
    """Factor by which a face may be larger or smaller than the template before it is flagged."""
