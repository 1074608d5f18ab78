"""One similarity per subject, from its rig's frame to the canonical frame, and what is odd about it.

The fit is that of Umeyama (1991) to the template's five keypoints. A keypoint weighs 1 / (σ² + τ²), with σ² the mean
variance of its coordinates, in the template's units, and τ the amount by which faces differ from the template: with
τ at 3 mm and σ well below, all weigh the same, as in the paper, and one that is badly known weighs less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from preface.align.errors import AlignmentError
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.keypoints3d import Keypoints, eye_distance
from preface.align.options import AlignmentOptions
from preface.align.template import LEFT_EYE, RIGHT_EYE, Template
from preface.geometry import GeometryError, Similarity, SimilarityFit, fit_similarity, fit_similarity_robust

# Scales that a rig in another unit has: how many template metres one of its units is.
_UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches", 0.3048: "feet", 1e3: "kilometres"}
_UNIT_TOLERANCE = 1.35  # faces differ by less
_NO_FACE = 2.0  # times larger or smaller than the template: not the face, but the unit


@dataclass(frozen=True)
class Flag:
    """Something odd: a code ("unit", "scale", "shape" or "left_right") and a sentence with the remedy."""

    code: str
    text: str


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a subject's face is put.

    Attributes:
        canonical_from_rig: determinant +1; scale 1 when it was fixed.
        residuals: float64 [5] metres in the canonical frame, from the template's keypoints; NaN where missing.
        weights: float64 [5] of the fit, their sum is 1; 0 for keypoints that are missing or do not fit.
        flags: what a person should look at.
    """

    canonical_from_rig: Similarity
    residuals: np.ndarray
    weights: np.ndarray
    flags: tuple[Flag, ...]


def place_subject(
    keypoints: Keypoints, template: Template, options: AlignmentOptions, metric: bool = True
) -> Placement:
    """Fit the similarity that brings a subject's keypoints onto the template.

    Args:
        keypoints: in the rig's frame.
        template: see there.
        options: see there.
        metric: whether the rig's lengths are said to be metres. If they are not, the size of the face says nothing.

    Raises:
        AlignmentError: too few keypoints, none that agree with the template, or left and right exchanged: the
            subject is to be excluded with that reason.
    """
    good = keypoints.good
    if good.sum() < max(3, options.minimum_keypoints):
        raise AlignmentError(
            f"has {good.sum()} of the five keypoints, and {max(3, options.minimum_keypoints)} are needed; "
            f"missing: {_missing(keypoints)}"
        )
    fixed = 1.0 if options.scale == "fixed" else None
    threshold = options.shape_tolerance * template.eye_distance
    try:
        everything = fit_similarity(keypoints.positions, template.keypoints, good.astype(float), fixed)
        if everything.mirrored:
            raise AlignmentError(
                f"left and right seem to be exchanged ({everything.hint}); number the subject's right, not the "
                "image's, or flip all images"
            )
        weights = _weights(keypoints, everything, options.shape_deviation)
        fit = fit_similarity_robust(keypoints.positions, template.keypoints, threshold, weights, fixed)
    except GeometryError as error:
        raise AlignmentError(_why(keypoints, template, fixed, error)) from error
    moved = fit.target_from_source.apply(np.where(good[:, None], keypoints.positions, 0.0))
    return Placement(
        canonical_from_rig=fit.target_from_source,
        residuals=np.where(good, np.linalg.norm(moved - template.keypoints, axis=-1), np.nan),
        weights=fit.weights / fit.weights.sum(),
        flags=(
            *(_scale_flags(keypoints, template, fit, options) if metric else ()),
            *_shape_flags(good, fit, threshold),
        ),
    )


def _missing(keypoints: Keypoints) -> str:
    named = zip(CANONICAL_KEYPOINTS, keypoints.reasons, keypoints.good, strict=True)
    return "; ".join(f"{name} ({reason})" for name, reason, good in named if not good)


def _weights(keypoints: Keypoints, fit: SimilarityFit, shape_deviation: float) -> np.ndarray:
    scale = float(fit.target_from_source.scale)
    variance = scale**2 * np.trace(keypoints.covariance, axis1=-2, axis2=-1) / 3
    return np.where(keypoints.good, 1 / (np.where(keypoints.good, variance, 0.0) + shape_deviation**2), 0.0)


def _why(keypoints: Keypoints, template: Template, fixed: float | None, error: GeometryError) -> str:
    """Say why no similarity was found: with a fixed scale, most often the rig's unit."""
    if fixed is not None:
        ratio = template.eye_distance / keypoints.eye_distance
        unit = _unit(ratio)
        if unit:
            size = f"the face is {1 / ratio:.4g} times the template's size"
            return f"its rig seems to be in {unit}: {size}; correct the rig"
        if not 0.5 < ratio < 2:
            return (
                f"the face is {1 / ratio:.4g} times the template's size; correct the unit of the rig, or let the "
                "scale be free"
            )
    return f"does not fit the template: {error}"


def _unit(scale: float) -> str:
    """The unit of a rig whose faces need this scale; empty for metres and for odd scales."""
    for unit, name in _UNITS.items():
        if 1 / _UNIT_TOLERANCE < scale / unit < _UNIT_TOLERANCE:
            return name
    return ""


def _scale_flags(
    keypoints: Keypoints, template: Template, fit: SimilarityFit, options: AlignmentOptions
) -> Sequence[Flag]:
    """Judge the size of the face: with a fixed scale, by the distance between its eye corners."""
    scale = float(fit.target_from_source.scale)
    if options.scale == "fixed" and keypoints.good[[RIGHT_EYE, LEFT_EYE]].all():
        scale = template.eye_distance / float(eye_distance(keypoints.positions))
    if 1 / options.scale_tolerance <= scale <= options.scale_tolerance:
        return ()
    unit, size = _unit(scale), f"its face is {1 / scale:.3g} times as large as the template's"
    if not unit and 1 / _NO_FACE < scale < _NO_FACE:
        return (Flag("scale", f"{size}; check the square size of the calibration board and the keypoints"),)
    said = f"{size}, as with a rig in {unit}" if unit else size
    if options.scale == "fixed":
        return (Flag("unit", f"{said}; correct the rig"),)
    # One number does not tell the two apart, and where the scale is fitted, neither does harm.
    text = (
        f"{said}, or with one whose scale is arbitrary (cameras from photographs alone): the head gets the template's "
        "size either way, so correct the rig only if it should be metric"
    )
    return (Flag("unit", text),)


def _shape_flags(good: np.ndarray, fit: SimilarityFit, threshold: float) -> Sequence[Flag]:
    """Name the keypoints that the robust fit left out."""
    odd = [
        f"{name} {1000 * residual:.3g} mm"
        for name, residual, used, known in zip(
            CANONICAL_KEYPOINTS, fit.residuals, fit.inliers, good, strict=True
        )
        if known and not used
    ]
    if not odd:
        return ()
    text = (
        f"does not have the template's shape: {', '.join(odd)} away from it (more than {1000 * threshold:.3g} mm), and "
        "left out; look at the landmarks, and for an open mouth"
    )
    return (Flag("shape", text),)
