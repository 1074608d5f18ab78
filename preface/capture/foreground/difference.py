"""Black backgrounds and clean plates: what differs from the background by more than its noise is the person."""

from __future__ import annotations

import cv2
import numpy as np

from preface.capture.foreground.backdrop import border, is_black, noise_of, smooth_background
from preface.capture.foreground.fields import components, dilated, eroded, large_components, open_to_border
from preface.capture.foreground.light import Light
from preface.capture.foreground.result import Foreground, ForegroundError, Hints, check_size, checked_image
from preface.capture.foreground.unmixing import Decision, person_light, unmix

WEAK, STRONG = 4.0, 12.0  # standard deviations of the background: may be, and surely is, the person
SMALLEST_PART = 0.03  # of the person's area; smaller parts far from it are dust and reflections
REACH = 0.015  # of the diagonal: strands of hair further than that from the head are not looked for
CLOSING = 0.003  # of the diagonal: gaps as narrow as that in the outline of dark hair are closed
SPREAD = 2.0  # reduced pixels: how far from the background a pixel may be a mixture with it
GAP = 0.28  # of the light around it is the most that a gap between strands of hair may have
SIDE = 3  # reduced pixels: how far off that light is looked for
SMALLEST_GAP = 0.002  # of the image; a smaller hole is a pupil, a nostril or a shadow in the hair
CUT_OFF = 5  # times larger than that must be a hole that the image's bottom border cuts
SHADOW = 0.65  # of the plate's light is what a shadow of the person on it leaves at least


class BlackBackground:
    """A person before black, or before a dark clean plate."""

    name = "black"

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """See `Segmenter`. A plate among the hints is used for what reflects in the dark."""
        image = checked_image(pixels, hints)
        plate = _plate_of(image, hints) if hints.plate is not None else None
        light = Light(image)
        behind = None if plate is None else Light(plate, light.white)
        low = light.reduced()
        dark = border(*low.shape[:2]) & is_black(low if behind is None else behind.reduced())
        if not dark.any():
            note = "nothing black at the image's border: all of it is taken for the person"
            return Foreground(np.ones(image.shape[:2], np.float32), image, self.name, (note,))
        decision = _decide_black(light, low, dark, None if behind is None else behind.reduced())
        return Foreground(unmix(light, decision, behind), image, self.name, _notes(decision))


class CleanPlate:
    """A person before anything that has been photographed without them."""

    name = "plate"

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """See `Segmenter`."""
        image = checked_image(pixels, hints)
        plate = _plate_of(image, hints)
        light = Light(image)
        decision, gain = _decide_plate(light, Light(plate, light.white))
        behind = Light(plate, light.white, gain)
        notes = _notes(decision)
        if not 0.8 < float(gain.mean()) < 1.25:
            notes += (f"the photograph is {float(gain.mean()):.2f} times as bright as the plate",)
        return Foreground(unmix(light, decision, behind), image, self.name, notes)


def _plate_of(image: np.ndarray, hints: Hints) -> np.ndarray:
    """The plate among the hints, checked."""
    if hints.plate is None:
        remedy = "Photograph the background without the person, or choose another method"
        raise ForegroundError(hints.path, "plate", "is missing", remedy)
    plate = checked_image(hints.plate, hints)
    check_size(plate, image, "plate", hints)
    if plate.dtype != image.dtype:
        problem = f"is {plate.dtype}, and the photograph is {image.dtype}"
        raise ForegroundError(hints.path, "plate", problem, "Export both from the camera in the same way")
    return plate


def _notes(decision: Decision) -> tuple[str, ...]:
    return () if decision.core.any() else ("nothing differs from the background: there is no person",)


# --------------------------------------------------------------------------------------------- black


