"""Who stands in the studio: every parameter of one synthetic identity, a pure function of (seed, index)."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from synthetic_studio.streams import Stream, generator
from synthetic_studio.template import head_template

FACE_CONTROL_PREFIXES = (
    "cheek", "chin", "ear", "eyebrows", "eye", "forehead", "head", "mouth", "neck", "nose",
)  # fmt: skip
# Controls that shift the face sideways: these make a face asymmetric, so they stay small.
LATERAL_CONTROLS = ("head-trans-out", "neck-trans-out", "nose-trans-out", "mouth-trans-out")
# Controls that move the whole head against the neck, which the pose of the subject already does.
UNUSED_CONTROLS = (
    "head-trans-forward",
    "head-trans-up",
    "neck-trans-forward",
    "neck-trans-up",
    "head-angle-out",
)
# Standard deviation of anny's -1..1 face controls: varied, still plausible. There are some twenty for the
# nose, all of which move its tip, so each of them varies less.
CONTROL_SPREAD = 0.22
NOSE_SPREAD = 0.08
# anny's average nose is flatter and wider than people's. With these means the tip stands 18.0 mm before its base
# and the wings are 38 mm apart, over ten heads (Farkas, "Anthropometry of the Head and Face", 1994: 19.6 mm and,
# by ancestry, 31 to 44 mm); before, 16.7 and 40 mm.
NOSE_MEANS = {"nose-scale-depth-incr": 0.5, "nose-scale-horiz-incr": -0.3}
ASYMMETRY_SPREAD = 0.04

HAIR_STYLES = ("bald", "buzz", "short", "side_part", "slick_back", "bob", "long", "bun", "curly")
STYLE_WEIGHTS = {
    "male": (0.12, 0.22, 0.26, 0.16, 0.10, 0.0, 0.03, 0.02, 0.09),
    "female": (0.01, 0.03, 0.08, 0.09, 0.07, 0.20, 0.26, 0.14, 0.12),
}
# Linear sRGB albedo of hair and of irises, from dark to light.
HAIR_COLOURS = {
    "black": (0.012, 0.010, 0.009), "dark_brown": (0.030, 0.018, 0.011), "brown": (0.075, 0.042, 0.022),
    "auburn": (0.120, 0.040, 0.016), "blond": (0.300, 0.190, 0.085), "grey": (0.300, 0.290, 0.280),
    "white": (0.550, 0.540, 0.520),
}  # fmt: skip
IRIS_COLOURS = {
    "dark_brown": (0.045, 0.022, 0.010), "brown": (0.110, 0.055, 0.022), "hazel": (0.170, 0.115, 0.045),
    "green": (0.120, 0.150, 0.070), "blue": (0.110, 0.190, 0.290), "grey": (0.200, 0.220, 0.230),
}  # fmt: skip


@dataclass(frozen=True)
class Identity:
    """Parameters of one synthetic person.

    Attributes:
        index: Place in the capture; with the studio's seed it determines everything else.
        phenotypes: anny's phenotypes in 0..1 (age 0.6 is a young adult, 1.0 old age).
        controls: anny's local face controls in -1..1.
        actions: Slight facial actions in 0..1: people told to look neutral seldom do.
        melanin: 0 (palest) to 1 (darkest) skin.
        redness: Blood tint of the skin, about 0..1.
        freckles: Density of freckles, 0..1.
        hair: Style, colour name, length factor and frontal hairline height in metres.
        brow_density: Relative density of the eyebrows.
        stubble: Beard shadow, 0 (none) to 1.
        iris: Name of the iris colour.
        pupil: Pupil radius over iris radius.
        yaw, pitch, roll: Head pose in radians; nobody sits perfectly straight.
        offset: Position of the head's centre in the studio, metres.
        garment: Linear RGB of the shirt.
    """

    index: int
    phenotypes: dict[str, float]
    controls: dict[str, float]
    actions: dict[str, float]
    melanin: float
    redness: float
    freckles: float
    hair_style: str
    hair_colour: str
    hair_length: float
    hairline: float
    brow_density: float
    stubble: float
    iris: str
    pupil: float
    yaw: float
    pitch: float
    roll: float
    offset: tuple[float, float, float]
    garment: tuple[float, float, float]

    def to_json(self) -> dict[str, Any]:
        """Return the parameters as plain JSON values."""
        return asdict(self)


def sample_identity(seed: int, index: int) -> Identity:
    """Draw one identity.

    Args:
        seed: The studio's seed.
        index: The identity's number, from 0.
    """
    rng = generator(seed, Stream.IDENTITY, index)
    female = bool(rng.random() < 0.5)
    age = float(rng.uniform(0.62, 1.0) if rng.random() < 0.25 else rng.uniform(0.62, 0.85))
    african, asian, caucasian = (float(x) for x in rng.dirichlet((0.45, 0.45, 0.55)))
    phenotypes = {
        "gender": float(rng.uniform(0.0, 0.2) if female else rng.uniform(0.8, 1.0)),
        "age": age,
        "weight": float(np.clip(rng.normal(0.5, 0.15), 0.15, 0.9)),
        "muscle": float(rng.uniform(0.35, 0.65)),
        "height": float(rng.uniform(0.35, 0.65)),
        "african": african,
        "asian": asian,
        "caucasian": caucasian,
    }
    controls, actions = _sample_controls(rng), _sample_actions(rng)
    melanin = float(
        np.clip(0.85 * african + 0.33 * asian + 0.14 * caucasian + rng.normal(0.0, 0.06), 0.02, 0.95)
    )
    style = str(rng.choice(HAIR_STYLES, p=STYLE_WEIGHTS["female" if female else "male"]))
    return Identity(
        index=index,
        phenotypes=phenotypes,
        controls=controls,
        actions=actions,
        melanin=melanin,
        redness=float(rng.uniform(0.2, 1.0)),
        freckles=float(max(0.0, rng.normal(0.15, 0.35)) * (1.0 - melanin)),
        hair_style="curly" if african > 0.75 and style in ("short", "bob", "long") else style,
        hair_colour=_sample_hair_colour(rng, age, caucasian),
        hair_length=float(rng.uniform(0.8, 1.25)),
        hairline=float(rng.normal(0.066, 0.004) + (0.006 if not female and age > 0.85 else 0.0)),
        brow_density=float(rng.uniform(0.7, 1.2) * (0.8 if female else 1.0)),
        stubble=0.0 if female else float(max(0.0, rng.uniform(-0.4, 0.9))),
        iris=_sample_iris(rng, caucasian),
        pupil=float(rng.uniform(0.30, 0.45)),
        yaw=float(np.radians(rng.normal(0.0, 2.5))),
        pitch=float(np.radians(rng.normal(0.0, 2.5))),
        roll=float(np.radians(rng.normal(0.0, 1.5))),
        offset=tuple(float(x) for x in rng.normal(0.0, (0.006, 0.008, 0.006))),  # type: ignore[arg-type]
        garment=tuple(float(x) for x in 0.02 + 0.05 * rng.random() + 0.06 * rng.random(3) ** 3),  # type: ignore[arg-type]
    )


def _sample_controls(rng: np.random.Generator) -> dict[str, float]:
    """Draw anny's face controls, left and right alike but for a small asymmetry."""
    controls: dict[str, float] = {}
    for label in head_template().model.local_change_labels:
        bare = label.removeprefix("l-").removeprefix("r-")
        if not bare.startswith(FACE_CONTROL_PREFIXES) or bare in UNUSED_CONTROLS:
            continue
        if label in LATERAL_CONTROLS:
            controls[label] = float(rng.normal(0.0, ASYMMETRY_SPREAD))
        elif label.startswith("r-"):
            controls[label] = controls["l-" + bare] + float(rng.normal(0.0, ASYMMETRY_SPREAD))
        else:
            spread = NOSE_SPREAD if bare.startswith("nose") else CONTROL_SPREAD
            varied = np.clip(rng.normal(0.0, spread), -2.5 * spread, 2.5 * spread)
            controls[label] = float(NOSE_MEANS.get(label, 0.0) + varied)
    return controls


