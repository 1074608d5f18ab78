"""Photographs whose cameras are known: triangulation, and the scale from the face where theirs is arbitrary.

A single photograph is matched against the expected face through its camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from preface.align.errors import AlignmentError
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.landmark_bias import LandmarkBias, expect, pixel_shifts
from preface.align.photos import trust
from preface.align.photos.adjustment import LensPrior, adjust
from preface.align.photos.correction import corrected
from preface.align.photos.face import face_prior, keypoint_weights
from preface.align.photos.initial import Affine, ViewProblemError, first_pose
from preface.align.photos.measure import face_points
from preface.align.photos.noise import Observations, deviations
from preface.align.photos.projection import Scene
from preface.align.photos.views import PhotoAlignment, PhotoOptions, PhotoView, Source, Trust, observe
from preface.align.triangulation import triangulate
from preface.capture.rig import Rig
from preface.geometry import GeometryError, Rigid, Views, fit_similarity_robust

# Landmarks this far behind the outer eye corners (metres) depend on the view: they do not set the scale.
MAX_BEHIND = 0.02
# Standard deviation of adults' face size about the expected one, and what metric cameras may differ from it by.
SIZE_DEVIATION, MAX_SIZE_RATIO = 0.06, 1.3
# Metres by which a point of a face may lie off the expected face when the scale is sought.
FACE_SPREAD = 0.015


@dataclass(frozen=True, eq=False)
class _Face:
    """Points [N, 3] in the rig's frame and unit, covariances [N, 3, 3], inliers and residuals [V, N]."""

    points: np.ndarray
    covariance: np.ndarray
    inliers: np.ndarray
    residuals: np.ndarray


def triangulate_given(views: Sequence[PhotoView], rig: Rig, options: PhotoOptions) -> PhotoAlignment:
    """Find the face of photographs with known cameras; see `align_photos`.

    Raises:
        AlignmentError: no photograph has both a camera and a usable face.
    """
    used, poses, excluded = _usable(views, rig)
    if not used:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in excluded.items())
        raise AlignmentError(f"no photograph can be used ({reasons}); give the cameras of these photographs")
    several = len(used) > 1
    face = _triangulated(used, poses, rig) if several else _matched(used[0], poses[0], rig, options.bias)
    if several and options.bias is not None:
        used = _corrected(used, face, rig, options.bias)
        face = _triangulated(used, poses, rig)
    if np.isfinite(face.points).all(-1).sum() < 3:
        raise AlignmentError(
            "the landmarks cannot be triangulated with these cameras: they see the face from almost one direction, "
            "or they are not the cameras of these photographs; leave the cameras away"
        )
    factor, deviation, source, warnings = _scale(face, rig, len(used), options)
    weights = keypoint_weights()
    chosen = [np.flatnonzero(row) for row in weights]  # NaN of other landmarks must not spread
    keypoints = factor * np.stack([face.points[some].mean(0) for some in chosen])
    # Errors of neighbours are alike: a mean of two is known no better than one.
    spread = factor**2 * np.stack([face.covariance[some].mean(0) for some in chosen])
    share = np.where(np.isfinite(keypoints).all(-1), 1.0, 0.0)
    if len(used) == 1:  # otherwise no expected face takes part
        expected = (np.einsum("mn,nck->mck", weights, face_prior().basis) ** 2).sum((1, 2))
        share = np.clip(1 - np.trace(spread, axis1=1, axis2=2) / expected, 0.0, 1.0)
    apart = keypoints[0] - keypoints[1]
    eyes = float(np.linalg.norm(apart))
    along = apart / eyes
    eyes_deviation = float(np.sqrt(along @ (spread[0] + spread[1]) @ along + (deviation * eyes) ** 2))
    text = "The cameras are those given."
    said = [
        Trust("focal length", None, None, "px", "given", text),
        trust.scale_trust(options, eyes, eyes_deviation, source),
        *trust.keypoint_trust(keypoints, spread, share),
    ]
    cameras = {view.id: rig.cameras[view.id] for view in used}
    moved = {
        name: replace(
            camera,
            translation=tuple((factor * np.array(camera.translation)).tolist()),
            standard_deviations=camera.standard_deviations if factor == 1 else None,
            covariance=camera.covariance if factor == 1 else None,
        )
        for name, camera in cameras.items()
    }
    return PhotoAlignment(
        rig=Rig(rig.take, moved, metadata={**rig.metadata, "scale": said[1].text}),
        points=factor * face.points,
        covariance=factor**2 * face.covariance,
        keypoints=keypoints,
        keypoint_covariance=spread,
        from_photographs=share,
        views=tuple(cameras),
        inliers=face.inliers,
        residuals=face.residuals,
        excluded=excluded,
        trust=tuple(said),
        warnings=tuple(warnings),
    )


