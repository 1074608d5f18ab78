"""What a run costs, before it starts: a model of bytes and seconds per image and per pixel.

A cost model rather than a probe, because modelling the first head alone takes longer than a dry run should.
Its constants were measured with this package's own images of 256x384 and 512x768 on one core of a server
(Intel Xeon with AVX-512); expect a factor of two on other machines.
"""

from __future__ import annotations

from dataclasses import dataclass

from synthetic_studio.backgrounds import backdrop
from synthetic_studio.config import StudioConfig

# Bytes per pixel with the default noise, on which they depend most.
BOARD_BYTES = 1.5
PHOTOGRAPH_BYTES = {"black": 1.2, "green": 1.5}
PLATE_BYTES = {"black": 0.55, "green": 1.05}
TRUTH_BYTES = 4.2  # mask, depth and normals
HEAD_BYTES = 52_000  # parameters, keypoints and landmarks

# Seconds on one core.
START = 7.0  # a worker's imports and the parametric model
HEAD = 6.0  # modelling one person
SAMPLE = 2.3e-6  # one ray of a photograph, shading included
PIXEL = 0.8e-6  # sensor, encoding and truth of a photograph
BOARD_PIXEL = 0.8e-6  # a calibration image in all


@dataclass(frozen=True)
class Cost:
    """A run's images, its bytes on disk, and its seconds on one core."""

    photographs: int
    calibration_images: int
    plates: int
    bytes: float
    seconds: float

    @property
    def images(self) -> int:
        """All images of the capture."""
        return self.photographs + self.calibration_images + self.plates


def photograph_seconds(config: StudioConfig) -> float:
    """One photograph of a person who is modelled already, its truth included."""
    return _pixels(config) * (PIXEL + config.antialias**2 * SAMPLE)


def board_seconds(config: StudioConfig) -> float:
    """One calibration image."""
    return _pixels(config) * BOARD_PIXEL


def plate_seconds(config: StudioConfig) -> float:
    """One clean plate."""
    return _pixels(config) * PIXEL


def _pixels(config: StudioConfig) -> int:
    width, height = config.size
    return width * height


def estimate(config: StudioConfig) -> Cost:
    """The cost of a whole run of a valid configuration."""
    stations = config.takes * config.views
    photographs = config.identities * config.views
    frames = stations * config.board.frames
    plates = stations if config.clean_plates else 0
    green = sum(backdrop(config, take) == "green" for take in range(config.takes)) / config.takes
    size = frames * BOARD_BYTES + photographs * (_mixed(PHOTOGRAPH_BYTES, green) + TRUTH_BYTES)
    size += plates * _mixed(PLATE_BYTES, green)
    seconds = frames * board_seconds(config) + plates * plate_seconds(config)
    seconds += photographs * photograph_seconds(config)
    # Workers that share a person's views each model the person.
    built = min(max(config.identities, config.workers), photographs)
    seconds += config.workers * START + built * HEAD
    return Cost(photographs, frames, plates, size * _pixels(config) + config.identities * HEAD_BYTES, seconds)


def _mixed(cost: dict[str, float], green: float) -> float:
    return (1 - green) * cost["black"] + green * cost["green"]
