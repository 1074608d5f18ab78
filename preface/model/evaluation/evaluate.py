"""A head held against photographs: rendered at their cameras and resolution, and measured view by view.

    prior, dataset = read_prior("head/"), Dataset("shards/")
    evaluation = evaluate_head(prior, dataset, "id0060", None, EvaluationOptions())
    evaluation.mean["psnr_face"], evaluation.views[0].rgb, evaluation.views[0].figures.values["psnr"]

The truth is the photograph on black by its mask, over the whole frame, as in the paper; the render is what the head
shows of the box on black, so that what floats beside the head counts against it. A prior that also models the
background is masked as the photograph is: what it shows beside the head is background that it was asked to learn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from preface.artifacts import ArtifactError
from preface.geometry import GeometryError, Rigid
from preface.model.evaluation.figures import Figures, Judge, judge
from preface.model.evaluation.metrics_file import mean_of
from preface.model.evaluation.options import EvaluationOptions
from preface.model.evaluation.views import (
    Square,
    StandingCamera,
    camera_names,
    choose_views,
    degrees_between,
    face_square,
    fitted_views,
    number_of,
    require_same_space,
    standing_camera,
)
from preface.model.model import PriorModel
from preface.model.rendering.image import RenderedImage, RenderRays, Space, render_image, space_of
from preface.model.rendering.shortcuts import QUALITIES, Shortcuts, accelerate
from preface.model.training.prior_files import Prior
from preface.shards import Dataset


@dataclass(frozen=True, eq=False)
class ViewFigures:
    """What was measured at a view.

    Attributes:
        name: of the camera.
        fitted: whether the model has seen this photograph.
        degrees_from_fitted: the angle at the canonical origin to the nearest camera of a photograph that it has seen;
            None where it has seen none of this identity.
        values: figures by name; those of the face end in `_face`.
        left_out: why a figure is not among them.
        face: the square of the face, None where there is none.
        canonical_from_camera: pose.
    """

    name: str
    fitted: bool
    degrees_from_fitted: float | None
    values: Mapping[str, float]
    left_out: Mapping[str, str]
    face: Square | None
    canonical_from_camera: Rigid


@dataclass(frozen=True, eq=False)
class EvaluatedView:
    """A view of H rows and W columns with all that was compared.

    Attributes:
        figures: see there.
        truth, rgb: float32 [H, W, 3] in [0, 1], sRGB-encoded, on black.
        mask, alpha: float32 [H, W], the photograph's foreground and the render's opacity.
        depth: float32 [H, W], metres along the camera's axis, NaN where the model is transparent.
        normals: float32 [H, W, 3], canonical frame, of length one or NaN; None where they were not asked for.
    """

    figures: ViewFigures
    truth: np.ndarray
    rgb: np.ndarray
    mask: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    normals: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A head's views; `mean` has each figure's mean over the views that have it."""

    identity: str
    views: tuple[EvaluatedView, ...]

    @property
    def mean(self) -> dict[str, float]:
        """Means by figure."""
        return mean_of([view.figures.values for view in self.views])


def evaluate_head(
    prior: Prior,
    dataset: Dataset,
    identity: str,
    views: Sequence[str] | None,
    options: EvaluationOptions,
) -> Evaluation:
    """Evaluate a head, or an identity of a prior, and keep every image.

    Args:
        prior: the model, read.
        dataset: with the identity's photographs, at any resolution.
        identity: in both.
        views: cameras; None for all valid views that the model has not seen.
        options: see there.

    Raises:
        ArtifactError: as `evaluate_views`; no view is left, or the weights of LPIPS are missing.
    """
    chosen = choose_views([prior], dataset, identity, views)
    measure = judge(options.networks, torch.device(options.device))
    return Evaluation(identity, tuple(evaluate_views(prior, dataset, identity, chosen, options, measure)))