def _decide_black(light: Light, low: np.ndarray, dark: np.ndarray, plate: np.ndarray | None) -> Decision:
    """Core and background of a person before black.

    Without a plate the backdrop is fitted twice: to the dark border, then to everything that does not exceed it.
    """
    background = smooth_background(low, dark) if plate is None else plate
    distance, noise = _distance(light, low, background, dark)
    quiet = ~dilated(distance > WEAK, 2.0)
    if plate is None and quiet.any():
        background = smooth_background(low, quiet)
    distance, noise = _distance(light, low, background, quiet if quiet.any() else dark)
    support = _solid(distance > WEAK, distance > STRONG, distance)
    excess = np.maximum((low - background).mean(axis=-1), 0)
    dim = (distance < WEAK) | (excess < GAP * _surrounding(excess))
    shown = dim & open_to_border(dilated(~support | dim, 1.0))
    mixed = support & dilated(shown, SPREAD)
    pure = (support & ~mixed).astype(np.float32)
    person = _no_brighter_than_nearby(person_light(low, support & ~shown, pure), low)
    half = 0.5 * np.maximum((person - background).mean(axis=-1), 0)
    core = support & ~shown & ~(mixed & (excess < half))
    open_ = ~dilated(support, 1.0) & _far_or_quiet(support, distance)
    return Decision(low, background, core, open_, person, pure, noise)


