"""Every choice of a training run as plain data; the docs of the fields are the help of ``preface-train``.

Nothing here imports torch. `TrainingConfig` holds what the prior depends on, `RunConfig` what it does not
(but for rounding): a run may be resumed with another of the latter, not of the former.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from preface.model.configuration import PRESETS, ModelConfig


class TrainingConfigError(ValueError):
    """A flag whose value cannot work; the message names the flag, its value and the remedy."""


@dataclass(frozen=True)
class TrainingConfig:
    """What is trained on, and how. A run is resumed with the same values only."""

    steps: int = 1_000_000
    """Steps. The paper: 1,000,000."""
    identities: int = 64
    """Identities per step. The paper: 64."""
    views: int = 8
    """Views per identity and step. The paper: 8."""
    rays: int = 128
    """Rays per view and step. The paper: 128."""
    rate: float = 2e-3
    """Learning rate of the first step. The paper: 0.002."""
    rate_last: float = 2e-5
    """Learning rate of the last step; it falls by the same factor at each. The paper: 0.00002."""
    warmup: int = 0
    """Steps in which the rate rises from a hundredth. The paper mentions none; Mip-NeRF 360 has 512."""
    clip: float = 1e-3
    """Largest norm of the gradient of each network and of the codes; 0 does not clip. The paper: 0.001."""
    eps: float = 1e-8
    """Adam's epsilon. The paper does not say; at its clipping 1e-6, multinerf's, scales steps by about 0.2, and
    1e-8 by 0.97."""
    interlevel: float = 1.0
    """Weight of the loss that teaches the proposal network. Mip-NeRF 360 and the paper: 1."""
    opacity: float = 0.0
    """Weight of the mean absolute difference between opacity and mask, on black; 0 for none. Colours alone cannot tell
    black hair from a black background. The paper: none."""
    holdout_views: int = 1
    """Views of each identity that are never trained on, chosen by the seed, to measure and show. At least one view
    of each identity is trained on. The paper: none."""
    split: str = "train"
    """The split of the shards that is trained on."""
    seed: int = 0
    """Everything random follows from this number."""


@dataclass(frozen=True)
class RunConfig:
    """Where and how it runs. A run may be resumed with other values."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto takes CUDA if there is one. Start several processes with torchrun for several GPUs."""
    micro_rays: int = 8192
    """Rays at a time; lower it if memory runs out. The gradient is that of the whole batch in any case."""
    products: Literal["auto", "mkl", "onednn"] = "auto"
    """How a CPU multiplies float32 matrices: auto takes the faster of those that are exact, by trying, and a resumed
    run that of its steps before. They round differently: name one for runs that are to be equal bit for bit."""
    placement: Literal["auto", "device", "ram", "mmap"] = "auto"
    """Where the pixels are kept: on the device, in memory, or in the files, read as they are needed."""
    log_every: int = 100
    """Steps between two lines of the log."""
    checkpoint_minutes: float = 10.0
    """Minutes between two checkpoints; there is one at each validation and at the end, too."""
    validate_every: int = 0
    """Steps between two validations; 0 takes a tenth of all. There is one at the end in any case."""
    validate_minutes: float = 0.0
    """Minutes after which there is one too, if there was none; 0 for none."""
    validate_views: int = 4
    """Held-out views that a validation before the end renders."""
    final_views: int = 0
    """Held-out views that the last validation renders; 0 renders all."""
    faces_between: int = 3
    """Pairs of identities, the faces between whom are shown at the end; 0 for none."""
    dry_run: bool = False
    """State the model, the batches and the data, and train nothing."""


