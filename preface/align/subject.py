"""One subject: landmarks in calibrated views become a 3D face, with all that was left out and why.

How far a landmark is off is not only what the detector says. Its own deviation tells how steadily it finds a point
in one image; from image to image it finds different points of the skin. That error is assumed as a share of the
distance between the outer eye corners, added in quadrature, and then measured: the residuals of all landmarks say how
many times larger or smaller than assumed they are, and the covariances are scaled by that (the variance factor of
least-squares adjustment).

Where the detector's bias is known (`landmark_bias`), a first look at the face says from where each view sees it; then
the landmarks are corrected, and their deviations by direction take the place of the one share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from preface.align.errors import AlignmentError
from preface.align.keypoints import CANONICAL_KEYPOINTS, SCHEMES, Scheme
from preface.align.keypoints3d import Keypoints, eye_distance, form_keypoints, inside_out, no_keypoints
from preface.align.landmark_bias import Expected, LandmarkBias, expect, pixel_shifts
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.align.options import AlignmentOptions
from preface.align.triangulation import Reason, Triangulation, triangulate
from preface.align.view_check import Judgement, ViewVerdict, judge_views
from preface.align.view_consensus import measure
from preface.capture.rig import Rig
from preface.geometry import Views

# The median of the squared length of a two-dimensional standard normal vector.
MEDIAN_SQUARE = 2 * np.log(2)
_CONTESTED = "too few views agree on where it is"
# Where the detector's bias is to be corrected: the factor on the tolerance while it is not, and how often the face that
# it is corrected for is found anew. The correction varies by 0.2% of the eye distance for each degree of the face's
# turn, and the first face is right to some degrees.
LOOSE, CORRECTIONS = 2.0, 2


@dataclass(frozen=True, eq=False)
class SubjectAlignment:
    """What is known about a subject in its rig's frame, before it is placed.

    Attributes:
        scheme: the landmark scheme, N landmarks.
        cameras: ids of the V views that are used, in the rig's order.
        landmarks: the N landmarks, triangulated; arrays [N, ...] and [N, V].
        keypoints: the five, with covariance and reasons.
        views: camera id to its verdict, for every view that was given, used or not.
        noise_scale: how many times larger the residuals are than was assumed; the covariances include it.
        excluded: why the subject cannot be aligned, as part of a sentence; None when it can.
    """

    scheme: str
    cameras: tuple[str, ...]
    landmarks: Triangulation
    keypoints: Keypoints
    views: Mapping[str, ViewVerdict]
    noise_scale: float
    excluded: str | None


def align_subject(
    landmarks: Mapping[str, ViewLandmarks | NoFace],
    rig: Rig,
    options: AlignmentOptions,
    bias: LandmarkBias | None = None,
) -> SubjectAlignment:
    """Judge the views, triangulate the landmarks and form the five keypoints.

    Args:
        landmarks: camera id to what was found in that view; all of one scheme.
        rig: the cameras, of images of the size in which the landmarks were found.
        options: see `AlignmentOptions`.
        bias: of the detector that found the landmarks; landmarks of another scheme are left as they are.

    Raises:
        AlignmentError: views of different schemes, or landmarks that do not fit their scheme.
    """
    scheme = _scheme(landmarks)
    verdicts: dict[str, ViewVerdict] = {}
    for camera, found in landmarks.items():
        if camera not in rig.cameras:
            reason = f"the rig has no camera '{camera}'; calibrate it, or leave its images out"
            verdicts[camera] = ViewVerdict.without("not_in_rig", reason)
        elif isinstance(found, NoFace):
            verdicts[camera] = ViewVerdict.without("no_face", found.reason)
    views = {
        camera: landmarks[camera] for camera in rig.cameras if camera in landmarks and camera not in verdicts
    }
    seen = {camera: view for camera, view in views.items() if isinstance(view, ViewLandmarks)}
    if not seen:
        ordered = {camera: verdicts[camera] for camera in landmarks}
        return _excluded(scheme, ordered, "no view shows a face that a camera of the rig sees")
    cameras = _stack(rig, list(seen))
    pixels = np.stack([view.pixels for view in seen.values()]).astype(np.float64)
    widths = [rig.cameras[camera].camera.width for camera in seen]
    looked = _Looked(scheme, cameras, widths, pixels)
    known = bias if bias is not None and bias.scheme == scheme.name else None
    looked, judged = _judge(looked, known, options)
    verdicts |= dict(zip(seen, _with_corrections(judged.verdicts, looked), strict=True))
    ordered = {camera: verdicts[camera] for camera in landmarks}
    used = np.flatnonzero(judged.kept.any(1))
    if len(used) < 2:
        return _excluded(scheme, ordered, _too_few_views(ordered))

    names = [list(seen)[index] for index in used]
    cameras, pixels = cameras[used], _without_left_out(scheme, looked.corrected, judged)[used]
    shares = looked.shares(options.landmark_error)[used]
    sigmas = _deviations(cameras, [seen[name] for name in names], judged.points, shares)
    points, sigmas, scale = _triangulate(cameras, pixels, sigmas, options)
    keypoints = form_keypoints(scheme, cameras, points, sigmas, options)
    some = np.isfinite(looked.corrected_keypoints[used]).all(-1).any(0)
    contested = np.logical_and(some, ~np.any(judged.kept, axis=0))
    reasons = [_CONTESTED if no else why for no, why in zip(contested, keypoints.reasons, strict=True)]
    keypoints = replace(keypoints, reasons=tuple(reasons))
    excluded = _why_excluded(keypoints, options.minimum_keypoints)
    return SubjectAlignment(scheme.name, tuple(names), points, keypoints, ordered, scale, excluded)


@dataclass(frozen=True, eq=False)
class _Looked:
    """Landmarks [V, N, 2] of V views, and what their detector's bias does to them, as far as that is known.

    Attributes:
        scheme, cameras, widths, pixels: as found.
        expected: None where nothing is corrected.
        shifts: [V, N, 2] pixels, to be added to the landmarks.
    """

    scheme: Scheme
    cameras: Views
    widths: Sequence[int]
    pixels: np.ndarray
    expected: Expected | None = None
    shifts: np.ndarray | float = 0.0

    def knowing(self, expected: Expected) -> _Looked:
        """The same landmarks, corrected by what is expected of their detector."""
        return replace(self, expected=expected, shifts=pixel_shifts(expected, self.cameras))

    @property
    def corrected(self) -> np.ndarray:
        """Landmarks [V, N, 2] without the bias."""
        return self.pixels + self.shifts

    @property
    def keypoint_shifts(self) -> np.ndarray:
        """Shifts [V, 5, 2] of the keypoints."""
        return self.scheme.keypoint_pixels(np.broadcast_to(self.shifts, self.pixels.shape))

    @property
    def corrected_keypoints(self) -> np.ndarray:
        """Keypoints [V, 5, 2] without the bias."""
        return self.scheme.keypoint_pixels(self.corrected)

    def shares(self, usual: float) -> np.ndarray:
        """Deviation [V, N] of each landmark beyond the detector's own, in eye distances."""
        if self.expected is None:
            return np.full(self.pixels.shape[:2], usual)
        return self.expected.deviations / self.expected.eye_distance

    def judge(self, tolerance: float, options: AlignmentOptions) -> Judgement:
        """Judge the views; see `judge_views`."""
        shares = self.shares(options.landmark_error)
        members = [list(self.scheme.keypoints[name]) for name in CANONICAL_KEYPOINTS]
        deviations = np.stack([shares[:, some].max(1) for some in members], axis=1)
        measured = measure(
            self.scheme, self.cameras, self.widths, self.pixels, self.keypoint_shifts, deviations
        )
        return judge_views(measured, tolerance, options.credible_deviation, options.triangulation)


