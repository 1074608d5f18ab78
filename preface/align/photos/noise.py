"""What FaceMesh's points are worth: independent and correlated errors, and weights for outliers.

FaceMesh's errors are not independent from point to point: it draws a face, and where it is wrong it is wrong for
a whole cheek. Taking 478 points for 478 measurements would make poses look far better known than they are, and
let the smallest bias decide the focal length. So the errors are modelled as a Gaussian process on the face. Its
numbers come from FaceMesh against the true points of the synthetic studio, 8 heads in 12 views: 1.2 mm from the
front, 2.2 mm at 25 degrees, 3.3 mm at 48; correlated by 0.75 between neighbours, 0.4 at 25 mm, 0.1 at 50 mm; five
times larger at the ears. Points behind the eye corners slide along the silhouette when the head turns, all in the
sense of a smaller turn. No variance can stand for that, so they are given hardly any weight: with 15 mm in place
of EDGE_RANGE's 3 mm, angles between real views came out 18% too small, and with 3 mm 6%.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import lapack

from preface.align.photos.face import IRISES, distances, face_prior
from preface.align.photos.projection import Scene, project

# Standard deviations on the face seen from the front, metres, and the range over which errors resemble each other.
CORRELATED_DEVIATION, CORRELATED_RANGE = 0.0010, 0.030
OWN_DEVIATION = 0.0004
ANGLE_RANGE = np.radians(25)  # from the front, over which deviations grow by themselves
EDGE_RANGE = 0.003  # metres behind the outer eye corners over which deviations grow by themselves: see above
MAX_EDGE = 5.0  # of that growth; what lies further back is not used at all
IRIS_FACTOR = 4.0  # eyes follow the photographer
MIN_CONFIDENCE = 0.05
# Errors over this many standard deviations count less and less (Cauchy).
ROBUST_SCALE = 3.0
# A landmark is called an outlier beyond so many standard deviations, or so many metres on the face.
OUTLIER, OUTLIER_DISTANCE = 5.0, 0.02


@dataclass(frozen=True, eq=False)
class Observations:
    """Landmarks of several views in longer sides about the image centres.

    Attributes:
        image: [V, N, 2], NaN where not seen.
        sigma: [V, N] standard deviation by the detector.
        confidence: [V, N] in 0 to 1.
    """

    image: np.ndarray
    sigma: np.ndarray
    confidence: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Bool [V, N]."""
        return np.isfinite(self.image).all(-1)

    def views(self, keep: np.ndarray) -> "Observations":
        """Some of the views."""
        return Observations(self.image[keep], self.sigma[keep], self.confidence[keep])


@dataclass(frozen=True, eq=False)
class Noise:
    """Covariances of the coordinates of one view's landmarks, the same for x and y, and their whitening.

    Attributes:
        variance: [V, N] of each landmark, without regard to outliers.
        whitening: [V, N, N]: whitening @ residuals have unit covariance; rows and columns of unseen are zero.
        inflation: [V] by which the assumed deviations had to grow, at least 1.
    """

    variance: np.ndarray
    whitening: np.ndarray
    inflation: np.ndarray


def assumed_noise(observations: Observations, scene: Scene, rest: np.ndarray) -> Noise:
    """The noise before any residual is looked at.

    Args:
        observations: the landmarks.
        scene: for the sizes of the face in the images.
        rest: [N] deviation in metres of what the face's basis leaves out.
    """
    flat = np.zeros((*observations.image.shape[:2], 1))
    return _noise(observations, scene, rest, np.ones(len(flat)), np.ones(flat.shape[:2]))


def robust_noise(observations: Observations, scene: Scene, rest: np.ndarray, points: np.ndarray) -> Noise:
    """The noise after a look at the residuals: views that are worse than assumed, and outliers, count less.

    The remaining arguments are those of `assumed_noise`; points [N, 3] are the face as it now is.
    """
    standardised = residual_deviations(observations, scene, rest, points)
    # The median of the length of two unit Gaussians is 1.18.
    inflation = np.array([np.median(row[np.isfinite(row)]) for row in standardised]) / 1.18
    inflation = np.maximum(inflation, 1.0)
    relative = standardised / inflation[:, None]
    weight = 1 / (1 + (np.where(np.isfinite(relative), relative, np.inf) / ROBUST_SCALE) ** 2)
    return _noise(observations, scene, rest, inflation, weight)


def residual_deviations(
    observations: Observations, scene: Scene, rest: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Lengths of the residuals [V, N] in assumed standard deviations of a coordinate; NaN where not seen."""
    residuals = observations.image - project(scene, points)
    own, shared = deviations(observations, scene, rest)
    return np.linalg.norm(residuals, axis=-1) / np.hypot(own, shared)


def deviations(observations: Observations, scene: Scene, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Independent and correlated deviations [V, N], longer sides."""
    scale = np.exp(scene.placement[:, 2])[:, None]
    factor = _edge().copy()
    factor[list(IRISES)] = IRIS_FACTOR
    angle = np.arccos(np.clip(-scene.rotation[:, 2, 2], -1.0, 1.0))
    factor = (
        (1 + angle / ANGLE_RANGE)[:, None]
        * factor
        / np.sqrt(np.clip(observations.confidence, MIN_CONFIDENCE, 1.0))
    )
    own = np.sqrt((scale * factor * OWN_DEVIATION) ** 2 + (scale * rest) ** 2 + observations.sigma**2)
    return own, scale * factor * CORRELATED_DEVIATION


def _noise(
    observations: Observations,
    scene: Scene,
    rest: np.ndarray,
    inflation: np.ndarray,
    weight: np.ndarray,
) -> Noise:
    own, shared = (inflation[:, None] * part for part in deviations(observations, scene, rest))
    alike = _alike()
    variance = own**2 + shared**2
    whitening = np.zeros((len(own), *alike.shape))
    for view, seen in enumerate(observations.seen):
        some = np.flatnonzero(seen & (weight[view] > 0) & (_edge() <= MAX_EDGE))
        covariance = shared[view, some, None] * alike[np.ix_(some, some)] * shared[view, some]
        # An outlier is a landmark of great variance of its own.
        own_variance = own[view, some] ** 2 + variance[view, some] * (1 / weight[view, some] - 1)
        covariance[np.diag_indices(len(some))] += own_variance
        inverse, _ = lapack.dtrtri(np.linalg.cholesky(covariance), lower=1)
        whitening[view][np.ix_(some, some)] = inverse
    return Noise(variance, whitening, inflation)


@cache
def _edge() -> np.ndarray:
    """Factors [N] of the deviation of points behind the outer eye corners."""
    depth = face_prior().mean[:, 2]
    return 1 + np.maximum(0.5 * (depth[33] + depth[263]) - depth, 0) / EDGE_RANGE


@cache
def _alike() -> np.ndarray:
    """How much the errors of landmarks resemble each other [N, N], by their distance on the expected face."""
    return np.exp(-distances(face_prior().mean) / CORRELATED_RANGE)
