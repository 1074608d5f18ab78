"""Everything that an alignment of a studio found, and the figures that sum it up."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.align.placement import Placement
from preface.align.subject import SubjectAlignment
from preface.align.template import Template
from preface.capture.rig import Rig

RIGHT_EYE, LEFT_EYE = (CANONICAL_KEYPOINTS.index(name) for name in ("right_eye_outer", "left_eye_outer"))


@dataclass(frozen=True, eq=False)
class AlignedStudio:
    """The people of a capture in one canonical frame.

    Attributes:
        landmarks: (identity, camera) to what was found in that view, in the manifest's order.
        rigs: identity to the rig that photographed it.
        subjects: identity to its face in its rig's frame, also of those that were excluded.
        template: the five keypoints that all are placed on; None when nobody could be aligned.
        joined: whether the template was given, and not made from these people.
        placements: identity to its place, of those that are aligned.
        excluded: identity to the reason, of the others.
    """

    landmarks: Mapping[tuple[str, str], ViewLandmarks | NoFace]
    rigs: Mapping[str, Rig]
    subjects: Mapping[str, SubjectAlignment]
    template: Template | None
    joined: bool
    placements: Mapping[str, Placement]
    excluded: Mapping[str, str]

    @cached_property
    def cameras(self) -> list[str]:
        """All cameras, in the manifest's order."""
        return list(dict.fromkeys(camera for _, camera in self.landmarks))

    @cached_property
    def rig_keypoints(self) -> np.ndarray:
        """Keypoints [S, 5, 3] of the aligned people in their rigs' frames, metres; NaN where missing."""
        found = [self.subjects[identity].keypoints.positions for identity in self.placements]
        return np.array(found).reshape(-1, len(CANONICAL_KEYPOINTS), 3)

    @cached_property
    def canonical_keypoints(self) -> np.ndarray:
        """The same [S, 5, 3] in the canonical frame."""
        places = self.placements.values()
        pairs = zip(places, self.rig_keypoints, strict=True)
        found = [_carried(place, points) for place, points in pairs]
        return np.array(found).reshape(-1, len(CANONICAL_KEYPOINTS), 3)

    @cached_property
    def scales(self) -> np.ndarray:
        """Scale [S] of each aligned person's similarity."""
        return np.array([float(place.canonical_from_rig.scale) for place in self.placements.values()])

    @cached_property
    def eye_distances(self) -> np.ndarray:
        """Distance [S] between the outer eye corners of each aligned person, rig units; NaN where one is missing."""
        points = self.rig_keypoints
        return np.linalg.norm(points[:, LEFT_EYE] - points[:, RIGHT_EYE], axis=-1)

    @cached_property
    def views_used(self) -> np.ndarray:
        """How many views [S] each aligned person rests on."""
        return np.array([len(self.subjects[identity].cameras) for identity in self.placements], int)

    @property
    def spread_before(self) -> np.ndarray:
        """Root mean square distance [5] of keypoints from their median as the rigs have them, metres."""
        return spread(self.rig_keypoints, median_keypoints(self.rig_keypoints))

    @property
    def spread_after(self) -> np.ndarray:
        """Root mean square distance [5] of keypoints from the template's in the canonical frame, metres."""
        if self.template is None:
            return np.full(len(CANONICAL_KEYPOINTS), np.nan)
        return spread(self.canonical_keypoints, self.template.keypoints)

    def disagreement(self, identity: str, camera: str) -> float:
        """The worst keypoint of a view against the other views, per cent of the eye distance; NaN if unknown."""
        verdict = self.subjects[identity].views.get(camera)
        return float("nan") if verdict is None else _worst(verdict.disagreement)

    def accepted_disagreement(self, identity: str, camera: str) -> float:
        """The same among the keypoints that the view contributes; NaN if it contributes none that is checked."""
        verdict = self.subjects[identity].views.get(camera)
        if verdict is None or not verdict.used:
            return float("nan")
        contributes = np.array([name not in verdict.left_out for name in CANONICAL_KEYPOINTS])
        return _worst(verdict.disagreement[contributes])

    def keypoints_left_out(self, identity: str, camera: str) -> tuple[str, ...]:
        """Keypoints that a used view does not contribute, because the others have them elsewhere."""
        verdict = self.subjects[identity].views.get(camera)
        return verdict.left_out if verdict is not None and verdict.used else ()

    def used(self, identity: str, camera: str) -> bool:
        """Whether a person rests on a view."""
        verdict = self.subjects[identity].views.get(camera)
        return verdict is not None and verdict.used

    def why_not(self, identity: str, camera: str) -> str:
        """Why a view is not used; empty if it is."""
        verdict, found = self.subjects[identity].views.get(camera), self.landmarks[identity, camera]
        if verdict is not None:
            return "" if verdict.used else verdict.reason
        return found.reason if isinstance(found, NoFace) else "the view was not judged"

    def reprojection_errors(self, identity: str, camera: str) -> np.ndarray:
        """Distances in pixels of the landmarks that a view contributes to; none for a view that is not used."""
        subject = self.subjects[identity]
        if camera not in subject.cameras:
            return np.empty(0)
        view = subject.cameras.index(camera)
        return subject.landmarks.residuals[:, view][subject.landmarks.inliers[:, view]]


def _worst(disagreement: np.ndarray) -> float:
    """The largest of the known shares, in per cent."""
    known = disagreement[~np.isnan(disagreement)]
    return 100 * float(known.max()) if known.size else float("nan")


def median_keypoints(points: np.ndarray) -> np.ndarray:
    """Per-coordinate median [5, 3] of keypoints [S, 5, 3]; NaN where nobody has one."""
    return np.array([[median(axis) for axis in keypoint.T] for keypoint in np.swapaxes(points, 0, 1)])


def spread(points: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Root mean square distance [5] of keypoints [S, 5, 3] from [5, 3]; NaN where nobody has one."""
    squared = ((points - center) ** 2).sum(axis=-1)
    known = np.isfinite(squared)
    total = np.where(known, squared, 0).sum(axis=0)
    return np.sqrt(
        np.divide(total, known.sum(axis=0), where=known.any(axis=0), out=np.full(len(center), np.nan))
    )


def root_mean_square(values: np.ndarray) -> float:
    """Of the finite values; NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if known.size else float("nan")


def median(values: np.ndarray) -> float:
    """Of the finite values; NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _carried(place: Placement, points: np.ndarray) -> np.ndarray:
    known = np.isfinite(points).all(axis=-1)
    carried = np.full(points.shape, np.nan)
    carried[known] = place.canonical_from_rig.apply(points[known])
    return carried