def _distance(
    light: Light, low: np.ndarray, background: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How many standard deviations brighter than the background a pixel is, [h, w], and these deviations [3]."""
    noise = noise_of(low, background, known, _floor(light, background))
    return ((low - background) / noise).max(axis=-1), noise


def _no_brighter_than_nearby(person: np.ndarray, low: np.ndarray) -> np.ndarray:
    """The person's light, but nowhere brighter than the brightest pixel around: dark strands of hair are dark, and
    not faint mixtures of the cheek behind them.
    """
    size = np.maximum(person.mean(axis=-1), 1e-6)
    around = cv2.dilate(low.mean(axis=-1), np.ones((2 * SIDE + 1, 2 * SIDE + 1), np.uint8))
    return person * np.minimum(1, around / size)[..., None]


def _surrounding(excess: np.ndarray) -> np.ndarray:
    """The light that a pixel has around it on at least six of eight sides, a few pixels off, [h, w].

    A gap between strands of hair is dark against it. Dark hair beside a bright forehead is not: some sides are
    as dark as itself.
    """
    brightest = cv2.dilate(excess, np.ones((3, 3), np.uint8))
    padded = cv2.copyMakeBorder(brightest, SIDE, SIDE, SIDE, SIDE, cv2.BORDER_REPLICATE)
    height, width = excess.shape
    sides = [
        padded[SIDE + y : SIDE + y + height, SIDE + x : SIDE + x + width]
        for y in (-SIDE, 0, SIDE)
        for x in (-SIDE, 0, SIDE)
        if x or y
    ]
    return np.partition(np.stack(sides), 2, axis=0)[2]


def _floor(light: Light, background: np.ndarray) -> np.ndarray:
    """The noise [3] below which a difference means nothing: half a level, averaged over a reduced pixel, and at
    least a hundredth of what a level is after averaging, for light that is the same everywhere.
    """
    level = light.quantisation(np.median(background.reshape(-1, 3), axis=0))
    return np.maximum(0.5 * level / np.sqrt(light.factor), 1e-5)


def _solid(weak: np.ndarray, strong: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """The person: what may be and is connected to what surely is, without dust, with its dark holes filled."""
    diagonal = float(np.hypot(*weak.shape))
    labels, areas = components(cv2.medianBlur(weak.astype(np.uint8), 3) > 0 if min(weak.shape) > 8 else weak)
    surely = np.zeros(len(areas), bool)
    surely[np.unique(labels[strong])] = True
    surely[0] = False
    core = large_components(surely[labels], SMALLEST_PART, REACH * diagonal)
    closed = eroded(dilated(core, CLOSING * diagonal), CLOSING * diagonal) | core
    outside = open_to_border(~closed)
    holes = ~closed & ~outside
    return (closed & ~_gaps(holes, distance)) | (holes & ~_gaps(holes, distance))


def _gaps(holes: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Those holes through which the background is seen: large, and as quiet as the background is. Holes that the
    bottom border cuts must be larger: they may be folds of dark clothes.
    """
    labels, areas = components(holes)
    gaps = np.zeros(len(areas), bool)
    least = np.full(len(areas), max(SMALLEST_GAP * holes.size, 12.0))
    least[np.unique(labels[-1])] *= CUT_OFF
    for label in np.flatnonzero((areas >= least) & (areas > 0)):
        inner = eroded(labels == label, 2.0)
        gaps[label] = inner.any() and float(np.mean(distance[inner])) < 1.5
    return gaps[labels]


def _far_or_quiet(core: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Where no strand of hair is looked for: far from the person, or without any sign of it."""
    near = dilated(core, REACH * float(np.hypot(*core.shape)))
    return ~near | (distance < WEAK)


# --------------------------------------------------------------------------------------------- plate


def _decide_plate(light: Light, plate: Light) -> tuple[Decision, np.ndarray]:
    """Core and background of a person before a clean plate, and the gain [3] of the photograph over the plate."""
    low, behind = light.reduced(), plate.reduced()
    ring = border(*low.shape[:2])
    gain = _gain(low[ring], behind[ring])
    behind = behind * gain
    difference = low - behind
    # A camera that moved by a third of a pixel since shows the plate's edges as differences.
    slope = sum(np.abs(cv2.Sobel(behind, cv2.CV_32F, x, 1 - x, ksize=3)) / 8 for x in (0, 1))
    agreeing = ring & (np.abs(difference).max(axis=-1) <= np.median(np.abs(difference[ring]).max(axis=-1)))
    noise = noise_of(low, behind, agreeing, _floor(light, behind)) * 1.5  # the quieter half of the border
    relative = _relative_noise(difference, behind, agreeing)
    spread = np.sqrt(noise**2 + (relative * behind) ** 2 + (0.35 * slope) ** 2)
    distance = np.linalg.norm(difference / spread, axis=-1) / np.sqrt(3)
    unshaded = np.minimum(distance, _distance_from_shadow(low, behind, spread))
    core = _solid(distance > WEAK, unshaded > STRONG, distance)
    core &= ~_shadow_only(core, unshaded)
    open_ = ~dilated(core, 1.0) & _far_or_quiet(core, unshaded)
    pure = core.astype(np.float32)
    person = person_light(low, core, pure)
    core = core & ~_less_than_half(low, behind, person, spread, core)
    return Decision(low, behind, core, open_, person, pure, noise), gain


def _less_than_half(
    low: np.ndarray, plate: np.ndarray, person: np.ndarray, spread: np.ndarray, core: np.ndarray
) -> np.ndarray:
    """Pixels at the edge that differ from the plate, but are more plate than person: bool [h, w]."""
    line = person - plate
    telling = np.linalg.norm(line / spread, axis=-1) > STRONG
    share = np.einsum("hwc,hwc->hw", low - plate, line) / np.maximum(
        np.einsum("hwc,hwc->hw", line, line), 1e-9
    )
    return core & dilated(~core, SPREAD) & telling & (share < 0.5)


def _gain(seen: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """How much brighter the photograph is than the plate, per channel [3], from the border they share."""
    bright = plate.min(axis=-1) > 0.01
    if bright.sum() < 20:
        return np.ones(3, np.float32)
    ratio = seen[bright] / plate[bright]
    gain = np.median(ratio, axis=0)
    return np.where((gain > 0.5) & (gain < 2), gain, 1).astype(np.float32)


def _relative_noise(difference: np.ndarray, plate: np.ndarray, known: np.ndarray) -> float:
    """Noise that grows with light, relative to it, where photograph and plate agree."""
    bright = known & (plate.min(axis=-1) > 0.01)
    if not bright.any():
        return 0.01
    return float(max(1.5 * np.median(np.abs(difference[bright]) / plate[bright]), 0.003))


def _distance_from_shadow(low: np.ndarray, plate: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Distance from the plate made darker by a shadow, in standard deviations."""
    weights = 1 / spread**2
    share = (low * plate * weights).sum(axis=-1) / np.maximum((plate**2 * weights).sum(axis=-1), 1e-12)
    share = np.clip(share, SHADOW, 1.0)
    return np.linalg.norm((low - share[..., None] * plate) / spread, axis=-1) / np.sqrt(3)


def _shadow_only(core: np.ndarray, unshaded: np.ndarray) -> np.ndarray:
    """Parts of the core that are open to the outside and nothing but darker plate."""
    shaded = core & (unshaded < WEAK)
    opened = cv2.morphologyEx(shaded.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    return opened & open_to_border(opened | ~core)
