"""Every choice of a fit as plain data; the docs of the fields are the help of ``preface-fit``.

Nothing here imports torch. Defaults are the paper's. `FitRunConfig` holds what the head does not depend on (but for
rounding): a fit may be resumed with another of it, and with nothing else changed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from preface.model.configuration import MAX_LEVELS, PRESETS, ModelConfig, carried_levels
from preface.model.training.configuration import TrainingConfigError, require

Start = Literal["zeros", "noise", "mean", "nearest", "furthest"]
Quality = Literal["draft", "balanced", "reference", "paper"]
MAX_VIEWS = 7
# Finetuning steps by the side of a square image (the paper, supplementary material, finetuned model).
PAPER_STEPS = ((256, 25_000), (512, 50_000), (1024, 100_000), (2048, 200_000), (4096, 300_000))
LEAST_PATCH = {"vgg": 16, "alex": 31}  # pixels; below, LPIPS has nothing left to compare


@dataclass(frozen=True)
class InversionConfig:
    """Finding the code with frozen networks."""

    steps: int = 1500
    """Steps; 0 leaves the code where it starts. The paper: 1,500."""
    patches: int = 8
    """Patches per step. The paper: 8."""
    patch: int = 32
    """Side of a patch, pixels; 16 or more, 31 with --inversion.network alex. The paper: 32."""
    rate: float = 1e-3
    """Learning rate, constant. The paper: 0.001."""
    start: Start = "zeros"
    """Where the code starts: `zeros` (the paper); `noise`, as large as the prior's codes; their `mean`; or that of
    the `nearest` or `furthest` identity of the prior, by the colours that it renders in the views."""
    lpips: float = 0.2
    """Weight of LPIPS beside the absolute difference; 0 does without. The paper: 0.2."""
    network: Literal["vgg", "alex"] = "vgg"
    """The network of LPIPS. The paper does not say."""


@dataclass(frozen=True)
class CamerasConfig:
    """With --refine-cameras, after inversion: small corrections of the cameras. Not in the paper."""

    steps: int = 40
    """Steps in which cameras alone move; inversion's follow once more if the corrections are kept."""
    rays: int = 512
    """Rays per step, from the boxes around the head's pixels."""
    rate: float = 1e-3
    """Learning rate of the first step, radians and scene units."""
    rate_last: float = 5e-5
    """Learning rate of the last step; it falls by the same factor at each."""
    weight: float = 3e-4
    """Weight of the pull to the cameras that were given, which supposes that they are off by half a degree and
    2 mm; the smaller, the further they may move."""
    least_gain: float = 0.8
    """Corrections are kept if the views are met better by this much, dB of the mean squared error. With a `small`
    prior right cameras gained 0.1 to 0.5, cameras off by half a degree and 2 mm 1.1 to 4.5."""


