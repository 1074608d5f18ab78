"""Corners to a few hundredths of a pixel: a blurred corner is fitted to the grey values around each.

Around the corner of four squares, or of one tag, the image is modelled as

    I(x) = a + g (x - o) + b S(x),    S = E(d1 / s) E(d2 / s)              where four squares meet
                                      S = (1 + E(d1 / s)) (1 + E(d2 / s)) / 4     at the corner of a tag

with the distances d1, d2 of x from the two edges, whose directions are free, the blur s, and the Gaussian
error function E. The nine parameters are found by Gauss-Newton (the linear ones, a, g and b, among them),
for all corners of an image at once. Two things make this better than cv2.cornerSubPix, which multiplies
gradients in an upright window: the window here follows the board's tilt, and leaves out the markers.

Where four squares meet, the model and the window are symmetric about the corner, so that neither blur nor
a camera's tone curve moves it.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.special import erf

MAX_RADIUS = 12  # pixels; more adds little to the accuracy, and lenses bend the edges
MIN_SQUARE = 6.0  # pixels: below, the blurred edges of a square touch
SMALLEST_BLUR, LARGEST_BLUR = 0.4, 4.0  # standard deviations in pixels; the pixel's own area is 0.29
FIRST_BLUR = 1.2  # wide enough to feel an edge that lies two pixels off
COARSE_STEPS, FINE_STEPS = 3, 15
CONVERGED = 2e-3  # pixels; ten times below the noise of good images
MAX_MISFIT = 0.5  # RMS of the residuals over the contrast b; fingers, glare and marker corners have more
MAX_DEVIATION = 0.25  # pixels; the fit's own standard deviation of a corner
MAX_TURN = 0.35  # radians that an edge may turn away from where the board's pose has it
MAX_SHIFT = 0.2  # of a square, likewise for the corner


class Junction(Enum):
    """What meets at a corner."""

    SQUARES = "the corners of two dark and two bright squares"
    TAG = "the corner of one dark tag on bright ground"


@dataclass(frozen=True)
class Refined:
    """Corners after refinement.

    Attributes:
        pixels: [N, 2] with OpenCV's origin: the centre of the top-left pixel is (0, 0).
        accepted: [N] whether the fit converged near its start, explains the image and is well determined.
        misfit: [N] RMS of the residuals over the contrast.
    """

    pixels: np.ndarray
    accepted: np.ndarray
    misfit: np.ndarray


@dataclass(frozen=True)
class Surroundings:
    """What is printed about a corner.

    Attributes:
        junction: what meets at the corner.
        extent: how far the window may reach along the board's x and y, in squares.
        gap: how far from the two lines through the corner nothing else is printed, in squares; for ChArUco
            the distance from a square's edge to its marker.
        crowded: where print lies beyond the gap: +1 above left and below right of the corner, -1 in the two
            other quadrants, 0 in all four. One number, or one per corner [N].
    """

    junction: Junction = Junction.SQUARES
    extent: float = 0.45
    gap: float = 0.45
    crowded: np.ndarray | int = 0


def refine(grey: np.ndarray, start: np.ndarray, axes: np.ndarray, around: Surroundings) -> Refined:
    """Move corners to where the image has them.

    Args:
        grey: [height, width] of any numeric type, best proportional to light. Values that are not finite
            do not count.
        start: [N, 2] pixels with OpenCV's origin, at most about two pixels off.
        axes: [N, 2, 2] the image of one square's edges at each corner: axes[n, 0] along the board's x, axes[n, 1]
            along its y, in pixels. For a tag they are its edges, from the corner, the second clockwise of
            the first as seen in the image.
        around: what is printed about the corners.
    """
    start = np.asarray(start, np.float64).reshape(-1, 2)
    axes = np.asarray(axes, np.float64).reshape(-1, 2, 2)
    nothing = Refined(start, np.zeros(len(start), bool), np.full(len(start), np.inf))
    if not len(start):
        return nothing
    height = np.abs(np.linalg.det(axes)) / np.linalg.norm(axes, axis=2).max(axis=1)
    radius = int(np.clip(around.extent * np.linalg.norm(axes, axis=2).max(), 3, MAX_RADIUS))
    fit = _Fit.around(grey, start, axes, around, radius)
    parameters = fit.first_guess()
    previous: np.ndarray = np.zeros_like(start)
    pace: np.ndarray = np.ones(len(start))
    for iteration in range(COARSE_STEPS + FINE_STEPS):
        step = fit.step(parameters, blur_is_free=iteration >= COARSE_STEPS)
        # Sharpened images make the steps too long, to and fro across the corner.
        reversed_course = (step[:, :2] * previous).sum(axis=1) < 0
        pace = np.where(reversed_course, pace / 2, np.minimum(1.3 * pace, 1))
        parameters = fit.moved(parameters, step * pace[:, None])
        previous, change = step[:, :2], np.linalg.norm(step[:, :2], axis=1)
        if iteration >= COARSE_STEPS and change.max() < CONVERGED:
            break
    misfit, deviation = fit.quality(parameters)
    shift = np.linalg.norm(parameters[:, :2], axis=1)
    turn = np.abs(parameters[:, 2:4] - fit.angles).max(axis=1)
    accepted = (
        (height >= MIN_SQUARE)
        & fit.enough
        & (change < 10 * CONVERGED)
        & (shift < np.maximum(MAX_SHIFT * height, 1.0))
        & (turn < MAX_TURN)
        & (misfit < MAX_MISFIT)
        & (deviation < MAX_DEVIATION)
        & (parameters[:, 4] < np.minimum(LARGEST_BLUR, height / 3))
    )
    return Refined(start + parameters[:, :2], accepted, misfit)


@dataclass(frozen=True)
class _Fit:
    """The grey values about N corners, P pixels each, and the model of them.

    Parameters [N, 9]: shift of the corner from its start (2), angles of the two edges (2), blur, a, g (2), b.
    """

    offsets: np.ndarray  # [N, P, 2] pixels from the start
    values: np.ndarray  # [N, P]
    weights: np.ndarray  # [N, P] 1 where a pixel counts, else 0
    angles: np.ndarray  # [N, 2] of the edges, as the board's pose has them
    enough: np.ndarray  # [N]
    junction: Junction

    @classmethod
    def around(
        cls,
        grey: np.ndarray,
        start: np.ndarray,
        axes: np.ndarray,
        around: Surroundings,
        radius: int,
    ) -> "_Fit":
        steps = np.arange(-radius, radius + 1)
        grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        pixels = np.rint(start).astype(int)[:, None] + grid  # [N, P, 2]
        limit = np.array(grey.shape[1::-1])
        column, row = np.moveaxis(np.clip(pixels, 0, limit - 1), -1, 0)
        values = grey[row, column].astype(np.float64)
        known = ((pixels >= 0) & (pixels < limit)).all(axis=-1) & np.isfinite(values)
        offsets = pixels - start[:, None]
        wanted = _window(offsets, axes, around, radius)
        counted = wanted & known
        enough = (counted.sum(axis=1) >= 0.7 * wanted.sum(axis=1)) & (counted.sum(axis=1) > 18)
        angles = np.arctan2(axes[..., 1], axes[..., 0])
        # Leave out what no corner counts: the windows are narrow crosses.
        order = np.argsort(~counted, axis=1, kind="stable")[:, : max(counted.sum(axis=1).max(), 1)]
        offsets = np.take_along_axis(offsets, order[..., None], axis=1)
        values = np.take_along_axis(np.where(known, values, 0.0), order, axis=1)
        weights = np.take_along_axis(counted, order, axis=1).astype(np.float64)
        return cls(offsets, values, weights, angles, enough, around.junction)

    def first_guess(self) -> np.ndarray:
        parameters = np.zeros((len(self.values), 9))
        parameters[:, 2:4] = self.angles
        parameters[:, 4] = FIRST_BLUR
        shape, _ = self._shape(parameters)
        basis = np.stack([np.ones_like(shape), self.offsets[..., 0], self.offsets[..., 1], shape], axis=-1)
        parameters[:, 5:] = _solve(basis * self.weights[..., None], basis, self.values)
        return parameters

    def step(self, parameters: np.ndarray, blur_is_free: bool) -> np.ndarray:
        """The Gauss-Newton step [N, 9], at most one pixel long."""
        residuals, jacobian = self._linearised(parameters)
        held = parameters[:, 4] <= SMALLEST_BLUR if blur_is_free else np.ones(len(parameters), bool)
        jacobian[held, :, 4] = 0
        step = _solve(jacobian * self.weights[..., None], jacobian, residuals)
        length = np.linalg.norm(step[:, :2], axis=1)
        step[:, :5] *= np.minimum(1, 1 / np.maximum(length, 1e-12))[:, None]
        return step

    def moved(self, parameters: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The parameters after a step, within their limits."""
        parameters = parameters + step
        turn = parameters[:, 2:4] - self.angles
        parameters[:, 2:4] = self.angles + np.clip(turn, -2 * MAX_TURN, 2 * MAX_TURN)
        parameters[:, 4] = np.clip(parameters[:, 4], SMALLEST_BLUR, LARGEST_BLUR)
        return parameters

    def quality(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """RMS misfit over contrast [N], and the standard deviation of the corners in pixels [N]."""
        residuals, jacobian = self._linearised(parameters)
        freedom = np.maximum(self.weights.sum(axis=1) - 9, 1)
        variance = (self.weights * residuals**2).sum(axis=1) / freedom
        information = np.swapaxes(jacobian * self.weights[..., None], 1, 2) @ jacobian
        covariance = np.linalg.pinv(information, hermitian=True) * variance[:, None, None]
        deviation = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
        return np.sqrt(variance) / np.maximum(np.abs(parameters[:, 8]), 1e-9), deviation

    def _linearised(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Observed minus modelled [N, P], and the model's derivatives [N, P, 9]."""
        shape, slopes = self._shape(parameters)
        contrast = parameters[:, 8, None]
        tilt = (self.offsets * parameters[:, None, 6:8]).sum(axis=-1)
        residuals = self.values - (parameters[:, 5, None] + tilt + contrast * shape)
        linear = [np.ones_like(shape), self.offsets[..., 0], self.offsets[..., 1], shape]
        return residuals, np.concatenate([contrast[..., None] * slopes, np.stack(linear, axis=-1)], axis=-1)

    def _shape(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """S [N, P] and its derivatives by the first five parameters [N, P, 5]."""
        blur = parameters[:, 4, None]
        away = self.offsets - parameters[:, None, :2]
        profiles, derivatives = [], []
        for edge in range(2):
            x, y = np.cos(parameters[:, 2 + edge, None]), np.sin(parameters[:, 2 + edge, None])
            scaled = (x * away[..., 1] - y * away[..., 0]) / blur
            along = (x * away[..., 0] + y * away[..., 1]) / blur
            steepness = np.sqrt(2 / np.pi) * np.exp(-(scaled**2) / 2)
            profile = erf(scaled / np.sqrt(2))
            if self.junction is Junction.TAG:  # bright outside: half of a step, rising into the tag
                sign = 1 if edge == 0 else -1
                profile, steepness = (1 + sign * profile) / 2, sign * steepness / 2
            turns = [-along * steepness if e == edge else np.zeros_like(along) for e in range(2)]
            moves = [y / blur * steepness, -x / blur * steepness]
            profiles.append(profile)
            derivatives.append(np.stack([*moves, *turns, -scaled / blur * steepness], axis=-1))
        slopes = derivatives[0] * profiles[1][..., None] + derivatives[1] * profiles[0][..., None]
        return profiles[0] * profiles[1], slopes


def _window(offsets: np.ndarray, axes: np.ndarray, around: Surroundings, radius: int) -> np.ndarray:
    """Which pixels [N, P] count: within its extent and clear of other print."""
    place = np.einsum("npi,nij->npj", offsets, np.linalg.pinv(axes))  # in the board's frame
    empty = np.prod(place, axis=-1) * np.reshape(around.crowded, (-1, 1)) < 0
    squares = np.abs(place)
    # Blur carries what lies at the gap about a pixel and a half this way.
    clear = np.maximum(around.gap - 1.5 / np.linalg.norm(axes, axis=2).min(axis=1), 0.06)[:, None]
    near = (squares < around.extent).all(axis=-1) & (np.linalg.norm(offsets, axis=-1) <= radius)
    return near & (empty | (squares.min(axis=-1) < clear))


def _solve(weighted: np.ndarray, jacobian: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Weighted least squares for each corner [N, K]; parameters without a say stay as they are."""
    normal = np.swapaxes(weighted, 1, 2) @ jacobian
    right = (np.swapaxes(weighted, 1, 2) @ residuals[..., None])[..., 0]
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-12))
    scaled = normal / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(normal.shape[-1])
    return np.linalg.solve(scaled, (right / scale)[..., None])[..., 0] / scale
