"""What a prior model consists of, as plain data: sizes, sampling, what is modelled, and the presets.

Nothing here imports torch: command lines and inspectors read configurations without it. Each field's text is
its help, and says what the paper does where the presets may differ from it.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

BASIS_DIRECTIONS = 21  # of the icosahedron, on which positions are projected (preface.model.coord)
MAX_LEVELS = 16  # 2^16 x is where float32 positions of the scene have no digits left
LEVEL_TOLERANCE = 0.01  # see `carried_levels`


class ConfigurationError(ValueError):
    """A model configuration that cannot be; the message names the field, the value and the remedy."""


@dataclass(frozen=True)
class NetworkConfig:
    """A trunk of equal layers with ReLU, every one of which sees the latent code."""

    depth: int
    """Layers. The paper: 4 in the proposal network, 8 in the NeRF network."""
    width: int
    """Features per layer. The paper: 256 in the proposal network, 1024 in the NeRF network."""
    skip: int = 4
    """The encoded position is appended to what leaves the layer of this index, if another follows. The paper
    (from its parameter count): 4, which the 4-layer proposal network does not have."""


@dataclass(frozen=True)
class ModelConfig:
    """An identity-conditioned Mip-NeRF 360 without contraction; the defaults are the paper's."""

    latent: int = 512
    """Numbers in the code of an identity; 0 for a model of one scene. The paper: 512."""
    proposal: NetworkConfig = field(default_factory=lambda: NetworkConfig(4, 256))
    """The network that only finds where to look; one for all rounds but the last, as in the paper."""
    nerf: NetworkConfig = field(default_factory=lambda: NetworkConfig(8, 1024))
    """The network of the last round, with density and colour."""
    bottleneck: int = 256
    """Features that the colour sees of a position. The paper: 256."""
    view_width: int = 128
    """Features of the layer that sees the direction. The paper: 128."""
    view_levels: int = 4
    """Levels of the direction's encoding, to which the direction itself is appended. The paper: 4."""
    levels: int | Literal["auto"] = 12
    """Levels of the position's encoding, in both networks, 0 to 16, or `auto`: those that the sharpest
    photograph can carry, as its pixels average finer waves away. The paper: 12."""
    samples: tuple[int, ...] = (256, 256, 128)
    """Intervals per ray in each round; the last round is the NeRF network's. The paper: 256, 256, 128."""
    dilation_bias: float = 0.0025
    """Widening of a round's weights before they are resampled, as a share of the ray. Mip-NeRF 360: 0.0025;
    the paper does not say."""
    dilation_multiplier: float = 0.5
    """The same, in expected lengths of an interval. Mip-NeRF 360: 0.5; the paper does not say."""
    anneal_slope: float = 10.0
    """How fast the weights come to count in resampling during training (Schlick's bias); 0 switches annealing
    off. Mip-NeRF 360: 10; the paper does not say."""
    near_anneal_rate: float = 0.0
    """The share of training in which the near end of rays moves to its place, 0 for none. The paper does not
    mention it; multinerf's default is none."""
    near_anneal_init: float = 0.95
    """Where the near end of rays begins in that case, as a share of the ray; multinerf's default."""
    clip_to_box: bool = True
    """Sample rays between the faces of the canonical box only, and never evaluate those that miss it. The
    paper: no, rays run between a near and a far plane and also see what is behind the head."""
    background: Literal["black", "captured", "modelled"] = "black"
    """What rays meet behind the model: `black`, for masked photographs; `captured`, colours given with the
    rays; `modelled`, whatever the networks put there, for unmasked photographs. The paper: modelled in the
    prior, black in inversion and finetuning."""
    matmul: Literal["fp32", "bf16"] = "fp32"
    """Precision of the products inside the networks; everything else is float32 in any case. The paper does
    not say; on TPUs the default is bf16."""
    predicted_normals: bool = False
    """Whether the NeRF network has a head that predicts normals. The paper: added at finetuning only."""
    code_std: float = 0.01
    """Standard deviation of codes before training. The paper does not say."""

    def __post_init__(self) -> None:
        _check(self)

    def within_the_box(self) -> ModelConfig:
        """What heads are, and how all models are rendered: between the faces of the box, in front of black."""
        return dataclasses.replace(self, clip_to_box=True, background="black")

    def resolved(self, smallest_radius: float) -> ModelConfig:
        """The same with `levels` as a number: see `carried_levels` for the argument."""
        if self.levels != "auto":
            return self
        return dataclasses.replace(self, levels=carried_levels(smallest_radius))

    def to_dict(self) -> dict[str, Any]:
        """The configuration as JSON data."""
        return {**dataclasses.asdict(self), "samples": list(self.samples)}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> ModelConfig:
        """Read what `to_dict` wrote; fields that are absent keep their defaults.

        Raises:
            ConfigurationError: a key that does not exist, or a value that cannot be.
        """
        values = dict(data)
        _known(values, ModelConfig, "")
        for name in ("proposal", "nerf"):
            if name in values and not isinstance(values[name], NetworkConfig):
                values[name] = _network(values[name], name)
        if isinstance(values.get("samples"), list):
            values["samples"] = tuple(values["samples"])
        return ModelConfig(**values)