@dataclass(frozen=True)
class FinetuningConfig:
    """Adapting all weights, and the code, to the views."""

    steps: int | Literal["auto"] = "auto"
    """Steps; 0 leaves the prior's weights, `auto` is the paper's number for the resolution: 25,000 at 256x256,
    50,000 at 512x512, 100,000 at 1024x1024, 200,000 at 2048x2048, 300,000 at 4096x4096."""
    rays: int = 8192
    """Rays per step. The paper: 8,192 (printed as 8,912)."""
    foreground_share: float = 0.0
    """The share of rays that are drawn from the boxes around the head's pixels instead of from whole images. The
    paper: none."""
    rate: float = 1e-3
    """Learning rate of the first step. The paper: 0.001."""
    rate_last: float = 2e-5
    """Learning rate of the last step; it falls by the same factor at each. The paper: 0.00002."""
    clip: float = 1e-3
    """Largest norm of the gradient of each network and of the code; 0 does not clip. The paper: 0.001."""
    eps: float = 1e-8
    """Adam's epsilon, see preface-train."""
    interlevel: float = 1.0
    """Weight of the loss that teaches the proposal network. The paper: 1."""
    elsewhere: float = 0.0
    """Share of the rays of a step that are turned about the head and rendered again, without colours, to teach the
    proposal network there, too; 0 for none. Proposals that know the views fitted to alone miss what others see. The
    paper: none."""
    opacity: float = 0.0
    """Weight of the mean absolute difference between opacity and mask, on black; 0 for none. Colours alone cannot tell
    black hair from a black background. The paper: none."""
    normals: float = 1e-3
    """Weight of the disagreement between predicted and analytic normals; 0 does without the head that predicts
    them. The paper: 0.001."""
    view_weights: float = 1e-4
    """Weight of the squared norm of the weights that see the direction; 0 does without. The paper: 0.0001."""
    orientation: float = 0.0
    """Weight of Ref-NeRF's penalty on visible normals that face away from the camera; 0 for none. The paper: none."""
    levels: int | Literal["auto", "prior"] = "prior"
    """Levels of the position's encoding: those of the `prior`, as many as the views can carry if these are more
    (`auto`), or a number, not below the prior's. For views finer than the prior's images and long fits: after 300 steps
    at 256x384 a twelfth level beside eleven gained nothing. With --prior none this holds for --like; otherwise
    --model.levels does. The paper: 12 for prior and head, at any resolution."""
    frozen_latent: bool = False
    """Keep the code that inversion found, and adapt the networks only."""


@dataclass(frozen=True)
class FitRunConfig:
    """Where and how it runs. A fit may be resumed with other values."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to fit; auto takes CUDA if there is one."""
    micro_rays: int = 1024
    """Rays at a time; lower it if memory runs out, which normals need three times as much of as a prior's training.
    The gradient is that of the whole batch in any case. Patches of inversion are kept whole."""
    products: Literal["auto", "mkl", "onednn"] = "auto"
    """How a CPU multiplies float32 matrices, see preface-train."""
    log_every: int = 25
    """Steps between two lines of the log."""
    checkpoint_minutes: float = 10.0
    """Minutes between two checkpoints; there is one at each preview, after inversion and at the end, too."""
    preview_every: int = 1000
    """Steps between two previews; 0 for none but those at the end of each phase, which there are in any case."""