def _usable(views: Sequence[PhotoView], rig: Rig) -> tuple[list[PhotoView], list[Affine], dict[str, str]]:
    used, poses, excluded = [], [], {}
    mean = face_prior().mean
    for view in views:
        if view.id not in rig.cameras:
            excluded[view.id] = "the given cameras have none of this name"
            continue
        camera = rig.cameras[view.id].camera
        if (camera.width, camera.height) != (view.width, view.height):
            excluded[view.id] = (
                f"it is {view.width}x{view.height}, its camera was calibrated at {camera.width}x{camera.height}"
            )
            continue
        try:
            # In focal lengths, without distortion.
            poses.append(first_pose(mean, _normalised(view, rig), float(camera.intrinsics[0])))
            used.append(view)
        except ViewProblemError as problem:
            excluded[view.id] = str(problem)
    return used, poses, excluded


def _normalised(view: PhotoView, rig: Rig) -> np.ndarray:
    """Undistorted landmarks [N, 2] at depth 1; NaN where not usable."""
    usable = np.isfinite(observe([view]).image[0]).all(-1)
    return rig.cameras[view.id].camera.unproject(np.where(usable[:, None], view.landmarks.pixels, np.nan))[0]


def _observations(views: list[PhotoView], poses: list[Affine], rig: Rig) -> tuple[Observations, Scene]:
    """Landmarks in focal lengths, and the first poses."""
    focals = np.array([rig.cameras[view.id].camera.intrinsics[0] for view in views])
    sides = np.array([view.longer_side for view in views])
    raw = observe(views)
    image = np.stack([_normalised(view, rig) for view in views])
    observations = Observations(image, raw.sigma * (sides / focals)[:, None], raw.confidence)
    shape = np.zeros(face_prior().basis.shape[-1])
    rotation, placement = np.stack([p.rotation for p in poses]), np.stack([p.placement for p in poses])
    return observations, Scene(0.0, 0.0, rotation, placement, shape)


def _triangulated(views: list[PhotoView], poses: list[Affine], rig: Rig) -> _Face:
    observations, scene = _observations(views, poses, rig)
    own, shared = deviations(observations, scene, np.zeros(len(face_prior().mean)))
    focals = np.array([rig.cameras[view.id].camera.intrinsics[0] for view in views])
    sigma = np.hypot(own, shared) * focals[:, None]
    pixels = np.stack([view.landmarks.pixels for view in views])
    pixels = np.where(observations.seen[..., None], pixels, np.nan)
    found = triangulate(_stacked(views, rig), np.swapaxes(pixels, 0, 1), sigma.T)
    return _Face(found.points, found.covariance, found.inliers.T, found.residuals.T)


def _corrected(views: list[PhotoView], face: _Face, rig: Rig, bias: LandmarkBias) -> list[PhotoView]:
    """The photographs without what the detector gets wrong on a face that is about known."""
    cameras = _stacked(views, rig)
    expected = expect(bias, _five(face.points), cameras.world_from_camera[:, :, 3])
    if expected is None:
        return views
    return [
        replace(view, landmarks=replace(view.landmarks, pixels=view.landmarks.pixels + shifts))
        for view, shifts in zip(views, pixel_shifts(expected, cameras), strict=True)
    ]


