"""`align_photos`: one to seven photographs of one still person, from one phone, become cameras and a face.

What is modelled is what such photographs can tell: one focal length, a principal point at the centre, distortion
only where it shows, a pose for each photograph, and a face drawn from the Gaussian of `face`. The result is the
most probable scene and its covariance, so that one photograph gives an answer too, and says how little it knows.
"""

from collections.abc import Sequence

import numpy as np

from preface.align.errors import AlignmentError
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.photos import trust
from preface.align.photos.face import face_prior, keypoint_weights
from preface.align.photos.given import triangulate_given
from preface.align.photos.measure import (
    Lengths,
    Scale,
    camera_covariance,
    distance,
    face_points,
    scale_of,
)
from preface.align.photos.noise import OUTLIER, OUTLIER_DISTANCE, residual_deviations
from preface.align.photos.projection import project
from preface.align.photos.solve import Solution, solve
from preface.align.photos.views import PhotoAlignment, PhotoOptions, PhotoView, check_views
from preface.capture.rig import ReprojectionError, Rig, RigCamera, StandardDeviations
from preface.geometry import Camera, Rigid

TAKE = "photos"


def align_photos(
    views: Sequence[PhotoView], cameras: Rig | None = None, options: PhotoOptions | None = None
) -> PhotoAlignment:
    """Find cameras and face of photographs of one still person.

    Args:
        views: the photographs with FaceMesh landmarks.
        cameras: calibrated cameras by the photographs' ids; then only the face and the scale are found.
        options: settings.

    Raises:
        AlignmentError: no photograph can be used, or landmarks, cameras and options do not belong together; the
            message names the photograph and the remedy.
    """
    options = options or PhotoOptions()
    check_views(views, options)
    if cameras is not None:
        return triangulate_given(views, cameras, options)
    solution = solve(views, options)
    if not isinstance(solution, Solution):
        reasons = "; ".join(f"{name}: {reason}" for name, reason in solution.items())
        raise AlignmentError(
            f"no photograph can be used ({reasons}); give one that shows the face upright and whole"
        )
    return _alignment(solution, [views[index] for index in solution.used], options)


def _alignment(solution: Solution, views: list[PhotoView], options: PhotoOptions) -> PhotoAlignment:
    scene, covariance = solution.adjusted.scene, solution.adjusted.covariance
    ids = [view.id for view in views]
    known, warnings = options.known_distance, list(solution.warnings)
    if known and known[0] not in CANONICAL_KEYPOINTS and not {known[0], known[1]} <= set(ids):
        reasons = "; ".join(f"{name}: {reason}" for name, reason in solution.excluded.items())
        raise AlignmentError(
            f"known_distance: {known[0]} or {known[1]} is not used ({reasons}); give two others"
        )
    scale = scale_of(scene, solution.face, ids, known, options.known_distance_deviation)
    points, spread = scale.apply(face_points(scene, solution.face), covariance)
    spread = spread + (scale.factor * solution.face.rest[:, None, None]) ** 2 * np.eye(3)
    five = face_points(scene, solution.face, keypoint_weights())
    keypoints, keypoint_spread = scale.apply(five, covariance)
    share = 1 - np.trace(keypoint_spread, axis1=1, axis2=2) / _expected_variance()
    share = np.clip(share, 0.0, 1.0)
    eyes, eyes_deviation = _eyes(five, scale, covariance)
    residuals, inliers = _residuals(solution, views)
    depths = scale.factor * scene.translations()[:, 2]
    said = [
        *trust.lens_trust(solution, views),
        *trust.distance_trust(solution, views, depths),
        trust.scale_trust(options, eyes, eyes_deviation, "given" if known else "expectation"),
        *trust.keypoint_trust(keypoints, keypoint_spread, share),
    ]
    for view, inflation in zip(views, solution.adjusted.noise.inflation, strict=True):
        warnings += view.landmarks.warnings
        if inflation > 1.5:
            warnings.append(f"'{view.id}': its landmarks are {inflation:.1f} times worse than usual")
    return PhotoAlignment(
        rig=_rig(solution, views, scale, residuals, inliers),
        points=points,
        covariance=spread,
        keypoints=keypoints,
        keypoint_covariance=keypoint_spread,
        from_photographs=share,
        views=tuple(ids),
        inliers=inliers,
        residuals=residuals,
        excluded=solution.excluded,
        trust=tuple(said),
        warnings=tuple(warnings),
    )


