"""From first poses to the most probable scene: focal length, EXIF's word on it, distortion, and views that differ."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from preface.align.keypoints import FACEMESH478
from preface.align.photos.adjustment import Adjusted, LensPrior, adjust
from preface.align.photos.correction import corrected
from preface.align.photos.face import FacePrior, face_prior
from preface.align.photos.initial import ViewProblemError, first_pose
from preface.align.photos.noise import Observations
from preface.align.photos.projection import Scene
from preface.align.photos.views import PhotoOptions, PhotoView, Source, observe

COARSE = 60  # directions of the face while choices are made
# EXIF is disbelieved when the photographs differ from it by so many deviations, or when no camera has it. FaceMesh
# bends perspective: of rendered heads whose focal length was 2.3 longer sides it made 1.1, over 3 deviations off.
DISBELIEF = 6.0
FOCAL_RANGE = (0.3, 12.0)  # longer sides
# Radial distortion: what lenses have, and what makes it worth modelling.
DISTORTION_DEVIATION = 0.10
DISTORTION_KNOWN, DISTORTION_SIGNIFICANT = 0.03, 3.0
# A view is of something else when its landmarks are this many times worse than assumed.
MAX_INFLATION = 6.0
# An image is mirrored when the mirrored face of the other views explains it better by this cost (twice the
# logarithm of the odds). Unmirrored views gave -148 to 11, mirrored ones 12 to 148: only clear cases are named.
MIRROR_GAIN = 25.0


@dataclass(frozen=True, eq=False)
class Solution:
    """The scene and how it came about.

    Attributes:
        adjusted: cameras, face and covariance.
        face: the expected face whose coefficients ``adjusted`` holds.
        used: indices of the views in ``adjusted``.
        observations: of the used views, corrected.
        lens: what was believed about the lens.
        focal_source: "exif" or "expectation".
        excluded: reasons by view id.
        warnings: sentences.
    """

    adjusted: Adjusted
    face: FacePrior
    used: tuple[int, ...]
    observations: Observations
    lens: LensPrior
    focal_source: Source
    excluded: dict[str, str]
    warnings: tuple[str, ...]


def solve(views: Sequence[PhotoView], options: PhotoOptions) -> Solution | dict[str, str]:
    """Find the most probable cameras and face; the reasons by view id when no view can be used."""
    face, observations = face_prior(), observe(views)
    coarse = face.first(COARSE)
    expected = LensPrior(float(np.log(options.focal_prior[0])), options.focal_prior[1])
    start, used, excluded = _start(views, observations, coarse, expected)
    if start is None:
        return excluded
    free = adjust(observations.views(used), coarse, expected, start)
    free, used, odd = _without_odd_views(views, observations, coarse, expected, free, used)
    excluded |= odd
    found = observations.views(used)
    observations = corrected(found, free.scene, coarse, options.bias)
    if options.bias is not None:
        free = adjust(observations, coarse, expected, free.scene)
    lens, source, warnings = _believed(views, used, options, expected, free)
    fit = (
        free
        if lens == expected
        else adjust(observations, coarse, lens, replace(free.scene, log_focal=lens.log_focal))
    )
    lens, fit = _distortion(observations, coarse, lens, fit)
    observations = corrected(found, fit.scene, coarse, options.bias)
    shape = np.concatenate([fit.scene.shape, np.zeros(face.basis.shape[-1] - COARSE)])
    final = adjust(observations, face, lens, replace(fit.scene, shape=shape))
    return Solution(final, face, tuple(used), observations, lens, source, excluded, tuple(warnings))


def _start(
    views: Sequence[PhotoView], observations: Observations, face: FacePrior, lens: LensPrior
) -> tuple[Scene | None, np.ndarray, dict[str, str]]:
    poses, used, excluded = [], [], {}
    for index, view in enumerate(views):
        try:
            poses.append(first_pose(face.mean, observations.image[index], view.longer_side))
            used.append(index)
        except ViewProblemError as problem:
            excluded[view.id] = str(problem)
    if not poses:
        return None, np.array(used, dtype=int), excluded
    shape = np.zeros(face.basis.shape[-1])
    rotation, placement = np.stack([p.rotation for p in poses]), np.stack([p.placement for p in poses])
    return Scene(lens.log_focal, 0.0, rotation, placement, shape), np.array(used), excluded


def _without_odd_views(
    views: Sequence[PhotoView],
    observations: Observations,
    face: FacePrior,
    lens: LensPrior,
    fit: Adjusted,
    used: np.ndarray,
) -> tuple[Adjusted, np.ndarray, dict[str, str]]:
    """Leave out, one after the other, views that the face of the others does not explain."""
    excluded: dict[str, str] = {}
    while len(used) > 1:
        reasons = {}
        if fit.noise.inflation.max() > MAX_INFLATION:
            worst = int(np.argmax(fit.noise.inflation))
            times = fit.noise.inflation[worst]
            reasons[worst] = f"its landmarks are {times:.0f} times worse than usual: another face, or none"
        elif len(used) > 2:
            reasons = _mirrored(observations.views(used), face, lens, fit)
        if not reasons:
            break
        view, reason = next(iter(reasons.items()))
        excluded[views[used[view]].id] = reason
        keep = np.arange(len(used)) != view
        used = used[keep]
        fit = adjust(observations.views(used), face, lens, fit.scene.views(keep))
    return fit, used, excluded


def _mirrored(observations: Observations, face: FacePrior, lens: LensPrior, fit: Adjusted) -> dict[int, str]:
    """The view that a mirrored face explains much better, if there is one.

    FaceMesh draws an upright face into a mirrored image too, so that only the person's asymmetry tells.
    """
    gains = []
    for view in range(len(observations.image)):
        keep = np.arange(len(observations.image)) != view
        others = adjust(observations.views(keep), face, lens, fit.scene.views(keep))
        points = face.points(others.scene.shape)
        known = LensPrior(others.scene.log_focal, 0.02)
        costs = []
        for shape in (points, points[FACEMESH478.mirror] * [-1.0, 1.0, 1.0]):
            rigid = FacePrior(shape, np.zeros((*shape.shape, 1)), face.rest)
            alone = replace(fit.scene.views(~keep), log_focal=known.log_focal, shape=np.zeros(1))
            costs.append(adjust(observations.views(~keep), rigid, known, alone).cost)
        gains.append(costs[0] - costs[1])
    best = int(np.argmax(gains))
    if gains[best] < MIRROR_GAIN:
        return {}
    return {best: "it is mirrored: the mirrored face of the other photographs fits it better"}


def _believed(
    views: Sequence[PhotoView], used: np.ndarray, options: PhotoOptions, expected: LensPrior, free: Adjusted
) -> tuple[LensPrior, Source, list[str]]:
    """EXIF's focal length if it can be believed, and otherwise what is expected of phones."""
    focals = {views[i].id: views[i].exif_focal / views[i].longer_side for i in used if views[i].exif_focal}
    if not focals:
        return expected, "expectation", []
    warnings, values = [], np.array(list(focals.values()))
    focal = float(np.median(values))
    if not np.isfinite(values).all() or not (FOCAL_RANGE[0] < focal < FOCAL_RANGE[1]):
        text = f"EXIF's focal length of {focal:.3g} longer sides of the image is that of no camera: it was ignored"
        return expected, "expectation", [text]
    if values.max() > (1 + options.exif_deviation) * values.min():
        warnings.append(
            f"EXIF gives focal lengths from {values.min():.3g} to {values.max():.3g} longer sides of the image: "
            "the photographs are taken to share one lens and zoom; give those of one"
        )
    found, deviation = _without_expectation(expected, free)
    if abs(np.log(focal) - found) > DISBELIEF * np.hypot(deviation, options.exif_deviation):
        warnings.append(
            f"EXIF's focal length of {focal:.2f} longer sides of the image contradicts the photographs, which "
            f"say {np.exp(found):.2f} ± {deviation:.0%}: it was ignored"
        )
        return expected, "expectation", warnings
    return LensPrior(float(np.log(focal)), options.exif_deviation), "exif", warnings


def _without_expectation(expected: LensPrior, free: Adjusted) -> tuple[float, float]:
    """What the photographs alone say of the focal length's logarithm: mean and deviation (inf: nothing)."""
    both, believed = 1 / free.covariance[0, 0], 1 / expected.log_focal_deviation**2
    alone = both - believed
    if alone <= 0:
        return expected.log_focal, float("inf")
    mean = (free.scene.log_focal * both - expected.log_focal * believed) / alone
    return float(mean), float(alone**-0.5)


def _distortion(
    observations: Observations, face: FacePrior, lens: LensPrior, fit: Adjusted
) -> tuple[LensPrior, Adjusted]:
    """Free the radial coefficient where the photographs determine it and it differs from zero."""
    freed = replace(lens, distortion_deviation=DISTORTION_DEVIATION)
    bent = adjust(observations, face, freed, fit.scene)
    deviation = float(np.sqrt(bent.covariance[1, 1]))
    known = deviation < DISTORTION_KNOWN
    return (
        (freed, bent)
        if known and abs(bent.scene.distortion) > DISTORTION_SIGNIFICANT * deviation
        else (lens, fit)
    )
