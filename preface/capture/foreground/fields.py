"""Operations on low-resolution fields: filling gaps smoothly, fitting slow variation, tidying binary masks."""

from __future__ import annotations

import cv2
import numpy as np

SAMPLES = 5_000  # pixels that a statistic over an image is taken from
FILL_SOFTNESS = 0.02  # weight of the coarser level where the finer one has data of weight one


def push_pull(values: np.ndarray, weights: np.ndarray, blur: float) -> np.ndarray:
    """Fill a field smoothly from where it is known (Gortler et al. 1996, The Lumigraph, section 3.3).

    Args:
        values: float32 [h, w, c].
        weights: float32 [h, w] >= 0, 0 where a value is unknown.
        blur: standard deviation, pixels, of the smoothing of known values; 0 for none.

    Returns:
        float32 [h, w, c]; zeros when every weight is zero.
    """
    weighted = values * weights[..., None]
    if blur > 0:
        weighted = cv2.GaussianBlur(weighted, (0, 0), blur).reshape(values.shape)
        weights = cv2.GaussianBlur(weights, (0, 0), blur)
    levels = [(weighted, weights)]
    while min(levels[-1][1].shape) > 1:
        size = tuple(max(1, -(-side // 2)) for side in levels[-1][1].shape[::-1])
        levels.append((_resized(weighted, size, cv2.INTER_AREA), _resized(weights, size, cv2.INTER_AREA)))
        weighted, weights = levels[-1]
    total = float(weights.sum())
    mean = weighted.sum(axis=(0, 1)) / total if total > 0 else np.zeros(values.shape[2])
    filled = np.broadcast_to(mean.astype(np.float32), (*weights.shape, values.shape[2]))
    for weighted, weights in reversed(levels):
        coarse = _resized(filled, weights.shape[::-1], cv2.INTER_LINEAR)
        soft = np.float32(FILL_SOFTNESS)
        filled = (weighted + soft * coarse) / (weights + soft)[..., None]
    return filled


def _resized(field: np.ndarray, size: tuple[int, ...], interpolation: int) -> np.ndarray:
    """`cv2.resize` that keeps a last axis of length one."""
    resized = cv2.resize(np.ascontiguousarray(field), size, interpolation=interpolation)
    return resized.reshape(*resized.shape[:2], *field.shape[2:])


def quadratic_field(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fit a quadratic over the image to a field where it is known, robustly, and evaluate it everywhere.

    Iteratively reweighted least squares with Cauchy's weights at the residuals' scale (MAD).

    Args:
        values: float32 [h, w, c].
        known: bool [h, w].

    Returns:
        float32 [h, w, c], kept within the range of the known values (1st to 99th percentile, widened by a
        quarter), so that it does not run away where nothing is known; the median where fewer than 60 are.
    """
    height, width = known.shape
    rows, columns = np.nonzero(known)
    if len(rows) == 0:
        return np.zeros_like(values)
    every = max(1, len(rows) // SAMPLES)
    rows, columns = rows[::every], columns[::every]
    sample = values[rows, columns].astype(np.float64)
    if len(rows) < 60:
        return np.broadcast_to(np.median(sample, axis=0), values.shape).astype(np.float32)
    design = _quadratic_terms((columns + 0.5) / width * 2 - 1, (rows + 0.5) / height * 2 - 1)
    weights = np.ones(len(rows))
    for _ in range(6):
        weighted = design * weights[:, None]
        normal = weighted.T @ design + 1e-6 * weights.sum() * np.eye(
            6
        )  # a ridge, where a border is all there is
        coefficients = np.linalg.solve(normal, weighted.T @ sample)
        residual = np.linalg.norm(sample - design @ coefficients, axis=1)
        scale = max(1.4826 * float(np.median(residual)), 1e-6)
        weights = 1 / (1 + (residual / (2 * scale)) ** 2)
    x = ((np.arange(width) + 0.5) / width * 2 - 1).astype(np.float32)[None, :, None]
    y = ((np.arange(height) + 0.5) / height * 2 - 1).astype(np.float32)[:, None, None]
    one, by_x, by_y, by_xy, by_xx, by_yy = coefficients.astype(np.float32)
    fitted = (one + x * (by_x + x * by_xx)) + y * (by_y + y * by_yy) + (x * y) * by_xy
    low, high = np.percentile(sample, [1, 99], axis=0)
    room = 0.25 * (high - low) + 1e-6
    return cv2.max(cv2.min(fitted, _constant(high + room, fitted)), _constant(low - room, fitted))


def _constant(value: np.ndarray, like: np.ndarray) -> np.ndarray:
    return np.broadcast_to(value.astype(np.float32), like.shape).copy()


def _quadratic_terms(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], axis=-1)


def sample_field(field: np.ndarray, rows: np.ndarray, columns: np.ndarray, factor: int) -> np.ndarray:
    """Interpolate a reduced field [h, w, c] bilinearly at full-resolution pixels (rows, columns) [n]: [n, c]."""
    channels = field.shape[2] if field.ndim == 3 else 1
    if factor == 1:
        return field[rows, columns].reshape(len(rows), channels)
    line = 1024  # cv2.remap takes no row longer than 32767
    lines = -(-len(rows) // line)
    x, y = (np.zeros(lines * line, np.float32) for _ in range(2))
    x[: len(rows)] = (columns + 0.5) / factor - 0.5
    y[: len(rows)] = (rows + 0.5) / factor - 0.5
    maps = x.reshape(lines, line), y.reshape(lines, line)
    found = cv2.remap(field, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(lines * line, channels)[: len(rows)]


# -------------------------------------------------------------------------------------- binary masks


def disc(radius: float) -> np.ndarray:
    """A disc as a kernel for `cv2.dilate`."""
    side = 2 * int(np.ceil(radius)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def dilated(mask: np.ndarray, radius: float) -> np.ndarray:
    """A bool mask grown by a disc."""
    return cv2.dilate(mask.astype(np.uint8), disc(radius)) > 0


def eroded(mask: np.ndarray, radius: float) -> np.ndarray:
    """A bool mask shrunk by a disc; what lies outside the image counts as inside the mask."""
    return cv2.erode(mask.astype(np.uint8), disc(radius), borderType=cv2.BORDER_CONSTANT, borderValue=1) > 0


def components(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """4-connected components of a bool mask: labels int32 [h, w] from 1 on, and areas [n + 1], area 0 being 0."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.int64) if count else np.zeros(1, np.int64)
    areas[0] = 0
    return labels, areas


def large_components(mask: np.ndarray, share: float, reach: float) -> np.ndarray:
    """The components of a bool mask of at least a share of the largest one, and what lies near these.

    Args:
        mask: bool [h, w].
        share: of the largest component's area.
        reach: pixels; a small component that is nearer than this to a large one is kept.
    """
    labels, areas = components(mask)
    if len(areas) < 2:
        return mask.copy()
    large = (areas >= share * areas.max()) & (areas > 0)
    if large[1:].all():
        return mask.copy()
    near = dilated(large[labels], reach)
    kept = large.copy()
    kept[np.unique(labels[near])] = True
    kept[0] = False
    return kept[labels]


def open_to_border(background: np.ndarray) -> np.ndarray:
    """The part of a bool background that is connected to the image's top, left or right border.

    The bottom border counts only where the background reaches it from a corner: a body is cut off there, and
    dark folds of its clothes are no openings.
    """
    labels, areas = components(background)
    touching = np.zeros(len(areas), bool)
    for line in (labels[0], labels[:, 0], labels[:, -1]):
        touching[np.unique(line)] = True
    touching[0] = False
    return touching[labels]