def _sample_actions(rng: np.random.Generator) -> dict[str, float]:
    smile = max(0.0, rng.normal(0.05, 0.12))
    press = max(0.0, rng.normal(0.0, 0.08))
    brow = max(0.0, rng.normal(0.0, 0.12))
    wide = float(rng.uniform(0.0, 0.15))
    pairs = {"mouthSmile": smile, "mouthPress": press, "browOuterUp": brow, "eyeWide": wide}
    return {
        f"{name}{side}": float(np.clip(value * rng.normal(1.0, 0.08), 0.0, 1.0))
        for name, value in pairs.items()
        for side in ("Left", "Right")
    }


def _sample_hair_colour(rng: np.random.Generator, age: float, caucasian: float) -> str:
    if age > 0.88 and rng.random() < 0.8:
        return str(rng.choice(["grey", "white"]))
    light = caucasian**2
    weights = np.array([0.5 * (1 - light), 0.35, 0.3 * light + 0.05, 0.10 * light, 0.25 * light])
    names = ["black", "dark_brown", "brown", "auburn", "blond"]
    return str(rng.choice(names, p=weights / weights.sum()))


def _sample_iris(rng: np.random.Generator, caucasian: float) -> str:
    light = caucasian**2
    weights = np.array([0.6 * (1 - light) + 0.05, 0.4, 0.15 * light, 0.12 * light, 0.25 * light, 0.1 * light])
    return str(rng.choice(list(IRIS_COLOURS), p=weights / weights.sum()))
