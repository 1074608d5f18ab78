"""The template: where the five keypoints of the median face are, and the canonical frame that they define.

As in the paper, it is the median, coordinate by coordinate, of the keypoints of the first 260 identities in the
frame of their rig. For captures without a common rig frame the identities are first brought together by
generalised Procrustes analysis (Gower 1975): each is fitted to the mean of all by a similarity, in turn, until the
mean rests; sizes keep their geometric mean, so that the template stays metric.

The canonical frame is then set by the template alone:

- origin: the mean of its five keypoints;
- x: from the right outer eye corner to the left one, the subject's left;
- y: from the chin to the middle between the outer eye corners, made perpendicular to x: up;
- z = x × y: out of the face. The nose tip has positive z, or left and right are exchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from preface.align.errors import AlignmentError
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.keypoints3d import Keypoints, eye_distance, inside_out, out_of_face
from preface.geometry import GeometryError, Rigid, fit_similarity, nearest_rotation

RIGHT_EYE, LEFT_EYE = (CANONICAL_KEYPOINTS.index(name) for name in ("right_eye_outer", "left_eye_outer"))
# Procrustes: rounds, and the relative change of the mean that ends them. A few are usual.
ROUNDS, AT_REST = 100, 1e-12


@dataclass(frozen=True, eq=False)
class Template:
    """Five keypoints in the canonical frame.

    Attributes:
        scheme: the landmark scheme of the subjects it was made from; keypoints of others differ by millimetres.
        keypoints: float64 [5, 3] metres, canonical frame, order of `CANONICAL_KEYPOINTS`; their mean is 0.
        canonical_from_rig: from the frame in which the median was taken: the rig's, or with Procrustes that of
            the first identity.
        identities: names of those it is the median of.
        procrustes: whether they were brought together before.
        spread: float64 [5] metres, root mean square distance of their keypoints from the median.
        provenance, metadata: as in every artefact.
    """

    scheme: str
    keypoints: np.ndarray
    canonical_from_rig: Rigid
    identities: tuple[str, ...]
    procrustes: bool
    spread: np.ndarray
    provenance: Mapping[str, Any] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    @property
    def eye_distance(self) -> float:
        """Metres between the outer eye corners."""
        return float(eye_distance(self.keypoints))


def build_template(
    subjects: Mapping[str, Keypoints], scheme: str, identities: int, procrustes: bool
) -> Template:
    """Make the template of the first identities that have all five keypoints.

    Args:
        subjects: identity to its keypoints in its rig's frame, in the order of the capture manifest.
        scheme: the landmark scheme that they come from.
        identities: how many to use; 260 in the paper.
        procrustes: whether to bring them together first.

    Raises:
        AlignmentError: nobody has five keypoints, or the median is no face.
    """
    complete = [name for name, keypoints in subjects.items() if keypoints.good.all()][:identities]
    if not complete:
        raise AlignmentError(
            f"template: none of the {len(subjects)} subjects has all five keypoints; give an existing template, "
            "or see in the subjects' reasons what is missing"
        )
    points = np.stack([subjects[name].positions for name in complete])
    upright_from_rig = Rigid.identity()
    if procrustes:
        points, upright_from_rig = bring_together(points)
    median = np.median(points, axis=0)
    canonical_from_upright = canonical_frame(median)
    return Template(
        scheme=scheme,
        keypoints=canonical_from_upright.apply(median),
        canonical_from_rig=canonical_from_upright @ upright_from_rig,
        identities=tuple(complete),
        procrustes=procrustes,
        spread=np.sqrt(((points - median) ** 2).sum(-1).mean(0)),
    )


def canonical_frame(keypoints: np.ndarray) -> Rigid:
    """The motion that takes five keypoints [5, 3] to their canonical frame, defined in the header.

    Raises:
        AlignmentError: eye corners and chin that span no plane, or a nose behind it.
    """
    keypoints = np.asarray(keypoints, dtype=np.float64)
    if keypoints.shape != (len(CANONICAL_KEYPOINTS), 3) or not np.isfinite(keypoints).all():
        raise AlignmentError("template: five finite keypoints are needed to set the canonical frame")
    across = keypoints[LEFT_EYE] - keypoints[RIGHT_EYE]
    out = out_of_face(keypoints)
    size = np.linalg.norm(keypoints - keypoints.mean(0), axis=-1).max()
    if not np.linalg.norm(out) > 1e-6 * size**2:
        raise AlignmentError(
            "template: the outer eye corners and the chin lie on one line or coincide, which sets no axes; check "
            "the landmarks of its identities"
        )
    if inside_out(keypoints):
        raise AlignmentError(
            "template: the tip of the nose lies behind the plane of eye corners and chin: left and right are "
            "exchanged; number the subject's right, not the image's, or flip the images"
        )
    x, z = across / np.linalg.norm(across), out / np.linalg.norm(out)
    rotation = nearest_rotation(np.stack([x, np.cross(z, x), z]))  # to the last digit
    return Rigid(rotation, -rotation @ keypoints.mean(0))


def bring_together(points: np.ndarray) -> tuple[np.ndarray, Rigid]:
    """Generalised Procrustes of faces [S, 5, 3].

    Returns:
        the faces [S, 5, 3] in the canonical frame of the first one by itself: a median by coordinates depends on
        the axes. And the motion from the first one's rig frame to that.

    Raises:
        AlignmentError: a face that is no face.
    """
    try:
        first = canonical_frame(points[0])
        mean = first.apply(points[0])
        for _ in range(ROUNDS):
            fits = [fit_similarity(face, mean).target_from_source for face in points]
            size = np.exp(np.mean([np.log(fit.scale) for fit in fits]))
            moved = np.stack([fit.apply(face) for fit, face in zip(fits, points, strict=True)]) / size
            before, mean = mean, moved.mean(0)
            if np.linalg.norm(mean - before) <= AT_REST * np.linalg.norm(mean):
                break
    except GeometryError as error:
        raise AlignmentError(f"template: an identity's keypoints are no face: {error}") from error
    return moved, first


def require_same_scheme(template: Template, schemes: Sequence[str]) -> None:
    """Refuse landmarks of another scheme than the template's.

    Raises:
        AlignmentError: naming both.
    """
    others = sorted({scheme for scheme in schemes if scheme != template.scheme})
    if others:
        raise AlignmentError(
            f"template: was made from {template.scheme} landmarks, and these are {', '.join(others)}; their "
            "keypoints lie millimetres apart on the same face. Use landmarks of its scheme, or another template"
        )