def _judge(
    looked: _Looked, bias: LandmarkBias | None, options: AlignmentOptions
) -> tuple[_Looked, Judgement]:
    """Judge the views, with the detector's bias taken out where it is known and the views show a face."""
    if bias is not None:
        judged = looked.judge(LOOSE * options.view_tolerance, options)
        for _ in range(CORRECTIONS):
            expected = expect(bias, judged.points, looked.cameras.world_from_camera[:, :, 3])
            if expected is None or inside_out(judged.points):
                return looked, looked.judge(options.view_tolerance, options)
            corrected = looked.knowing(expected)
            judged = corrected.judge(options.view_tolerance, options)
            if not judged.kept.any():
                break
            looked = corrected
        if judged.kept.any():
            return looked, judged
    return looked, looked.judge(options.view_tolerance, options)


def _with_corrections(verdicts: Sequence[ViewVerdict], looked: _Looked) -> list[ViewVerdict]:
    if looked.expected is None:
        return list(verdicts)
    return [
        replace(verdict, correction=shifts)
        for verdict, shifts in zip(verdicts, looked.keypoint_shifts, strict=True)
    ]


def _why_excluded(keypoints: Keypoints, minimum: int) -> str | None:
    """Say why keypoints are not enough for a face, or are none."""
    missing = int((~keypoints.good).sum())
    if len(keypoints.reasons) - missing < minimum:
        reasons = sorted({reason for reason in keypoints.reasons if reason})
        return f"{missing} of the five keypoints are missing: {'; '.join(reasons)}"
    if inside_out(keypoints.positions):
        return (
            "the tip of the nose lies behind the plane of eye corners and chin: left and right are exchanged, or the "
            "images are mirrored; number the subject's right, not the image's, or flip the images"
        )
    return None