@dataclass(frozen=True)
class TrainConfig:
    """Train a prior, one model of many heads, on shards; the same command resumes a run.

    Writes model.safetensors, model.json and training_state.safetensors, log.jsonl, events for TensorBoard and, in
    validation/, pictures of views that were held out. Exit status: 0 when the prior is trained, 1 when something is
    wrong, 2 for wrong usage, 130 or 143 when interrupted (after a checkpoint).
    """

    shards: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SHARDS")]
    """Folder of the shards."""
    output: Path = Path("prior")
    """Folder of the prior."""
    preset: Literal["paper", "studio", "small", "tiny"] = "small"
    """Which defaults all flags below have: the paper's; for a GPU; for two processor cores and three quarters of
    an hour; for minutes."""
    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = field(default_factory=TrainingConfig)
    run: Annotated[RunConfig, tyro.conf.arg(name="")] = field(default_factory=RunConfig)
    model: ModelConfig = field(default_factory=ModelConfig)

    def to_dict(self) -> dict[str, Any]:
        """What the prior depends on, as JSON data."""
        return {"preset": self.preset, "training": asdict(self.training), "model": self.model.to_dict()}


# Batches, steps and rates beside the models of the same names.
TRAINING_PRESETS: dict[str, tuple[TrainingConfig, RunConfig]] = {
    "paper": (TrainingConfig(), RunConfig(micro_rays=4096)),
    "studio": (
        TrainingConfig(steps=50_000, identities=32, views=4, rays=64, opacity=0.1),
        RunConfig(micro_rays=8192, validate_views=8),
    ),
    "small": (
        TrainingConfig(steps=8_000, identities=16, views=4, rays=8, rate=5e-3, rate_last=1e-4, opacity=0.1),
        RunConfig(micro_rays=512, final_views=32),
    ),
    "tiny": (
        TrainingConfig(steps=800, identities=16, views=4, rays=8, rate=5e-3, rate_last=2e-4, opacity=0.1),
        RunConfig(micro_rays=512, validate_every=400, final_views=8, faces_between=1),
    ),
}


def defaults(preset: str) -> tuple[TrainingConfig, RunConfig, ModelConfig]:
    """The defaults of a preset.

    Raises:
        KeyError: there is none of this name.
    """
    training, run = TRAINING_PRESETS[preset]
    return training, run, PRESETS[preset]


def check(config: TrainConfig) -> None:
    """Refuse values that cannot work.

    Raises:
        TrainingConfigError: naming the flag, its value and the remedy.
    """
    training, run = config.training, config.run
    for name in ("steps", "identities", "views", "rays"):
        require(getattr(training, name) >= 1, name, getattr(training, name), "give 1 or more")
    for name in ("rate", "rate_last", "eps"):
        value = getattr(training, name)
        require(value > 0 and math.isfinite(value), name, value, "give a positive number")
    for name in ("warmup", "holdout_views", "seed", "clip", "interlevel", "opacity"):
        value = getattr(training, name)
        require(value >= 0 and math.isfinite(value), name, value, "give 0 or more")
    for name in ("micro_rays", "log_every", "validate_views"):
        require(getattr(run, name) >= 1, name, getattr(run, name), "give 1 or more")
    for name in ("validate_every", "final_views", "faces_between", "checkpoint_minutes", "validate_minutes"):
        value = getattr(run, name)
        require(value >= 0 and math.isfinite(value), name, value, "give 0 or more")
    require(
        config.model.latent > 0, "model.latent", config.model.latent, "a prior needs codes; give 1 or more"
    )
    require(
        training.opacity == 0 or config.model.background == "black",
        "opacity",
        training.opacity,
        "masks say nothing about what is modelled behind the head; give 0, or --model.background black",
    )
    require(
        config.model.background != "captured",
        "model.background",
        config.model.background,
        "shards hold no pictures of the empty studio; use black, or modelled for unmasked photographs",
    )


def require(holds: bool, name: str, value: Any, remedy: str) -> None:
    """Refuse the value of a flag that cannot work.

    Raises:
        TrainingConfigError: `holds` is false.
    """
    if not holds:
        raise TrainingConfigError(f"--{name.replace('_', '-')} {value}: cannot be; {remedy}")
