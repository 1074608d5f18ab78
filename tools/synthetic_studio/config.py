"""Every choice that the synthetic studio offers; the docs of the fields are the command line's help."""

from __future__ import annotations

import math
import os
import re
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

from preface.cli import usage

MAX_SIDE = 16384
MAX_VIEWS = 999


class UsageError(usage.UsageError):
    """A flag whose value cannot work; the message names the flag, its value and the remedy."""

    def __init__(self, flag: str, value: object, problem: str, remedy: str) -> None:
        super().__init__(f"{flag} {value}: {problem}; {remedy}")


class StudioError(RuntimeError):
    """A run that cannot go on; the message names the file or the task and the remedy."""


@dataclass(frozen=True)
class SensorConfig:
    """The cameras' sensors."""

    blur: float = 0.4
    """Optical blur, standard deviation of a Gaussian in pixels; 0 switches it off."""

    full_well: float = 20000.0
    """Electrons at full scale, which sets the shot noise; 0 switches all noise off."""

    read_noise: float = 3.0
    """Read noise, standard deviation in electrons."""

    vignetting: float = 0.5
    """Strength of the cos^4 fall-off of light, varied a little per camera; 1 is a natural lens, 0 is none."""

    exposure: float = 1.0
    """Factor on the linear light before clipping."""

    exposure_seed: int | None = None
    """Photograph the same scene again: each number gives other noise, and nothing else changes."""


@dataclass(frozen=True)
class BoardConfig:
    """The calibration board."""

    kind: Literal["charuco", "chessboard"] = "charuco"
    """Pattern of the board."""

    squares: tuple[int, int] = (7, 10)
    """Number of squares across and down; one odd and one even, so that a chessboard has one orientation."""

    square_mm: float = 27.0
    """Side of a square, in millimetres."""

    marker_ratio: float = 0.78
    """Side of a ChArUco marker over the side of its square."""

    frames: int = 40
    """Board poses in each take."""

    tilt: float = 50.0
    """Largest angle, in degrees, between the board's normal and straight ahead."""

    bow_mm: tuple[float, float] = (0.0, 0.0)
    """Height, in millimetres, of a parabolic bow across and down the board (mrcal's two warp parameters)."""


@dataclass(frozen=True)
class DriftConfig:
    """How far each camera wanders between two takes."""

    translation_mm: float = 0.2
    """RMS length of the displacement of each camera's centre from its nominal place, in millimetres."""

    rotation_degrees: float = 0.02
    """RMS angle of the rotation of each camera from its nominal attitude, in degrees."""


@dataclass(frozen=True)
class StudioConfig:
    """Write a synthetic capture (DIR/capture) and its ground truth (DIR/truth)."""

    output: Path
    """Directory to write; an interrupted run with the same configuration is resumed there."""

    identities: int = 16
    """Number of people."""

    views: int = 13
    """Number of cameras; the first one is frontal."""

    resolution: str = "256x384"
    """WIDTHxHEIGHT of every image in pixels, up to 4096x6144 and beyond; below some 165x248 the board's markers are
    too small to calibrate from."""

    seed: int = 0
    """Everything random follows from this number."""

    takes: int = 2
    """Number of takes, each with a drifted rig and its own calibration; people are shared out among them."""

    antialias: int = 2
    """Samples along each side of a pixel when a head is rendered."""

    assets: Path | None = None
    """Directory of your own unpacked MakeHuman assets, for skins, hair, brows and eyes."""

    background: Literal["changing", "black", "green"] = "changing"
    """Behind the people: black, a green screen, or black in the first half of the takes and green after."""

    clean_plates: bool = False
    """Also write an image of the empty studio per take and camera."""

    sensor: SensorConfig = field(default_factory=SensorConfig)
    board: BoardConfig = field(default_factory=BoardConfig)
    drift: DriftConfig = field(default_factory=DriftConfig)

    jobs: int = 0
    """Worker processes; 0 uses every core. The images do not depend on it."""

    dry_run: bool = False
    """State images, the size of markers, bytes, time and free disk, and write nothing."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of every image, in pixels."""
        return parse_resolution(self.resolution)

    @property
    def workers(self) -> int:
        """Number of worker processes."""
        return self.jobs or len(os.sched_getaffinity(0))