def _stacked(views: list[PhotoView], rig: Rig) -> Views:
    cameras = [rig.cameras[view.id] for view in views]
    return Views.stack([c.camera for c in cameras], [c.camera_from_rig.inverse for c in cameras])


def _matched(view: PhotoView, pose: Affine, rig: Rig, bias: LandmarkBias | None) -> _Face:
    """The most probable face before one camera."""
    face = face_prior()
    observations, scene = _observations([view], [pose], rig)
    fit = adjust(observations, face, LensPrior(0.0, 0.0), scene)
    if bias is not None:
        fit = adjust(corrected(observations, fit.scene, face, bias), face, LensPrior(0.0, 0.0), fit.scene)
    camera = rig.cameras[view.id]
    face_from_camera = Rigid(fit.scene.rotation[0], fit.scene.translations()[0]).inverse
    rig_from_face = camera.camera_from_rig.inverse @ face_from_camera.inverse
    lengths = face_points(fit.scene, face)
    spread = lengths.by_scene @ fit.covariance @ np.swapaxes(lengths.by_scene, -1, -2)
    turn, points = rig_from_face.rotation, rig_from_face.apply(lengths.value)
    projected, _ = camera.camera.project(camera.camera_from_rig.apply(points))
    residuals = np.linalg.norm(view.landmarks.pixels - projected, axis=-1)
    return _Face(points, turn @ spread @ turn.T, observations.seen, residuals[None])


def _scale(
    face: _Face, rig: Rig, count: int, options: PhotoOptions
) -> tuple[float, float, Source, list[str]]:
    """Metres per unit of the rig, its relative deviation, where it comes from, and warnings."""
    known = options.known_distance
    if known and known[0] in CANONICAL_KEYPOINTS:
        five = dict(zip(CANONICAL_KEYPOINTS, _five(face.points), strict=True))
        found = float(np.linalg.norm(five[known[0]] - five[known[1]]))
        if not np.isfinite(found):
            raise AlignmentError(
                f"known_distance: {known[0]} or {known[1]} is not triangulated; give two others"
            )
        return known[2] / found, options.known_distance_deviation / known[2], "given", []
    if known:
        centres = [
            rig.cameras[name].camera_from_rig.inverse.translation for name in known[:2] if name in rig.cameras
        ]
        if len(centres) < 2 or np.array_equal(centres[0], centres[1]):
            raise AlignmentError(
                f"known_distance: {known[0]} and {known[1]} have no two places in the given cameras"
            )
        found = float(np.linalg.norm(centres[0] - centres[1]))
        return known[2] / found, options.known_distance_deviation / known[2], "given", []
    if count == 1:  # one camera says nothing about the rig's unit; the face came out in metres
        return 1.0, SIZE_DEVIATION, "expectation", []
    factor = _face_size(face.points)
    if not options.metric_cameras:
        return factor, SIZE_DEVIATION, "expectation", []
    warnings = []
    if not 1 / MAX_SIZE_RATIO < factor < MAX_SIZE_RATIO:
        warnings.append(
            f"the face is {1 / factor:.3g} times the size of faces: is the unit of the cameras the metre?"
        )
    return 1.0, 0.0, "given", warnings


def _five(points: np.ndarray) -> np.ndarray:
    return np.stack([points[np.flatnonzero(row)].mean(0) for row in keypoint_weights()])


def _face_size(points: np.ndarray) -> float:
    """Metres per unit that give the face the size of faces."""
    mean = face_prior().mean
    eyes = 0.5 * (mean[33, 2] + mean[263, 2])
    stable = (mean[:, 2] > eyes - MAX_BEHIND) & np.isfinite(points).all(-1)
    try:
        fit = fit_similarity_robust(points[stable], mean[stable], threshold=FACE_SPREAD)
    except GeometryError as error:
        raise AlignmentError(
            f"the triangulated landmarks form no face ({error}); check the cameras"
        ) from error
    return float(fit.target_from_source.scale)
