"""Choosing the camera model of photographs: by sightings held out, and by what lenses look like.

Self-calibration can lower the error of its own sightings with a principal point at the image's edge or with
absurd tangential terms. Two things keep it honest. Each candidate is fitted without some sightings and
judged on those. And a lens must be plausible: no phone or camera has its axis far from the image's centre.
Of the plausible candidates the simplest is chosen that is within one standard error of the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from preface.capture.photos.adjustment import Refine, adjust
from preface.capture.photos.structure import Structure, Tracks, rms
from preface.capture.photos.uncertainty import lens_deviations
from preface.geometry.cameras import CAMERA_MODELS, Camera

# From simple to complex: each has more freedom than those before.
MODELS = ("PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
# A held-out sighting must leave its point this many others, so that a mismatch cannot carry it along.
MIN_REMAINING = 3
# Larger held-out errors count as this many pixels: mapping lets none of its own sightings err by more, so
# that these are mismatches, which say nothing about lenses.
MAX_ERROR = 4.0
# Fewer held-out sightings than this do not choose a lens.
MIN_HELD_OUT = 100
# More sightings than this choose no better: differences between photographs, not noise, limit the choice.
MAX_SIGHTINGS = 20_000

# Plausibility. Calibrated photographic lenses have their axis within a few per cent of the centre (more only
# in cropped images) and tangential terms of the order of 1e-3; these bounds leave room.
MAX_OFFSET = 0.10  # of the principal point, in image widths and heights
MAX_TANGENTIAL = 0.01
FOCAL_RANGE = (0.4, 5.0)  # in the longer side: fields of view of 103 to 11 degrees
MAX_ASPECT = 0.05
# The principal point counts as determined when it is known to 1% of the image and off-centre by 3 sigma.
MAX_POINT_DEVIATION = 0.01
MIN_POINT_SIGNIFICANCE = 3.0
# A focal length known no better is worth a remark.
MAX_FOCAL_DEVIATION = 0.05


class NoPlausibleModelError(Exception):
    """Every candidate met an objection; the message lists them."""


@dataclass(frozen=True)
class HeldOut:
    """Errors on sightings that the fits did not see.

    Attributes:
        errors: [H] pixels, at most `MAX_ERROR`.
        image: [H] the photograph of each.
    """

    errors: np.ndarray
    image: np.ndarray

    def mean_squares(self, count: int) -> np.ndarray:
        """Mean square error of each of ``count`` photographs, NaN where nothing was held out."""
        counts = np.bincount(self.image, minlength=count)
        sums = np.bincount(self.image, self.errors**2, minlength=count)
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


@dataclass(frozen=True)
class Candidate:
    """One way to model the lens, fitted.

    Attributes:
        model: COLMAP's name.
        refine: what was free.
        structure: the fit to all sightings.
        training_error: its RMS in pixels, errors over `MAX_ERROR` counted as that.
        held_out: None where there were too few tracks to hold anything out.
        deviations: standard deviations of each camera's params.
        objections: why it is not plausible; empty when it is.
    """

    model: str
    refine: Refine
    structure: Structure
    training_error: float
    held_out: HeldOut | None
    deviations: tuple[np.ndarray, ...]
    objections: tuple[str, ...]

    @property
    def free_parameters(self) -> int:
        """Of one camera."""
        return len(CAMERA_MODELS[self.model]) - (0 if self.refine.principal_point else 2)

    @property
    def held_out_error(self) -> float | None:
        """RMS in pixels over all held-out sightings."""
        return None if self.held_out is None else rms(self.held_out.errors)

    def summary(self) -> dict[str, object]:
        """A row of the table of candidates, for reports and JSON."""
        camera, deviations = self.structure.cameras[0], self.deviations[0]
        names = CAMERA_MODELS[self.model]
        return {
            "model": self.model,
            "principal_point": "free" if self.refine.principal_point else "centre",
            "free_parameters": self.free_parameters,
            "training_rms": self.training_error,
            "held_out_rms": self.held_out_error,
            "held_out_count": 0 if self.held_out is None else len(self.held_out.errors),
            "params": dict(zip(names, camera.params.tolist(), strict=True)),
            # JSON has no infinity: null says undetermined.
            "standard_deviations": {
                name: float(value) if np.isfinite(value) else None
                for name, value in zip(names, deviations, strict=True)
            },
            "objections": list(self.objections),
        }


def choose_model(
    structure: Structure, tracks: Tracks, folds: int, seed: int, threads: int
) -> tuple[tuple[Candidate, ...], int]:
    """Fit and judge the candidates.

    The models come first, with the principal point at the centre. The one that wins is tried once more with
    a free principal point, which must win again. Of many tracks a random `MAX_SIGHTINGS` are used.

    Args:
        structure: where to start; its lenses give the focal length.
        tracks: the sightings.
        folds: in how many parts sightings are held out.
        seed: which ones.
        threads: for Ceres.

    Returns:
        The candidates from simple to complex, and the index of the chosen one.

    Raises:
        NoPlausibleModelError: no candidate is plausible.
    """
    tracks = thinned(tracks, MAX_SIGHTINGS, seed)
    candidates = [
        fit_candidate(as_model(structure, model), tracks, Refine(True, False), folds, seed, threads)
        for model in MODELS
    ]
    chosen = candidates[select(candidates, len(tracks.camera_of_image))]
    free = fit_candidate(chosen.structure, tracks, Refine(True, True), folds, seed, threads)
    candidates.insert(candidates.index(chosen) + 1, free)
    return tuple(candidates), select(candidates, len(tracks.camera_of_image))


def fit_candidate(
    start: Structure, tracks: Tracks, refine: Refine, folds: int, seed: int, threads: int
) -> Candidate:
    """Fit one camera model to all sightings, and judge it on held-out ones and by plausibility."""
    fitted = adjust(start, tracks, refine, threads)
    training = np.minimum(fitted.reprojection_errors(tracks), MAX_ERROR)
    deviations = tuple(lens_deviations(fitted, tracks, refine))
    objections = [
        objection
        for camera, sigma in zip(fitted.cameras, deviations, strict=True)
        for objection in (*lens_objections(camera), *point_objections(camera, sigma, refine))
    ]
    held_out = held_out_errors(fitted, tracks, refine, folds, seed, threads)
    return Candidate(
        fitted.cameras[0].model, refine, fitted, rms(training), held_out, deviations, tuple(objections)
    )


def held_out_errors(
    start: Structure, tracks: Tracks, refine: Refine, folds: int, seed: int, threads: int
) -> HeldOut | None:
    """Errors of sightings when lenses, poses and points are fitted without them; None if there are too few.

    Each fold leaves out at most one sighting of a point, and at least `MIN_REMAINING` others remain.
    """
    fold = held_out_folds(tracks, folds, seed)
    if np.count_nonzero(fold >= 0) < MIN_HELD_OUT:
        return None
    errors, images = [], []
    for index in range(folds):
        hidden = fold == index
        fitted = adjust(start, tracks.subset(~hidden), refine, threads)
        errors.append(np.minimum(fitted.reprojection_errors(tracks.subset(hidden)), MAX_ERROR))
        images.append(tracks.image[hidden])
    return HeldOut(np.concatenate(errors), np.concatenate(images))


def held_out_folds(tracks: Tracks, folds: int, seed: int) -> np.ndarray:
    """The fold in which each sighting is held out [M], -1 for never.

    Sightings of a point are put in a random order; the first is held out in fold 0, the second in fold 1,
    and so on, of points with more than `MIN_REMAINING` sightings.
    """
    random = np.random.default_rng(seed)
    order = np.lexsort((random.random(len(tracks)), tracks.point))
    _, starts, counts = np.unique(tracks.point[order], return_index=True, return_counts=True)
    rank = np.arange(len(tracks)) - np.repeat(starts, counts)
    fold = np.empty(len(tracks), int)
    fold[order] = np.where((rank < folds) & (np.repeat(counts, counts) > MIN_REMAINING), rank, -1)
    return fold


def thinned(tracks: Tracks, sightings: int, seed: int) -> Tracks:
    """Whole tracks drawn at random, about as many as have the given number of sightings; all if fewer."""
    if len(tracks) <= sightings:
        return tracks
    points = int(tracks.point.max()) + 1
    kept = np.random.default_rng(seed).random(points) < sightings / len(tracks)
    return tracks.subset(kept[tracks.point])


def select(candidates: Sequence[Candidate], images: int) -> int:
    """The index of the simplest plausible candidate within one standard error of the best plausible one.

    The standard error is that of the difference between the two in mean square error, photograph by
    photograph: what one photograph shows is shared by its sightings, which are therefore not independent.
    Without held-out errors the simplest plausible candidate is chosen.

    Args:
        candidates: from simple to complex.
        images: how many photographs there are.

    Raises:
        NoPlausibleModelError: none is plausible.
    """
    plausible = [index for index, candidate in enumerate(candidates) if not candidate.objections]
    if not plausible:
        reasons = "; ".join(f"{candidate.model}: {candidate.objections[0]}" for candidate in candidates)
        raise NoPlausibleModelError(reasons)
    scores = {
        index: held_out.mean_squares(images)
        for index in plausible
        if (held_out := candidates[index].held_out) is not None
    }
    if len(scores) < len(plausible):
        return plausible[0]
    best = min(plausible, key=lambda index: np.nanmean(scores[index]))
    for index in plausible:
        excess = scores[index] - scores[best]
        excess = excess[np.isfinite(excess)]
        if excess.mean() <= excess.std(ddof=1) / np.sqrt(len(excess)):
            return index
    return best


def as_model(structure: Structure, model: str) -> Structure:
    """The structure with lenses of another model and centred principal points, to start a fit from."""
    return Structure(
        tuple(_centred(camera, model) for camera in structure.cameras),
        structure.camera_from_world,
        structure.points,
    )


def lens_objections(camera: Camera) -> list[str]:
    """What about a lens no photograph's camera has; empty when it is plausible."""
    fx, fy, cx, cy = camera.intrinsics[:4]
    p1, p2 = camera.intrinsics[6:8]
    longer = max(camera.width, camera.height)
    objections = []
    for name, value, size in (("cx", cx, camera.width), ("cy", cy, camera.height)):
        if abs(value / size - 0.5) > MAX_OFFSET:
            objections.append(
                f"the principal point's {name} {value:.1f} is {abs(value / size - 0.5):.0%} of {size} px "
                f"away from the centre; over {MAX_OFFSET:.0%} is not plausible"
            )
    for name, value in (("p1", p1), ("p2", p2)):
        if abs(value) > MAX_TANGENTIAL:
            objections.append(f"|{name}| = {abs(value):.4f} is over {MAX_TANGENTIAL}")
    for value in {fx, fy}:
        if not FOCAL_RANGE[0] <= value / longer <= FOCAL_RANGE[1]:
            objections.append(
                f"the focal length {value:.0f} px is {value / longer:.2f} of the image's longer side; "
                f"plausible is {FOCAL_RANGE[0]} to {FOCAL_RANGE[1]}"
            )
    if abs(fx / fy - 1) > MAX_ASPECT:
        objections.append(f"fx/fy = {fx / fy:.3f}, but pixels are square")
    if camera.folds_inside_image():
        objections.append("the distortion folds inside the image")
    return objections