def _expected_variance() -> np.ndarray:
    """[5] total variance of the keypoints of the expected face, metres²."""
    face = face_prior()
    return (np.einsum("mn,nck->mck", keypoint_weights(), face.basis) ** 2).sum((1, 2))


def _eyes(five: Lengths, scale: Scale, covariance: np.ndarray) -> tuple[float, float]:
    """Distance of the outer eye corners and its deviation, metres."""
    apart, gradient = distance(five, 0, 1)
    gradient = scale.factor * (gradient + apart * scale.by_scene)
    apart *= scale.factor
    return apart, float(np.sqrt(gradient @ covariance @ gradient + (apart * scale.deviation) ** 2))


def _residuals(solution: Solution, views: list[PhotoView]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [V, N], and which landmarks agree."""
    scene, face, observations = solution.adjusted.scene, solution.face, solution.observations
    points = face.points(scene.shape)
    sides = np.array([view.longer_side for view in views])
    residuals = sides[:, None] * np.linalg.norm(observations.image - project(scene, points), axis=-1)
    relative = residual_deviations(observations, scene, face.rest, points)
    near = residuals < OUTLIER_DISTANCE * (sides * np.exp(scene.placement[:, 2]))[:, None]
    return residuals, near & (relative / solution.adjusted.noise.inflation[:, None] < OUTLIER)


def _rig(
    solution: Solution, views: list[PhotoView], scale: Scale, residuals: np.ndarray, inliers: np.ndarray
) -> Rig:
    scene = solution.adjusted.scene
    moved = scale.factor * scene.translations()
    cameras = {}
    for index, view in enumerate(views):
        focal, centre = view.longer_side * float(np.exp(scene.log_focal)), (view.width / 2, view.height / 2)
        spread = camera_covariance(scene, index, view.longer_side, scale, solution.adjusted.covariance)
        if solution.lens.distortion_deviation:
            model, params = "SIMPLE_RADIAL", [focal, *centre, scene.distortion]
            which = [0, None, None, 1]
        else:
            model, params = "PINHOLE", [focal, focal, *centre]
            which = [0, 0, None, None]
        full = _spread_of(spread, [*which, 2, 3, 4, 5, 6, 7])
        deviations = np.sqrt(np.diag(full))
        count = len(params)
        good = residuals[index][inliers[index]]
        cameras[view.id] = RigCamera.at(
            Camera(model, view.width, view.height, np.array(params)),
            Rigid(scene.rotation[index], moved[index]),
            reprojection_error=ReprojectionError(
                float(np.sqrt(np.mean(good**2))), float(np.median(good)), len(good)
            ),
            standard_deviations=StandardDeviations(
                tuple(deviations[:count].tolist()),
                tuple(deviations[count : count + 3].tolist()),
                tuple(deviations[count + 3 :].tolist()),
            ),
            covariance=tuple(tuple(row) for row in full.tolist()),
        )
    where = "the known distance" if scale.deviation else "the size of faces"
    return Rig(TAKE, cameras, metadata={"scale": f"from {where}", "frame": "face"})


def _spread_of(covariance: np.ndarray, which: list[int | None]) -> np.ndarray:
    """Covariance of a list of quantities given by index; None is held still."""
    chosen = np.zeros((len(which), len(covariance)))
    for row, column in enumerate(which):
        if column is not None:
            chosen[row, column] = 1.0
    return chosen @ covariance @ chosen.T