def carried_levels(smallest_radius: float, tolerance: float = LEVEL_TOLERANCE) -> int:
    """Levels of the position's encoding that photographs can carry.

    A pixel's cone of radius r where it meets the scene averages the wave of level l, across its axis, to
    exp(-4^l r^2 / 8) of its height (Mip-NeRF, equations 8 and 14; the variance across is r^2 / 4). Every
    level that is left out is below `tolerance` in every pixel. Along its axis a pixel tells nothing about
    frequencies, and what is along the axis of one camera is across that of another.

    Args:
        smallest_radius: of the cones of all pixels, radius at depth 1 times the smallest depth at which the
            box is met, in scene units.
        tolerance: the height of a wave that counts as nothing; 0.01 is under half of a grey value's share
            in what a network of weights near one can make of it.

    Returns:
        The number of levels, 1 to 16.

    Raises:
        ConfigurationError: a radius that is not positive.
    """
    if not smallest_radius > 0:
        raise ConfigurationError(
            f"levels: auto needs the radius of the smallest pixel, which cannot be {smallest_radius}; "
            "give a number of levels, such as 12"
        )
    level = math.log2(math.sqrt(8 * math.log(1 / tolerance)) / smallest_radius)
    return min(max(math.ceil(level), 1), MAX_LEVELS)


def _network(data: Any, name: str) -> NetworkConfig:
    if not isinstance(data, Mapping):
        raise ConfigurationError(f"{name}: {data!r} is not an object with depth and width")
    _known(data, NetworkConfig, f"{name}.")
    missing = {"depth", "width"} - set(data)
    if missing:
        raise ConfigurationError(f"{name}: {' and '.join(sorted(missing))} missing")
    return NetworkConfig(**data)


def _known(data: Mapping[str, Any], kind: type, prefix: str) -> None:
    names = [f.name for f in dataclasses.fields(kind)]
    for key in data:
        if key not in names:
            raise ConfigurationError(f"{prefix}{key}: there is no such field{_nearest(str(key), names)}")


def _nearest(name: str, known: Any) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else f"; there are {', '.join(known)}"


def _check(config: ModelConfig) -> None:
    """Refuse values that cannot be, by field."""
    for name in ("proposal", "nerf"):
        network = getattr(config, name)
        for part in ("depth", "width"):
            _require(_whole(getattr(network, part), 1), f"{name}.{part}", getattr(network, part), "1 or more")
        _require(_whole(network.skip, 0), f"{name}.skip", network.skip, "the index of a layer, 0 or more")
    _require(_whole(config.latent, 0), "latent", config.latent, "0 or more")
    for name in ("bottleneck", "view_width"):
        _require(_whole(getattr(config, name), 1), name, getattr(config, name), "1 or more")
    _require(_whole(config.view_levels, 0), "view_levels", config.view_levels, "0 or more")
    levels = config.levels
    possible = levels == "auto" or (_whole(levels, 0) and int(levels) <= MAX_LEVELS)
    _require(possible, "levels", levels, f"0 to {MAX_LEVELS}, or auto")
    samples = config.samples
    enough = isinstance(samples, tuple) and len(samples) >= 1 and all(_whole(s, 1) for s in samples)
    _require(enough, "samples", samples, "one number per round, each 1 or more, such as 32 24 16")
    for name in ("dilation_bias", "dilation_multiplier", "anneal_slope", "code_std"):
        value = getattr(config, name)
        _require(_number(value) and value >= 0, name, value, "0 or more")
    for name in ("near_anneal_rate", "near_anneal_init"):
        value = getattr(config, name)
        _require(_number(value) and 0 <= value <= 1, name, value, "a share, 0 to 1")
    for name, choices in (("background", ("black", "captured", "modelled")), ("matmul", ("fp32", "bf16"))):
        value = getattr(config, name)
        _require(value in choices, name, value, f"one of {', '.join(choices)}")
    for name in ("clip_to_box", "predicted_normals"):
        value = getattr(config, name)
        _require(isinstance(value, bool), name, value, "true or false")


def _require(holds: bool, name: str, value: Any, wanted: str) -> None:
    if not holds:
        raise ConfigurationError(f"{name}: {value!r}; it has to be {wanted}")


def _whole(value: Any, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


# After the checks, which they pass through.
PRESETS: dict[str, ModelConfig] = {
    # The paper's model as it is: 14,600,581 parameters with 1450 codes.
    "paper": ModelConfig(clip_to_box=False, background="modelled"),
    # For one GPU and heads of 256x384 pixels.
    "studio": ModelConfig(
        latent=256,
        proposal=NetworkConfig(3, 128),
        nerf=NetworkConfig(8, 512),
        levels="auto",
        samples=(96, 64, 48),
        matmul="bf16",
    ),
    # For two processor cores and heads of 96x144 pixels.
    "small": ModelConfig(
        latent=96,
        proposal=NetworkConfig(2, 64),
        nerf=NetworkConfig(4, 192),
        bottleneck=64,
        view_width=48,
        levels="auto",
        samples=(24, 16, 16),
    ),
    # For a few minutes.
    "tiny": ModelConfig(
        latent=32,
        proposal=NetworkConfig(2, 32),
        nerf=NetworkConfig(4, 96),
        bottleneck=64,
        view_width=32,
        view_levels=2,
        levels="auto",
        samples=(16, 12, 12),
    ),
}


def preset(name: str) -> ModelConfig:
    """The configuration of this name.

    Raises:
        ConfigurationError: there is none.
    """
    if name not in PRESETS:
        raise ConfigurationError(f"preset: there is no {name!r}{_nearest(name, PRESETS)}")
    return PRESETS[name]
