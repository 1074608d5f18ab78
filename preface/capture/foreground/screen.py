"""Green screens: a chroma key in linear light, with the screen's light measured in every photograph.

The screen is found at the border, its uneven light followed over the image, and every pixel judged by how much
of the screen's greenness it has. Coverage follows from unmixing along the line from the screen's light to the
person's (`unmixing`). What green remains in the person is light that the screen casts on it, and is taken out
down to the greenness that the person has away from the edge: a green shirt stays green.
"""

from __future__ import annotations

import numpy as np

from preface.capture.foreground.backdrop import LEAST_SHARE, border, is_green, noise_of, smooth_background
from preface.capture.foreground.fields import (
    components,
    dilated,
    eroded,
    large_components,
    open_to_border,
    push_pull,
    sample_field,
)
from preface.capture.foreground.light import Light
from preface.capture.foreground.result import Foreground, ForegroundError, Hints, check_size, checked_image
from preface.capture.foreground.unmixing import Decision, person_light, unmix

KEY = np.array([-0.5, 1.0, -0.5], np.float32)  # greenness of light: zero for every grey
WIDE, NARROW = (
    (0.4, 1.7),
    (0.72, 1.35),
)  # brightness of the screen against its mean, and against the fitted field
OFF_HUE = 0.12  # of the screen's light: how far from its hue it may be
OFF_LINE = (
    0.15  # of the difference between screen and person: how far from their mixtures a gap in hair may be
)
HALF = 0.5  # of the screen's greenness: the decision between person and screen
PURE = 0.12  # greenness at which a pixel's weight as one of the person alone has fallen to 1/e
SMALLEST_PART = 0.03  # of the person's area
REACH = 0.015  # of the diagonal
LEAST_SPILL = 0.01  # of the screen's greenness; less cannot be seen
LEAST_ALPHA = 0.05  # below it the person's light cannot be told from the screen's


class GreenScreen:
    """A person before a green screen."""

    name = "green"

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """See `Segmenter`. A plate among the hints says where the screen is and how it is lit."""
        image = checked_image(pixels, hints)
        if image.shape[2] == 1:
            remedy = "Give colour images, or choose another method"
            raise ForegroundError(hints.path, "pixels", "are grey, and a green screen is a colour", remedy)
        light = Light(image)
        low = light.reduced()
        known = _screen_from_plate(hints, image, light) if hints.plate is not None else None
        field = _screen_field(low) if known is None else known
        if field is None:
            note = "no green at the image's border: all of it is taken for the person"
            return Foreground(np.ones(image.shape[:2], np.float32), image, self.name, (note,))
        decision = _decide(light, low, field)
        alpha = unmix(light, decision, None)
        notes = () if decision.core.any() else ("all of the image is screen: there is no person",)
        return Foreground(alpha, _without_spill(image, light, decision, alpha), self.name, notes)


def _screen_from_plate(hints: Hints, image: np.ndarray, light: Light) -> np.ndarray:
    """The screen's light, reduced, as the plate shows it."""
    assert hints.plate is not None
    plate = checked_image(hints.plate, hints)
    check_size(plate, image, "plate", hints)
    if plate.shape[2] == 1:
        raise ForegroundError(
            hints.path, "plate", "is grey, and a green screen is a colour", "Give a colour plate"
        )
    return Light(plate, light.white).reduced()


def _screen_field(low: np.ndarray) -> np.ndarray | None:
    """The screen's light everywhere [lh, lw, 3], from the border inwards; None without any screen there."""
    ring = border(*low.shape[:2])
    green = ring & is_green(low)
    if green.sum() < 0.25 * LEAST_SHARE * ring.sum():
        return None
    colour = np.median(low[green], axis=0)
    field = np.broadcast_to(colour, low.shape)
    for _ in range(2):
        known = _like_screen(low, field, WIDE) & is_green(low)
        labels, _ = components(known)
        at_border = np.unique(labels[green])
        known &= np.isin(labels, at_border[at_border > 0])
        field = smooth_background(low, known if known.any() else green)
    return field


def _like_screen(low: np.ndarray, field: np.ndarray, brightness: tuple[float, float]) -> np.ndarray:
    """Whether a pixel is the screen, more or less brightly lit: bool [h, w]."""
    square = np.maximum(np.einsum("hwc,hwc->hw", field, field), 1e-9)
    share = np.einsum("hwc,hwc->hw", low, field) / square
    off = np.linalg.norm(low - share[..., None] * field, axis=-1)
    least, most = brightness
    return (share > least) & (share < most) & (off < OFF_HUE * np.maximum(share, least) * np.sqrt(square))


