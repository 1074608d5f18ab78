"""What is found out before the first step of a fit: its prior, and the checkpoint that it goes on from."""

from __future__ import annotations

from dataclasses import replace

from preface.artifacts import ArtifactError, provenance
from preface.model import pretrained
from preface.model.fitting.configuration import FitConfig
from preface.model.fitting.description import inputs_of
from preface.model.fitting.observations import template_gap
from preface.model.training.data import TrainingData
from preface.model.training.folder import require_same_run
from preface.model.training.loop import Say
from preface.model.training.prior_files import MODEL_FILE, Prior, read_prior
from preface.shards import Dataset

_SAME_TEMPLATE = 1e-3  # metres; keypoints are found to some millimetres


def prior_of(config: FitConfig, say: Say) -> Prior | None:
    """The prior of a fit, None for random weights; a person is told if it is half trained.

    Raises:
        ArtifactError: it cannot be read, or is a head.
    """
    if not config.from_prior:
        return None
    prior = read_prior(config.prior)
    if prior.is_head:
        problem = "is that of a head, which knows one identity"
        raise ArtifactError(prior.path, "fit", problem, "Give the folder of a prior, or --prior none")
    if not prior.finished:
        say(
            f"{config.prior}: trained for {prior.step:,} of {prior.steps:,} steps only; the fit can be as good as that"
        )
    return prior


def like_its_prior(config: FitConfig) -> FitConfig:
    """The configuration with the architecture of the prior that --like names, if it names one.

    Raises:
        ArtifactError: that prior cannot be read.
    """
    return config if config.like is None else replace(config, model=read_prior(config.like).model)


def note_template(dataset: Dataset, prior: Prior, say: Say) -> None:
    """Tell of faces that are elsewhere than the prior expects them."""
    gap = template_gap(dataset, prior)
    if gap is not None and gap > _SAME_TEMPLATE:
        folder = prior.path.parent
        template = pretrained.PRETRAINED if folder == pretrained.FOLDER else pretrained.flag_word(folder)
        say(
            f"note: the people of {dataset.manifest.path.parent} were placed on another template than the prior's, "
            f"{1e3 * gap:.1f} mm away (RMS); align them with preface-align studio CAPTURE --rig RIG --template "
            f"{template}"
        )


def checkpoint_of(config: FitConfig, data: TrainingData, prior: Prior | None) -> Prior | None:
    """The checkpoint to go on from, None to begin.

    Raises:
        ArtifactError: it is a prior's, or of another fit; the message names what differs.
    """
    if not (config.output / MODEL_FILE).exists():
        return None
    before = read_prior(config.output)
    if not before.is_head:
        problem = "is that of a prior, which a fit would overwrite"
        raise ArtifactError(before.path, "fit", problem, "Choose another --output")
    inputs = provenance({}, inputs_of(data, prior))["inputs"]
    ours = {**config.to_dict(), "inputs": inputs}
    require_same_run(before.path, ours, {**before.configuration, "inputs": dict(before.provenance["inputs"])})
    return before


def may_correct(before: Prior) -> bool:
    """Whether the checkpoint's corrections were kept, or are not judged yet."""
    assert before.fit is not None
    return bool(before.fit.get("refinement", {"kept": True})["kept"])
