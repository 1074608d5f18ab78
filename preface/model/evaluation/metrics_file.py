"""The figures of one head on the disk: ``metrics.json``, schema preface/metrics; see ``data_specs/metrics.md``.

Nothing here imports torch, so that figures can be read and checked without waiting for it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from preface.artifacts import ArtifactError, provenance, read_artifact, write_artifact

if TYPE_CHECKING:
    from preface.model.evaluation.evaluate import ViewFigures
    from preface.model.evaluation.options import EvaluationOptions
    from preface.model.training.prior_files import Prior
    from preface.shards import Dataset

SCHEMA, SCHEMA_VERSION = "preface/metrics", 1
METRICS_FILE = "metrics.json"
# Every figure of a view, whole frame first; `_face` is of the face's square.
FIGURES = (
    "psnr",
    "ssim",
    "lpips",
    "lpips_alex",
    "psnr_foreground",
    "silhouette_iou",
    "psnr_face",
    "ssim_face",
    "lpips_face",
    "lpips_alex_face",
)
MEAN_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Measured:
    """A model at the views of an identity.

    Attributes:
        name: of the head in tables.
        prior: the model.
        identity: whose views.
        views: their figures.
    """

    name: str
    prior: Prior
    identity: str
    views: tuple[ViewFigures, ...]

    @property
    def mean(self) -> dict[str, float]:
        """The mean of each figure over the views that have it."""
        return mean_of([view.values for view in self.views])


def mean_of(views: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each figure over the views that have it, in the order of `FIGURES`."""
    known = {name: [values[name] for values in views if name in values] for name in FIGURES}
    return {name: sum(values) / len(values) for name, values in known.items() if values}


def write_metrics(
    path: str | os.PathLike[str],
    measured: Measured,
    dataset: Dataset,
    options: EvaluationOptions,
    config: Mapping[str, Any],
) -> Path:
    """Write the figures of a head.

    Args:
        path: of the file; its folder must exist.
        measured: the head and its figures.
        dataset: the photographs.
        options: that they were measured with.
        config: of the command, for the provenance.

    Raises:
        ArtifactError: the disk refuses.
    """
    manifest, prior = dataset.manifest, measured.prior
    inputs = {"model.json": prior.path, "manifest.json": manifest.path}
    return write_artifact(
        path,
        {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "name": measured.name,
            "kind": "head" if prior.is_head else "prior",
            "identity": measured.identity,
            "resolution": {"width": manifest.width, "height": manifest.height},
            "settings": options.settings(),
            "fit": dict(prior.fit) if prior.fit is not None else None,
            "views": [_view(view) for view in measured.views],
            "mean": measured.mean,
            "provenance": provenance(config, inputs),
        },
    )


def _view(view: ViewFigures) -> dict[str, Any]:
    square = view.face
    face = None if square is None else {"left": square.left, "top": square.top, "side": square.side}
    return {
        "name": view.name,
        "fitted": view.fitted,
        "degrees_from_fitted": view.degrees_from_fitted,
        **{name: view.values[name] for name in FIGURES if name in view.values},
        "face": face,
        "left_out": dict(view.left_out),
    }


def read_metrics(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read ``metrics.json``, or that of a folder.

    Returns:
        The content.

    Raises:
        ArtifactError: unreadable, not of this schema, a view twice, or a mean that is not that of its views.
    """
    path = Path(path) / METRICS_FILE if Path(path).is_dir() else Path(path)
    content = read_artifact(path, SCHEMA)
    names = [view["name"] for view in content["views"]]
    remedy = "Restore the file from a copy, or run preface-evaluate again"
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ArtifactError(path, "views", f"hold '{twice}' twice", remedy)
    expected = mean_of([{name: view[name] for name in FIGURES if name in view} for view in content["views"]])
    if set(expected) != set(content["mean"]):
        raise ArtifactError(path, "mean", "does not have the figures that its views have", remedy)
    for name, value in expected.items():
        if abs(value - content["mean"][name]) > MEAN_TOLERANCE * max(1.0, abs(value)):
            problem = f"is {content['mean'][name]}, and that of its views is {value}"
            raise ArtifactError(path, f"mean.{name}", problem, remedy)
    return content