def _decide(light: Light, low: np.ndarray, field: np.ndarray) -> Decision:
    """Core and background of a person before the screen."""
    screen = _like_screen(low, field, NARROW)
    sure = eroded(screen, 1.0)
    background = field + push_pull(low - field, sure.astype(np.float32), 2.0)
    level = light.quantisation(np.median(background.reshape(-1, 3), axis=0))
    noise = noise_of(low, background, sure, np.maximum(level / 2, 1e-5))
    greenness = (low @ KEY) / np.maximum(background @ KEY, 1e-6)
    person = (greenness < HALF) | ~_like_screen(low, background, WIDE)
    core = large_components(person, SMALLEST_PART, REACH * float(np.hypot(*person.shape)))
    pure = np.exp(-np.clip(greenness, 0, 1) / PURE).astype(np.float32)
    core |= _print_on_clothes(low, background, core, pure, screen)
    open_ = screen & ~dilated(core, 1.0) & (greenness > 1 - 4 * _key_noise(noise, background))
    far = ~dilated(core, REACH * float(np.hypot(*core.shape)))
    pure *= core
    return Decision(low, background, core, open_ | far, person_light(low, core, pure), pure, noise)


def _print_on_clothes(
    low: np.ndarray, background: np.ndarray, core: np.ndarray, pure: np.ndarray, screen: np.ndarray
) -> np.ndarray:
    """Green within the person through which the screen is not seen: bool [h, w].

    A gap in the hair is a mixture of person and screen, and where it is wide, in its middle nothing but screen.
    """
    holes = ~core & ~open_to_border(~core)
    if not holes.any():
        return holes
    person = person_light(low, core, pure * core)
    line = background - person
    square = np.maximum(np.einsum("hwc,hwc->hw", line, line), 1e-9)
    along = np.einsum("hwc,hwc->hw", low - person, line) / square
    off = np.linalg.norm(low - person - along[..., None] * line, axis=-1)
    mixture = off < OFF_LINE * np.sqrt(square)
    labels, areas = components(holes)
    wide = eroded(holes, 2.0)
    widths = np.bincount(labels.ravel(), wide.ravel(), len(areas))
    of_mixture = np.bincount(labels.ravel(), (mixture & holes).ravel(), len(areas)) / np.maximum(areas, 1)
    of_screen = np.bincount(labels.ravel(), (screen & wide).ravel(), len(areas)) / np.maximum(widths, 1)
    gap = np.where(widths > 0, of_screen, of_mixture) > 0.5
    return holes & ~gap[labels]


def _key_noise(noise: np.ndarray, background: np.ndarray) -> float:
    """Standard deviation of the greenness of the screen, as a share of it."""
    deviation = float(np.sqrt(((noise * KEY) ** 2).sum()))
    return min(deviation / max(float(np.median(background @ KEY)), 1e-6), 0.05)


# --------------------------------------------------------------------------------------------- spill


def _without_spill(image: np.ndarray, light: Light, decision: Decision, coverage: np.ndarray) -> np.ndarray:
    """The photograph with the screen's light taken out of the person; the screen itself stays.

    In the band at the edge the person's own light (C - (1 - alpha) B) / alpha replaces the mixture, and everywhere
    what exceeds the greenness of the person's interior nearby is subtracted along the screen's light.
    """
    allowed = _allowed_greenness(decision)
    result = image.copy()
    factor = light.factor
    excess = decision.light @ KEY - 1.1 * np.maximum(allowed, 0)
    greenish = dilated((excess > LEAST_SPILL * (decision.background @ KEY)) | ~decision.core, 1.5)
    for rows in light.strips():
        reduced = slice(rows.start // factor, -(-rows.stop // factor))
        wanted = np.repeat(np.repeat(greenish[reduced], factor, 0), factor, 1)[
            : rows.stop - rows.start, : light.width
        ]
        down, across = np.nonzero(wanted & (coverage[rows] > 0))
        if len(down) == 0:
            continue
        down = down + rows.start
        alpha = coverage[down, across][:, None]
        seen = light.at(down, across)
        behind = sample_field(decision.background, down, across, factor)
        person = sample_field(decision.person, down, across, factor)
        own = np.clip((seen - (1 - alpha) * behind) / np.maximum(alpha, LEAST_ALPHA), 0, None)
        trust = np.clip(
            alpha / 0.5, 0, 1
        )  # thin coverage leaves little but noise: the light nearby is better
        own = trust * own + (1 - trust) * person
        limit = sample_field(allowed, down, across, factor)[:, 0]
        excess = np.clip(own @ KEY - np.maximum(limit, 0), 0, None)
        own = np.clip(own - (excess / np.maximum(behind @ KEY, 1e-6))[:, None] * behind, 0, None)
        result[down, across, :3] = light.encode(own)
    return result


def _allowed_greenness(decision: Decision) -> np.ndarray:
    """The greenness of light, float32 [lh, lw], that the person has of its own, from away from the edge."""
    depth = 0.012 * float(np.hypot(*decision.core.shape))
    inner = eroded(decision.core, depth)
    weights = decision.pure * (inner if inner.any() else decision.core)  # not mixtures
    return push_pull((decision.light @ KEY)[..., None], weights, 2.0)[..., 0]