def evaluate_views(
    prior: Prior,
    dataset: Dataset,
    identity: str,
    views: Sequence[str],
    options: EvaluationOptions,
    measure: Judge,
) -> Iterator[EvaluatedView]:
    """Evaluate views one after the other, so that a caller need not hold their images together.

    Args:
        prior, dataset, identity, options: as `evaluate_head`.
        views: cameras that there are.
        measure: with the networks that the options name (`figures.judge`).

    Raises:
        ArtifactError: another box, weights that are missing or damaged, or a damaged view.
    """
    require_same_space(prior, dataset)
    model = prior.load_model().to(options.device)
    space = space_of(prior)
    row, shortcuts = prior.identities.index(identity), QUALITIES[options.quality]
    render = head_renderer(model, row, space, shortcuts, normals=options.normals)
    seen = {name: standing_camera(dataset, identity, name) for name in _seen(prior, dataset, identity)}
    for name in views:
        standing = standing_camera(dataset, identity, name)
        try:
            image = render_image(
                render,
                space,
                standing.camera,
                standing.canonical_from_camera,
                rays_at_a_time=options.rays_at_a_time,
                device=options.device,
            )
        except GeometryError as error:
            raise ArtifactError(
                dataset.manifest.path, f"{identity}/{name}", str(error), "Build the shards again"
            ) from error
        truth, mask = photograph_on_black(dataset, identity, name)
        masked = model.config.background == "modelled"
        yield _compared(measure, standing, image, truth, mask, seen, options, masked=masked)


def head_renderer(
    model: PriorModel, row: int, space: Space, shortcuts: Shortcuts, *, normals: bool = True
) -> RenderRays:
    """What renders rays with the code of a row on black, without gradients, and with normals if they are wanted."""
    code = model.codes[row].detach() if model.config.latent else None
    return accelerate(model, code, space, shortcuts, normals=normals)


def photograph_on_black(dataset: Dataset, identity: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A photograph times its foreground, float32 [H, W, 3] in [0, 1], and the foreground [H, W].

    Raises:
        ArtifactError: the view is damaged.
    """
    view = camera_names(dataset, identity)[name]
    pixels = dataset.pixels(number_of(dataset, identity), view).astype(np.float32) / 255
    mask = pixels[..., 3]
    return pixels[..., :3] * mask[..., None], mask


def _seen(prior: Prior, dataset: Dataset, identity: str) -> list[str]:
    """Cameras of the photographs that the model has seen and that these shards have."""
    there = camera_names(dataset, identity)
    return [name for name in fitted_views(prior, dataset, identity) if name in there]


def _compared(
    measure: Judge,
    standing: StandingCamera,
    image: RenderedImage,
    truth: np.ndarray,
    mask: np.ndarray,
    seen: Mapping[str, StandingCamera],
    options: EvaluationOptions,
    *,
    masked: bool,
) -> EvaluatedView:
    rgb = np.clip(image.rgb, 0.0, 1.0)
    rgb = rgb * mask[..., None] if masked else rgb
    square = face_square(standing, options.face_half_side)
    whole = measure.whole(rgb, truth, image.alpha, mask)
    face = measure.no_face() if square is None else measure.pair(square.of(rgb), square.of(truth))
    both = (*_named(whole, ""), *_named(face, "_face"))
    pose = standing.canonical_from_camera
    angles = [degrees_between(pose, other.canonical_from_camera) for other in seen.values()]
    figures = ViewFigures(
        name=standing.name,
        fitted=standing.name in seen,
        degrees_from_fitted=min(angles) if angles else None,
        values=both[0] | both[2],
        left_out=both[1] | both[3],
        face=square,
        canonical_from_camera=pose,
    )
    normals = None
    if options.normals:  # a head of which a renderer found nothing has none either
        normals = np.full_like(rgb, np.nan) if image.normals is None else image.normals
    return EvaluatedView(figures, truth, rgb, mask, image.alpha, image.depth, normals)


def _named(figures: Figures, suffix: str) -> tuple[dict[str, float], dict[str, str]]:
    values = {f"{name}{suffix}": value for name, value in figures.values.items()}
    return values, {f"{name}{suffix}": why for name, why in figures.left_out.items()}