NOT_CONTENT = ("output", "jobs", "dry_run", "assets")


def content(config: StudioConfig) -> dict[str, Any]:
    """The part of the configuration that the files depend on, as plain JSON values, without what was not chosen."""
    chosen = {name: value for name, value in asdict(config).items() if name not in NOT_CONTENT}
    return _plain(chosen | {"assets": config.assets is not None})  # whether, not where they lie on this disk


def parse_resolution(text: str) -> tuple[int, int]:
    """(width, height) from "WIDTHxHEIGHT"; raises UsageError."""
    match = re.fullmatch(r"(\d+)[xX](\d+)", text)
    if not match:
        raise UsageError("--resolution", text, "not WIDTHxHEIGHT", "write for example 256x384")
    width, height = int(match[1]), int(match[2])
    if not (16 <= width <= MAX_SIDE and 16 <= height <= MAX_SIDE):
        raise UsageError(
            "--resolution", text, "too small or too large", f"use sides of 16 to {MAX_SIDE} pixels"
        )
    return width, height


def validate(config: StudioConfig) -> None:
    """Check every flag; raises UsageError for the first one that cannot work."""
    parse_resolution(config.resolution)
    _check_finite(config, "--")
    _check_range("--identities", config.identities, 0, 100_000)
    _check_range("--views", config.views, 1, MAX_VIEWS)
    _check_range("--seed", config.seed, 0, 2**63 - 1)
    _check_range("--takes", config.takes, 1, 1000)
    _check_range("--antialias", config.antialias, 1, 16)
    _check_range("--jobs", config.jobs, 0, 1024)
    if config.assets is not None and not config.assets.is_dir():
        raise UsageError("--assets", config.assets, "no such directory", "unpack the assets there or omit it")
    if config.output.exists() and not config.output.is_dir():
        raise UsageError("--output", config.output, "is a file", "name a directory")
    _validate_sensor(config.sensor)
    _validate_board(config.board)
    _check_range("--drift.translation-mm", config.drift.translation_mm, 0, 100)
    _check_range("--drift.rotation-degrees", config.drift.rotation_degrees, 0, 10)


def _validate_sensor(sensor: SensorConfig) -> None:
    _check_range("--sensor.blur", sensor.blur, 0, 100)
    _check_range("--sensor.full-well", sensor.full_well, 0, 1e9)
    _check_range("--sensor.read-noise", sensor.read_noise, 0, 1e6)
    _check_range("--sensor.vignetting", sensor.vignetting, 0, 4)
    _check_range("--sensor.exposure", sensor.exposure, 1e-3, 1e3)
    _check_range("--sensor.exposure-seed", sensor.exposure_seed or 0, 0, 2**63 - 1)


def _validate_board(board: BoardConfig) -> None:
    across, down = board.squares
    shown = f"{across} {down}"
    _check_range("--board.squares", min(across, down), 3, 60)
    _check_range("--board.squares", max(across, down), 3, 60)
    if (across + down) % 2 == 0:
        raise UsageError("--board.squares", shown, "looks the same upside down", "make one odd and one even")
    _check_range("--board.square-mm", board.square_mm, 1, 1000)
    _check_range("--board.marker-ratio", board.marker_ratio, 0.3, 0.95)
    _check_range("--board.frames", board.frames, 1, 100_000)
    _check_range("--board.tilt", board.tilt, 0, 80)
    # A bow steeper than this hides parts of the board behind itself.
    limit = 0.1 * min(across, down) * board.square_mm
    for bow in board.bow_mm:
        _check_range("--board.bow-mm", bow, -limit, limit)


def _check_range(flag: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise UsageError(flag, value, "out of range", f"use {low:g} to {high:g}")


def _check_finite(config: Any, prefix: str) -> None:
    for item in fields(config):
        value = getattr(config, item.name)
        flag = prefix + item.name.replace("_", "-")
        if is_dataclass(value):
            _check_finite(value, flag + ".")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise UsageError(flag, number, "not a finite number", "give a finite one")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items() if item is not None}
    return list(value) if isinstance(value, tuple) else value
