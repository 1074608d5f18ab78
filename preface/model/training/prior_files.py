"""A prior or a head on the disk: ``model.json`` (schema preface/prior) beside the weights; see ``data_specs/prior.md``.

    prior = read_prior("prior/")
    model = prior.load_model()             # preface.model.model.PriorModel
    model.codes[prior.identities.index("id0007")]

Reading the description needs no torch.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from preface.artifacts import ArtifactError, read_artifact
from preface.model.configuration import ConfigurationError, ModelConfig
from preface.model.pretrained import prior_path

if TYPE_CHECKING:
    from preface.model.model import PriorModel

SCHEMA, SCHEMA_VERSION = "preface/prior", 1
ARCHITECTURE = "identity-conditioned Mip-NeRF 360 auto-decoder"
MODEL_FILE = "model.json"


@dataclass(frozen=True, eq=False)
class Scene:
    """The space that a model was trained in.

    Attributes:
        box: float64 [2, 3], corners, canonical frame, metres.
        near_far: depths between which heads lay in front of the cameras, metres.
        scene_scale: 1/metre; the model's lengths are metres times this.
        resolution: width and height of the training images, pixels.
    """

    box: np.ndarray
    near_far: tuple[float, float]
    scene_scale: float
    resolution: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Prior:
    """What ``model.json`` says.

    Attributes:
        path: of model.json.
        model: the configuration, with its levels resolved.
        identities: names; row i of `codes` is of identity i. A head has one.
        scene: see there.
        configuration: of the run, as `TrainConfig.to_dict` or `FitConfig.to_dict` gives it.
        step, steps: taken, and of the whole run.
        held_out: views by identity that were not trained on.
        validation: the last figures on them; empty before the first.
        products: the route of matrix products (`preface.model.matmul`); empty before the first step.
        provenance: as `preface.artifacts.provenance` returns it.
        files: file, bytes and SHA-256 by role.
        fit: of a head, what it was fitted to and how (see ``data_specs/prior.md``); None of a prior.
    """

    path: Path
    model: ModelConfig
    identities: tuple[str, ...]
    scene: Scene
    configuration: Mapping[str, Any]
    step: int
    steps: int
    held_out: Mapping[str, tuple[str, ...]]
    validation: Mapping[str, Any]
    products: str
    provenance: Mapping[str, Any]
    files: Mapping[str, Any]
    fit: Mapping[str, Any] | None = None

    @property
    def is_head(self) -> bool:
        """Whether it is one head, fitted to views, and not a prior."""
        return self.fit is not None

    @property
    def finished(self) -> bool:
        """Whether all steps were taken."""
        return self.step >= self.steps

    def load_model(self) -> PriorModel:
        """The model with its weights, on the CPU.

        Raises:
            ArtifactError: the weights are missing, are not those that model.json describes, or do not fit it.
        """
        from preface.model.model import PriorModel
        from preface.model.training.checkpoint import WEIGHTS, read_tensors, require_same_tensors

        weights = read_tensors(self.path, {"files": self.files}, WEIGHTS)
        model = PriorModel(self.model, len(self.identities))
        require_same_tensors(self.path.parent / self.files[WEIGHTS]["file"], weights, model.state_dict())
        model.load_state_dict(weights)
        return model


def prior_payload(prior: Prior) -> dict[str, Any]:
    """The content of model.json, but for `files`, which are described as they are written."""
    scene = prior.scene
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "architecture": ARCHITECTURE,
        "step": prior.step,
        "steps": prior.steps,
        "model": prior.model.to_dict(),
        "box": scene.box.tolist(),
        "near_far": list(scene.near_far),
        "scene_scale": scene.scene_scale,
        "resolution": {"width": scene.resolution[0], "height": scene.resolution[1]},
        "identities": list(prior.identities),
        "held_out_views": {name: list(views) for name, views in prior.held_out.items()},
        "validation": dict(prior.validation),
        "products": prior.products,
        "configuration": dict(prior.configuration),
        "provenance": dict(prior.provenance),
        **({} if prior.fit is None else {"fit": dict(prior.fit)}),
    }


def read_prior(path: str | os.PathLike[str]) -> Prior:
    """Read ``model.json``, or that of a folder, or for the text `pretrained` that of the prior that comes with preface.

    Raises:
        ArtifactError: unreadable, of another schema or architecture, or with fields that cannot be; `pretrained` in an
            installation that is without it.
    """
    path = prior_path(path)
    if path.is_file() and path.suffix != ".json":
        raise ArtifactError(path, "prior", "is not a prior", "Name the folder that preface-train wrote")
    path = path / MODEL_FILE if path.is_dir() else path
    content = read_artifact(path, SCHEMA)
    if content["architecture"] != ARCHITECTURE:
        problem = f"is '{content['architecture']}', and this preface knows '{ARCHITECTURE}'"
        raise ArtifactError(path, "architecture", problem, "Use the version of preface that trained it")
    try:
        model = ModelConfig.from_dict(content["model"])
    except (ConfigurationError, TypeError) as error:
        field, _, problem = str(error).partition(": ")
        remedy = "Use the version of preface that trained it, or restore the file from a copy"
        raise ArtifactError(path, f"model.{field}", problem or str(error), remedy) from error
    box = np.array(content["box"], dtype=np.float64)
    if not (box[0] < box[1]).all():
        raise ArtifactError(path, "box", "has no volume", "Restore the file from a copy")
    size = content["resolution"]
    near, far = content["near_far"]
    return Prior(
        path=path,
        model=model,
        identities=tuple(content["identities"]),
        scene=Scene(box, (near, far), content["scene_scale"], (size["width"], size["height"])),
        configuration=content["configuration"],
        step=content["step"],
        steps=content["steps"],
        held_out={name: tuple(views) for name, views in content["held_out_views"].items()},
        validation=content["validation"],
        products=content["products"],
        provenance=content["provenance"],
        files=content["files"],
        fit=content.get("fit"),
    )