def point_objections(camera: Camera, deviations: np.ndarray, refine: Refine) -> list[str]:
    """Why a free principal point is not determined by the data; empty when it is, or is not free."""
    if not refine.principal_point:
        return []
    names = CAMERA_MODELS[camera.model]
    longer, significances, objections = max(camera.width, camera.height), [], []
    for name, size in (("cx", camera.width), ("cy", camera.height)):
        sigma = deviations[names.index(name)]
        offset = abs(camera.params[names.index(name)] - size / 2)
        significances.append(offset / sigma if sigma > 0 else np.inf)
        if not sigma <= MAX_POINT_DEVIATION * longer:
            objections.append(
                f"{name} is not determined: its standard deviation of {sigma:.1f} px is over "
                f"{MAX_POINT_DEVIATION:.0%} of the longer side"
            )
    if max(significances) < MIN_POINT_SIGNIFICANCE:
        objections.append(
            f"the principal point is within {MIN_POINT_SIGNIFICANCE:.0f} standard deviations of the centre"
        )
    return objections


def _centred(camera: Camera, model: str) -> Camera:
    focal, k1 = float(camera.intrinsics[:2].mean()), float(camera.intrinsics[4])
    values = {"cx": camera.width / 2, "cy": camera.height / 2, "k": k1, "k1": k1}
    values |= dict.fromkeys(("f", "fx", "fy"), focal)
    params = np.array([values.get(name, 0.0) for name in CAMERA_MODELS[model]])
    return Camera(model, camera.width, camera.height, params)