@dataclass(frozen=True)
class FitConfig:
    """Fit a prior to one to seven views of a head; the same command resumes a fit.

    Writes model.safetensors, model.json and training_state.safetensors, which every command takes that takes a
    prior; log.jsonl, events for TensorBoard and, in previews/, pictures of the views and of a new one.
    """

    shards: Annotated[Path, tyro.conf.Positional]
    """Folder of the shards that hold the views."""
    output: Path = Path("head")
    """Folder of the head."""
    prior: Literal["pretrained", "none"] | Path = "pretrained"
    """Folder of the prior; `pretrained` is the one that comes with preface, of synthetic heads (a folder of this name
    is ./pretrained); `none` trains the model of --model from random weights without a code, the baseline."""
    identity: str | None = None
    """Whose views; may be left out where the shards hold one identity only."""
    views: tuple[str, ...] = ()
    """Names of one to seven cameras."""
    quality: Quality = "balanced"
    """Which defaults all flags below have: `draft`, `balanced` and `reference` are three points of the measured
    front of time and error with a small prior on processors, each over three times as long as the one before; `paper`
    has the paper's numbers, which are for a GPU."""
    refine_cameras: bool = False
    """Find small corrections of the cameras, too, and keep them if the views agree much better with them. Needs a
    prior."""
    seed: int = 0
    """Everything random follows from this number."""
    inversion: InversionConfig = field(default_factory=InversionConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    finetuning: FinetuningConfig = field(default_factory=FinetuningConfig)
    run: Annotated[FitRunConfig, tyro.conf.arg(name="")] = field(default_factory=FitRunConfig)
    model: ModelConfig = field(default_factory=lambda: PRESETS["small"])
    """The architecture for --prior none; its latent is not used."""
    like: Literal["pretrained"] | Path | None = None
    """With --prior none: a prior whose architecture is taken instead, so that only its knowledge is missing; a folder,
    or `pretrained`."""

    @property
    def from_prior(self) -> bool:
        """Whether there is a prior."""
        return self.prior != "none"

    def inversion_steps(self) -> int:
        """Steps of inversion; without a prior there is no code to find."""
        return self.inversion.steps if self.from_prior else 0

    def to_dict(self) -> dict[str, Any]:
        """What the head depends on besides the shards' and the prior's bytes, as JSON data."""
        return {
            "identity": self.identity,
            "views": list(self.views),
            "quality": self.quality,
            "refine_cameras": self.refine_cameras,
            "seed": self.seed,
            "inversion": asdict(self.inversion) if self.from_prior else None,
            "cameras": asdict(self.cameras) if self.refine_cameras else None,
            "finetuning": asdict(self.finetuning),
            "model": None if self.from_prior else self.model.to_dict(),
        }


# By name. With the `small` prior, two views of 96x144 and few steps: the paper's rate hardly moves inversion's code (in
# 60 steps held-out views gain 0.6 dB, 6 dB at 1e-2; 2e-2 is there in 40, and 100 gain nothing once finetuned).
# Finetuning at 3e-3 is 0.7 dB ahead after 50 steps, and 0.5 dB behind 1e-3 after 200; 2e-3 is 0.3 dB behind after 800.
# Half the rays in twice the steps gain 0.65 dB, and half of the rays on the head 0.4 dB, both at 50 steps of 512 rays.
# Opacity held against masks, in a `tiny` prior and the fit, gained 0.9 dB on a head of black hair, and an IoU of
# silhouettes of 0.95 in place of 0.61. From 800 to 3,000 steps SSIM and LPIPS gain as much as from 200 to 800; PSNR of
# one person gained 0.1 dB and of another lost 0.9, whose neck no view of the two shows. At so few steps regularisers
# change no figure; normals are what gives a head its predicted ones. Without proposals taught elsewhere the full render
# of an unseen person was 0.1, 0.4 and 1.5 dB behind `balanced` after 200, 800 and 3,000 steps; with them it is 0.01 and
# 0.02 dB ahead after 800 and 3,000, for 4% of the time.
QUALITIES: dict[str, tuple[InversionConfig, FinetuningConfig, FitRunConfig]] = {
    "draft": (
        InversionConfig(steps=40, patches=2, patch=16, rate=2e-2),
        FinetuningConfig(steps=200, rays=256, foreground_share=0.5, opacity=0.1),
        FitRunConfig(micro_rays=512, preview_every=0),
    ),
    "balanced": (
        InversionConfig(steps=40, patches=2, patch=16, rate=2e-2),
        FinetuningConfig(steps=800, rays=256, foreground_share=0.5, elsewhere=0.25, opacity=0.1),
        FitRunConfig(micro_rays=512, preview_every=0),
    ),
    "reference": (
        InversionConfig(steps=40, patches=2, patch=16, rate=2e-2),
        FinetuningConfig(steps=3000, rays=256, foreground_share=0.5, elsewhere=0.25, opacity=0.1),
        FitRunConfig(micro_rays=512, preview_every=0),
    ),
    "paper": (InversionConfig(), FinetuningConfig(), FitRunConfig()),
}


def defaults(quality: str) -> tuple[InversionConfig, FinetuningConfig, FitRunConfig]:
    """The defaults of a quality.

    Raises:
        KeyError: there is none of this name.
    """
    return QUALITIES[quality]


def finetuning_steps(config: FinetuningConfig, width: int, height: int) -> int:
    """Steps of finetuning for images of a size.

    The paper's numbers are for squares; a size between two of them gets a number between, linear in the logarithms
    of both, by the side of the square of the same area. Below the first the number goes with the side, beyond the
    last it stays.
    """
    if config.steps != "auto":
        return config.steps
    side = math.sqrt(width * height)
    sides, steps = zip(*PAPER_STEPS, strict=True)
    if side <= sides[0]:
        return max(1, round(steps[0] * side / sides[0]))
    for low in range(len(sides) - 1):
        if side <= sides[low + 1]:
            share = math.log(side / sides[low]) / math.log(sides[low + 1] / sides[low])
            return round(steps[low] * (steps[low + 1] / steps[low]) ** share)
    return steps[-1]


def finetuning_levels(config: FinetuningConfig, known: int, smallest_radius: float) -> int:
    """Levels of the encoding that finetuning works with, never fewer than there are.

    Args:
        config: see there.
        known: levels that the model has.
        smallest_radius: of the views' pixels, as `carried_levels` takes it; 0 of cameras within the box, which do not
            tell how near the head is, so that the model keeps its own.

    Raises:
        TrainingConfigError: fewer are asked for.
    """
    if config.levels == "prior" or (config.levels == "auto" and smallest_radius <= 0):
        return known
    if config.levels == "auto":
        return max(known, carried_levels(smallest_radius))
    remedy = f"the prior has {known}; give that or more, auto or prior"
    require(config.levels >= known, "finetuning.levels", config.levels, remedy)
    return config.levels


def check(config: FitConfig) -> None:
    """Refuse values that cannot work.

    Raises:
        TrainingConfigError: naming the flag, its value and the remedy.
    """
    _check_views(config.views)
    require(config.seed >= 0, "seed", config.seed, "give 0 or more")
    require(
        config.like is None or not config.from_prior, "like", config.like, "give it with --prior none only"
    )
    inversion, finetuning, run = config.inversion, config.finetuning, config.run
    least = LEAST_PATCH[inversion.network] if inversion.lpips > 0 else 1
    _check_numbers("inversion.", inversion, {"steps": 0, "patches": 1, "patch": least, "lpips": 0})
    _check_rates("inversion.", inversion, ("rate",))
    if config.refine_cameras:
        _check_cameras(config)
    numbers: dict[str, float] = {
        "rays": 1,
        "clip": 0,
        "interlevel": 0,
        "opacity": 0,
        "normals": 0,
        "view_weights": 0,
        "orientation": 0,
    }
    if finetuning.steps != "auto":
        numbers["steps"] = 0
    _check_numbers("finetuning.", finetuning, numbers)
    _check_rates("finetuning.", finetuning, ("rate", "rate_last", "eps"))
    levels = finetuning.levels
    possible = isinstance(levels, str) or 0 <= levels <= MAX_LEVELS
    require(possible, "finetuning.levels", levels, f"give 0 to {MAX_LEVELS}, auto or prior")
    _check_share("finetuning.foreground-share", finetuning.foreground_share)
    _check_share("finetuning.elsewhere", finetuning.elsewhere)
    limits = {"micro_rays": 1, "log_every": 1, "checkpoint_minutes": 0, "preview_every": 0}
    _check_numbers("", run, limits)


def _check_views(views: tuple[str, ...]) -> None:
    if not 1 <= len(views) <= MAX_VIEWS:
        raise TrainingConfigError(
            f"--views: {len(views)} cameras; name one to seven cameras of the shards, such as --views cam03 cam09"
        )
    twice = [name for name in views if views.count(name) > 1]
    if twice:
        raise TrainingConfigError(f"--views {twice[0]}: is there twice; name each camera once")


def _check_cameras(config: FitConfig) -> None:
    cameras = config.cameras
    remedy = "leave it out, or fit from a prior: without one nothing says where the head is"
    require(config.from_prior, "refine-cameras", True, remedy)
    _check_numbers("cameras.", cameras, {"steps": 1, "rays": 1, "weight": 0, "least_gain": 0})
    _check_rates("cameras.", cameras, ("rate", "rate_last"))


def _check_numbers(prefix: str, values: Any, limits: Mapping[str, float]) -> None:
    for name, least in limits.items():
        value = getattr(values, name)
        require(value >= least and math.isfinite(value), prefix + name, value, f"give {least:g} or more")


def _check_share(name: str, share: float) -> None:
    require(0 <= share <= 1, name, share, "give a share, 0 to 1")


def _check_rates(prefix: str, values: Any, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(values, name)
        require(value > 0 and math.isfinite(value), prefix + name, value, "give a positive number")
