"""From a decision at low resolution to coverage at full resolution.

A pixel at the edge shows C = alpha F + (1 - alpha) B. With the background's light B known and the person's
light F taken from nearby, the most likely coverage, given that F scatters about its local mean with a covariance S
(Chuang et al. 2001, A Bayesian Approach to Digital Matting, equation 9, for fixed F and B, with S as metric
and a weak prior), is

    alpha = (d' P (C - B) + alpha0 / tau^2) / (d' P d + 1 / tau^2),    d = F - B,    P = S^-1.

The metric makes the difference of a person's bright and dark hair count little, and the screen's colour much. Only
the pixels of a band around the edge are computed, strip by strip: the rest is 0 or 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from preface.capture.foreground.fields import SAMPLES, dilated, eroded, push_pull, sample_field
from preface.capture.foreground.light import Light

INSIDE = 3.0  # reduced pixels: how far into the person the band reaches
OUTSIDE = 1.5  # reduced pixels: how far it reaches beyond what might be the person
SURE = 2.0  # reduced pixels from the edge at which a pixel shows the person alone
PRIOR = 0.4  # tau: standard deviation of the coverage about the smoothed decision
TEXTURE = 7  # reduced pixels: side of the window in which a person's light has a local mean
LEAST_TEXTURE = 0.03  # standard deviation of a person's light about its local mean, relative to it
STRETCH = (0.03, 0.97)  # coverage that is taken for 0 and for 1: noise and texture make these few per cent


@dataclass(frozen=True, eq=False)
class Decision:
    """What a method has decided about a reduced photograph, all arrays [lh, lw, ...].

    Attributes:
        light: float32 [.., 3], the photograph.
        background: float32 [.., 3], the light of what is behind the person, everywhere.
        core: bool, the person, up to about half coverage, without holes that are none.
        open: bool, certainly background.
        person: float32 [.., 3], the light of the person, continued beyond the edge (see `person_light`).
        pure: float32, how surely a pixel of the core shows no background, weight from 0 to 1.
        noise: float32 [3], standard deviation of the background's light.
    """

    light: np.ndarray
    background: np.ndarray
    core: np.ndarray
    open: np.ndarray
    person: np.ndarray
    pure: np.ndarray
    noise: np.ndarray


def unmix(light: Light, decision: Decision, plate: Light | None) -> np.ndarray:
    """Coverage at full resolution.

    Args:
        light: the photograph.
        decision: about its reduced image.
        plate: the background at full resolution where there is one; else the decision's smooth field is.

    Returns:
        float32 [h, w] in [0, 1].
    """
    core = decision.core
    if not core.any() or core.all():
        shape = (light.height, light.width)
        return np.full(shape, core.all(), np.float32)
    metric, noise = _metric(decision)
    might_be = dilated(core | ~decision.open, OUTSIDE)
    band = might_be & ~eroded(core, INSIDE)
    prior = cv2.GaussianBlur(core.astype(np.float32), (0, 0), 1.0)
    alpha = np.empty((light.height, light.width), np.float32)
    for rows in light.strips():
        _fill_strip(alpha, rows, light, decision, prior, band, metric, noise, plate)
    return alpha


def person_light(light: np.ndarray, core: np.ndarray, pure: np.ndarray) -> np.ndarray:
    """The person's light [lh, lw, 3], from pixels that show nothing else, continued over the edge.

    Args:
        light: float32 [lh, lw, 3].
        core: bool [lh, lw], the person.
        pure: float32 [lh, lw], as in `Decision`.
    """
    weights = pure * eroded(core, SURE)
    if weights.sum() < 1:  # a person of a few pixels
        weights = pure * core + np.float32(1e-3) * core
    return push_pull(light, weights.astype(np.float32), 1.0)


def _metric(decision: Decision) -> tuple[np.ndarray, float]:
    """S^-1 [3, 3] for a person of light one, and the light^2 that noise adds to the person's."""
    inner = eroded(decision.core, SURE) & (decision.pure > 0.5)
    weight = inner.astype(np.float32)
    around = cv2.boxFilter(decision.light * weight[..., None], cv2.CV_32F, (TEXTURE, TEXTURE))
    share = cv2.boxFilter(weight, cv2.CV_32F, (TEXTURE, TEXTURE))
    places = np.flatnonzero(inner)[:: max(1, int(inner.sum()) // SAMPLES)]
    seen = decision.light.reshape(-1, 3)[places].astype(np.float64)
    local = around.reshape(-1, 3)[places] / np.maximum(share.reshape(-1, 1)[places], 1e-6)
    relative = (seen - local) / np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1e-4)
    texture = LEAST_TEXTURE**2 * np.eye(3)
    if len(relative) > 30:
        limit = 3 * np.median(np.linalg.norm(relative, axis=1)) + 1e-6
        kept = relative[np.linalg.norm(relative, axis=1) < limit]
        texture = texture + kept.T @ kept / len(kept)
    noise = float(np.mean(decision.noise.astype(np.float64) ** 2))
    return np.linalg.inv(texture).astype(np.float32), noise / (float(np.trace(texture)) / 3)


def _fill_strip(
    alpha: np.ndarray,
    rows: slice,
    light: Light,
    decision: Decision,
    prior: np.ndarray,
    band: np.ndarray,
    metric: np.ndarray,
    noise: float,
    plate: Light | None,
) -> None:
    """Write some rows of the coverage."""
    factor = light.factor
    reduced = slice(rows.start // factor, -(-rows.stop // factor))
    enlarged = [
        _enlarged(mask[reduced], factor, rows.stop - rows.start, light.width)
        for mask in (decision.core, band)
    ]
    alpha[rows] = enlarged[0]
    down, across = np.nonzero(enlarged[1])
    if len(down) == 0:
        return
    down = down + rows.start
    seen = light.at(down, across)
    behind = (
        sample_field(decision.background, down, across, factor) if plate is None else plate.at(down, across)
    )
    of_person = sample_field(decision.person, down, across, factor)
    expected = sample_field(prior, down, across, factor)[:, 0]
    direction = of_person - behind
    weighted = direction @ metric
    scale = 1 / (
        np.einsum("nc,nc->n", of_person, of_person) + np.float32(noise * factor**2) + np.float32(1e-8)
    )
    evidence = np.einsum("nc,nc->n", weighted, seen - behind) * scale
    strength = np.einsum("nc,nc->n", weighted, direction) * scale
    weak = np.float32(1 / PRIOR**2)
    coverage = (evidence + weak * expected) / (strength + weak)
    low, high = STRETCH
    alpha[down, across] = np.clip((coverage - low) / (high - low), 0, 1)


def _enlarged(mask: np.ndarray, factor: int, height: int, width: int) -> np.ndarray:
    """A reduced bool mask with its pixels repeated, cut to a height and a width."""
    if factor == 1:
        return mask
    return np.repeat(np.repeat(mask, factor, axis=0), factor, axis=1)[:height, :width]