def _scheme(landmarks: Mapping[str, ViewLandmarks | NoFace]) -> Scheme:
    """The one scheme of all views; the first known one where there is no view.

    Raises:
        AlignmentError: several, an unknown one, or arrays of another size.
    """
    found = {camera: view for camera, view in landmarks.items() if isinstance(view, ViewLandmarks)}
    names = sorted({view.scheme for view in found.values()})
    if len(names) > 1:
        raise AlignmentError(
            f"landmarks: the views are of the schemes {', '.join(names)}; give one scheme for all views of a subject"
        )
    name = names[0] if names else next(iter(SCHEMES))
    if name not in SCHEMES:
        raise AlignmentError(f"landmarks: the scheme {name!r} is unknown; use one of {', '.join(SCHEMES)}")
    scheme = SCHEMES[name]
    for camera, view in found.items():
        if np.shape(view.pixels) != (scheme.size, 2) or np.shape(view.sigma) != (scheme.size,):
            raise AlignmentError(
                f"landmarks: the view '{camera}' has {np.shape(view.pixels)} pixels and {np.shape(view.sigma)} "
                f"deviations; {name} has {scheme.size} landmarks"
            )
    return scheme


def _stack(rig: Rig, names: Sequence[str]) -> Views:
    chosen = [rig.cameras[name] for name in names]
    return Views.stack([c.camera for c in chosen], [c.camera_from_rig.inverse for c in chosen])


def _excluded(scheme: Scheme, views: Mapping[str, ViewVerdict], reason: str) -> SubjectAlignment:
    count = scheme.size
    nothing = Triangulation(
        points=np.full((count, 3), np.nan),
        covariance=np.full((count, 3, 3), np.nan),
        inliers=np.zeros((count, 0), dtype=bool),
        residuals=np.full((count, 0), np.nan),
        angle=np.full(count, np.nan),
        reason=np.full(count, Reason.TOO_FEW_VIEWS, dtype=np.int8),
    )
    return SubjectAlignment(scheme.name, (), nothing, no_keypoints(reason), views, 1.0, reason)


def _too_few_views(verdicts: Mapping[str, ViewVerdict]) -> str:
    """Summarise why no two views can be used."""
    by_reason: dict[str, list[str]] = {}
    for camera, verdict in verdicts.items():
        if not verdict.used:
            by_reason.setdefault(verdict.reason, []).append(camera)
    listed = "; ".join(f"{', '.join(cameras)}: {reason}" for reason, cameras in by_reason.items())
    return f"fewer than two views can be used ({listed})"


def _without_left_out(scheme: Scheme, pixels: np.ndarray, judged: Judgement) -> np.ndarray:
    """Landmarks [V, N, 2] with NaN for those of keypoints that the view does not contribute."""
    pixels = pixels.copy()
    for index, name in enumerate(CANONICAL_KEYPOINTS):
        left_out = np.flatnonzero(~judged.kept[:, index])
        pixels[left_out[:, None], list(scheme.keypoints[name])] = np.nan
    return pixels


def _deviations(
    cameras: Views, found: Sequence[ViewLandmarks], face: np.ndarray, shares: np.ndarray
) -> np.ndarray:
    """Standard deviations [N, V] in pixels: the detector's, and shares [V, N] of the face's size in the image."""
    own = np.stack([view.sigma for view in found], axis=-1).astype(np.float64)
    known = face[np.isfinite(face).all(-1)]
    rotation, centre = cameras.world_from_camera[:, :, :3], cameras.world_from_camera[:, :, 3]
    depth = np.einsum("va,va->v", known.mean(0) - centre, rotation[:, :, 2])
    focal = np.sqrt(cameras.intrinsics[:, 0] * cameras.intrinsics[:, 1])
    size = eye_distance(face)
    if not np.isfinite(size):
        size = np.linalg.norm(known[:, None] - known, axis=-1).max()
    return np.hypot(own, shares.T * size * focal / depth)


def _triangulate(
    cameras: Views,
    pixels: np.ndarray,
    sigmas: np.ndarray,
    options: AlignmentOptions,
) -> tuple[Triangulation, np.ndarray, float]:
    """Triangulate all landmarks; scale deviations and covariances by what the residuals say.

    Returns:
        the landmarks; their scaled deviations [N, V]; the scale.
    """
    measured = np.swapaxes(pixels, 0, 1)
    result = triangulate(cameras, measured, sigmas, options.triangulation)
    scale = _noise_scale(result, sigmas)
    covariance = result.covariance * scale**2
    return replace(result, covariance=covariance), sigmas * scale, scale


def _noise_scale(result: Triangulation, sigmas: np.ndarray) -> float:
    """Robust standard deviation of the whitened residuals, 1 where there are none.

    A point from n views has 2n - 3 degrees of freedom among its 2n residuals, which makes these shorter.
    """
    views = result.inliers.sum(-1)
    freedom = np.sqrt(np.maximum(2 * views - 3, 0) / np.maximum(2 * views, 1))
    usable = result.inliers & (views > 2)[:, None]
    whitened = (result.residuals / sigmas)[usable] / np.broadcast_to(freedom[:, None], usable.shape)[usable]
    if not len(whitened):
        return 1.0
    return float(np.sqrt(np.median(whitened**2) / MEDIAN_SQUARE))
