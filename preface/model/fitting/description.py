"""What model.json says of a head before its first step, where the phases of its fit end, and what it comes to know."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from preface.artifacts import provenance, sha256
from preface.model.configuration import ModelConfig
from preface.model.fitting.configuration import FitConfig, finetuning_levels, finetuning_steps
from preface.model.training.data import TrainingData
from preface.model.training.prior_files import MODEL_FILE, Prior


class Ends(NamedTuple):
    """Steps of the run after which each phase is done; a phase without steps ends where the one before it does."""

    inversion: int
    cameras: int
    second_inversion: int
    finetuning: int


def ends_of(config: FitConfig, width: int, height: int) -> Ends:
    """Where the phases of a fit to views of a size end."""
    inversion = config.inversion_steps()
    cameras = inversion + config.cameras.steps * config.refine_cameras
    again = cameras + inversion * config.refine_cameras
    return Ends(inversion, cameras, again, again + finetuning_steps(config.finetuning, width, height))


def levels_of_head(config: FitConfig, prior: Prior | None, smallest_radius: float) -> int:
    """Levels of the encoding that a head ends with.

    Args:
        config: of the fit.
        prior: that it begins with, if any.
        smallest_radius: of the views' pixels, as `carried_levels` takes it.

    Raises:
        TrainingConfigError: fewer are asked for than there are.
    """
    known = (config.model if prior is None else prior.model).resolved(smallest_radius).levels
    assert isinstance(known, int)
    if prior is None and config.like is None:
        return known
    return finetuning_levels(config.finetuning, known, smallest_radius)


def inputs_of(data: TrainingData, prior: Prior | None) -> dict[str, Path]:
    """What a head is made of: the shards' manifest, and the prior."""
    return {"manifest.json": data.dataset.manifest.path, **({} if prior is None else {"prior": prior.path})}


def described_head(
    config: FitConfig, data: TrainingData, prior: Prior | None, model: ModelConfig, ends: Ends
) -> Prior:
    """The head that a fit begins with.

    Args:
        config: of the fit.
        data: the views fitted to.
        prior: that it begins with, if any.
        model: the head's architecture.
        ends: of its phases.
    """
    configuration = config.to_dict()
    width, height = data.scene.resolution
    fit = {
        "identity": data.names[0],
        "views": list(config.views),
        "shards": {"manifest": sha256(data.dataset.manifest.path), "path": str(config.shards)},
        "resolution": {"width": width, "height": height},
        "prior": None if prior is None else sha256(prior.path),
        "inversion": {"steps": ends.inversion, "loss": None},
        "finetuning": {"steps": ends.finetuning - ends.second_inversion},
        "cameras": {},
        "quality": config.quality,
    }
    return Prior(
        path=config.output / MODEL_FILE,
        model=model,
        identities=data.names,
        scene=data.scene,
        configuration=configuration,
        step=0,
        steps=ends.finetuning,
        held_out=data.held_out_names,
        validation={},
        products="",
        provenance=provenance(configuration, inputs_of(data, prior), config.seed),
        files={},
        fit=fit,
    )
