"""Bundle adjustment of poses, one lens and a Gaussian face: Levenberg-Marquardt with robust, correlated noise.

The face's coefficients and the lens have Gaussian priors, so that the solution is the most probable scene and the
inverse of the normal matrix its covariance. The prior face also holds the frame still.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from preface.align.photos.face import FacePrior
from preface.align.photos.noise import Noise, Observations, assumed_noise, robust_noise
from preface.align.photos.projection import LENS, POSE, Scene, linearise, project

REWEIGHTINGS = 6
STEPS = 6
# Relative fall of the cost that is not worth another step, and largest relative change between two reweightings.
SMALL_FALL, SETTLED = 1e-4, 3e-3
MAX_DAMPING = 1e9
# A parameter that is held still gets this precision.
HELD = 1e12


@dataclass(frozen=True)
class LensPrior:
    """Gaussian beliefs about the lens. A deviation of 0 holds a value still.

    Attributes:
        log_focal, log_focal_deviation: natural logarithm of the focal length in longer sides.
        distortion_deviation: of the radial coefficient, about 0.
    """

    log_focal: float
    log_focal_deviation: float
    distortion_deviation: float = 0.0

    @property
    def precisions(self) -> np.ndarray:
        """[2] inverse variances."""
        deviations = np.array([self.log_focal_deviation, self.distortion_deviation])
        return np.where(deviations > 0, 1 / np.maximum(deviations, 1e-6) ** 2, HELD)


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The most probable scene.

    Attributes:
        scene: cameras and coefficients.
        covariance: [2 + 6 V + K] squared, in the order of `Scene.moved`.
        noise: of the last reweighting.
        cost: twice the negative log-probability up to a constant.
    """

    scene: Scene
    covariance: np.ndarray
    noise: Noise
    cost: float


def adjust(observations: Observations, face: FacePrior, lens: LensPrior, start: Scene) -> Adjusted:
    """Find the most probable scene from a start with K coefficients, those of ``face``.

    Raises:
        np.linalg.LinAlgError: no step from the start makes sense, as with views of nothing.
    """
    scene = start
    noise = assumed_noise(observations, scene, face.rest)
    before = np.inf
    for _ in range(REWEIGHTINGS):
        noise = robust_noise(observations, scene, face.rest, face.points(scene.shape))
        scene, cost, normal = _minimise(observations, face, lens, scene, noise)
        if abs(before - cost) <= SETTLED * cost:
            break
        before = cost
    covariance = cho_solve(cho_factor(normal), np.eye(len(normal)))
    return Adjusted(scene, covariance, noise, cost)


def _minimise(
    observations: Observations, face: FacePrior, lens: LensPrior, scene: Scene, noise: Noise
) -> tuple[Scene, float, np.ndarray]:
    """Levenberg-Marquardt with fixed weights: the scene, its cost and normal matrix."""
    cost, damping = _cost(observations, face, lens, scene, noise), 1e-4
    normal, gradient = _normal(observations, face, lens, scene, noise)
    for _ in range(STEPS):
        damped = normal + damping * np.diag(np.diag(normal))
        step = cho_solve(cho_factor(damped), -gradient)
        candidate = scene.moved(step)
        moved_cost = _cost(observations, face, lens, candidate, noise)
        if not moved_cost < cost:  # also where a point comes to lie behind a camera: NaN
            damping *= 10
            if damping > MAX_DAMPING:
                break
            continue
        finished = cost - moved_cost <= SMALL_FALL * cost
        scene, cost, damping = candidate, moved_cost, max(damping / 10, 1e-9)
        normal, gradient = _normal(observations, face, lens, scene, noise)
        if finished:
            break
    return scene, cost, normal


def _cost(observations: Observations, face: FacePrior, lens: LensPrior, scene: Scene, noise: Noise) -> float:
    residuals = _residuals(observations, project(scene, face.points(scene.shape)))
    return float(
        ((noise.whitening @ residuals) ** 2).sum()
        + lens.precisions @ _lens_offset(lens, scene) ** 2
        + scene.shape @ scene.shape
    )


def _normal(
    observations: Observations, face: FacePrior, lens: LensPrior, scene: Scene, noise: Noise
) -> tuple[np.ndarray, np.ndarray]:
    """Half the Gauss-Newton Hessian of the cost and half its gradient."""
    views, shapes = len(scene.rotation), len(scene.shape)
    linear = linearise(scene, face.points(scene.shape))
    residuals = _residuals(observations, linear.image)
    size = LENS + POSE * views + shapes
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    for view, seen in enumerate(observations.seen):
        by_shape = np.einsum("nca,nak->nck", linear.by_point[view], face.basis)
        jacobian = np.concatenate([linear.by_lens[view], linear.by_pose[view], by_shape], axis=-1)
        jacobian = np.where(seen[:, None, None], jacobian, 0.0)
        whitened = noise.whitening[view] @ jacobian.reshape(len(seen), -1)
        whitened = whitened.reshape(-1, jacobian.shape[-1])  # rows: x and y of a landmark in turn
        error = (noise.whitening[view] @ residuals[view]).reshape(-1)
        first = LENS + POSE * view
        where = np.r_[0:LENS, first : first + POSE, LENS + POSE * views : size]
        normal[np.ix_(where, where)] += whitened.T @ whitened
        gradient[where] -= whitened.T @ error
    diagonal = np.concatenate([lens.precisions, np.zeros(POSE * views), np.ones(shapes)])
    normal[np.diag_indices(size)] += diagonal
    gradient[:LENS] += lens.precisions * _lens_offset(lens, scene)
    gradient[LENS + POSE * views :] += scene.shape
    return normal, gradient


def _residuals(observations: Observations, predicted: np.ndarray) -> np.ndarray:
    """Observed minus predicted [V, N, 2]; zero where not seen, NaN where a seen point cannot be."""
    return np.where(observations.seen[..., None], observations.image - predicted, 0.0)


def _lens_offset(lens: LensPrior, scene: Scene) -> np.ndarray:
    return np.array([scene.log_focal - lens.log_focal, scene.distortion])
