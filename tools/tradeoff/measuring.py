"""A way to render, measured: figures to photographs and to full renders, processor time, memory, operations.

Every point runs in a process of its own on one thread, so that its peak memory is its own. Time is that of the
processor, which other programs change less than the clock's.
"""

from __future__ import annotations

import dataclasses
import math
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from preface.model.evaluation.evaluate import photograph_on_black
from preface.model.evaluation.figures import judge
from preface.model.evaluation.views import standing_camera
from preface.model.matmul import choose_route, denormals_flushed, keep_freed_memory
from preface.model.metrics.image_quality import psnr
from preface.model.model import PriorModel
from preface.model.rendering.accelerated import precision_of
from preface.model.rendering.image import RenderedImage, render_image, space_of
from preface.model.rendering.paths import framing_camera, on_sphere
from preface.model.rendering.shortcuts import accelerate
from preface.model.training.prior_files import Prior, read_prior
from preface.shards import Dataset
from tradeoff.front import MOST
from tradeoff.points import NORMALS, Point

RAYS_AT_A_TIME = 4096
KEPT = ("rgb", "alpha", "depth")  # of full renders


@dataclass(frozen=True)
class Task:
    """A point and where its input lies.

    Attributes:
        point: to measure.
        folder: of the model, or `pretrained`.
        shards: of the photographs.
        views: identity and camera of each.
        full: folder of the fullest renders and of those as trained; written there if the point is one of them.
    """

    point: Point
    folder: str | Path
    shards: Path
    views: tuple[tuple[str, str], ...]
    full: Path


def measure_apart(task: Task) -> dict[str, Any]:
    """Measure in a fresh process."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(measure, task).result()


def measure(task: Task) -> dict[str, Any]:
    """Figures of a point: means over views, and the lowest PSNR to full renders."""
    torch.set_num_threads(1)
    keep_freed_memory()
    with denormals_flushed():
        return _measured(task)


def _measured(task: Task) -> dict[str, Any]:
    prior, dataset = read_prior(task.folder), Dataset(task.shards)
    model = prior.load_model().requires_grad_(False)
    if task.point.samples is not None:
        model.config = dataclasses.replace(model.config, samples=task.point.samples)
    choose_route(precision_of(model, task.point.shortcuts), width=model.nerf.width).apply()
    measuring = judge({"lpips": "vgg"}, torch.device("cpu"))
    before, rows = _peak_mib(), []
    _warm_up(prior, model, task.point)
    images = []
    for identity, camera in task.views:
        images.append(_render(prior, model, dataset, task.point, identity, camera))
    peak = _peak_mib() - before
    for (identity, camera), (image, seconds) in zip(task.views, images, strict=True):
        truth, mask = photograph_on_black(dataset, identity, camera)
        values = dict(measuring.whole(np.clip(image.rgb, 0, 1), truth, image.alpha, mask).values)
        rows.append({**values, **seconds, **_to_full(task, identity, camera, image)})
    mean = {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}
    to_others = ("psnr_to_full", "psnr_to_trained")
    lowest = {f"lowest_{name}": min(row[name] for row in rows) for name in to_others if name in rows[0]}
    flops = _operations(prior, model, dataset, task)
    return {**mean, **lowest, "peak_mib": peak, "mflop_per_ray": flops}


def _render(
    prior: Prior, model: PriorModel, dataset: Dataset, point: Point, identity: str, camera: str
) -> tuple[RenderedImage, dict[str, float]]:
    """An image without normals, unless they are what is varied; CPU seconds to prepare, and microseconds per ray."""
    space = space_of(prior)
    code = model.codes[prior.identities.index(identity)] if model.config.latent else None
    standing = standing_camera(dataset, identity, camera)
    began = time.process_time()
    normals = point.group in NORMALS
    render = accelerate(model, code, space, point.shortcuts, normals=normals)
    ready = time.process_time()
    image = render_image(
        render, space, standing.camera, standing.canonical_from_camera, rays_at_a_time=RAYS_AT_A_TIME
    )
    taken = time.process_time() - ready
    microseconds = taken / image.alpha.size * 1e6
    return image, {"prepare_cpu_s": ready - began, "cpu_us_per_ray": microseconds}


def _warm_up(prior: Prior, model: PriorModel, point: Point) -> None:
    """Render a call's rays before time counts: libraries compile products of a kind at the first of them."""
    space, code = space_of(prior), model.codes[0] if model.config.latent else None
    box = space.box
    side = math.isqrt(RAYS_AT_A_TIME)
    camera, pose = framing_camera(box.half_sides, 1.0, side, side), on_sphere(box.center, 0.0, 0.0, 1.0)
    render_image(
        accelerate(model, code, space, point.shortcuts), space, camera, pose, rays_at_a_time=RAYS_AT_A_TIME
    )


def _to_full(task: Task, identity: str, camera: str, image: RenderedImage) -> dict[str, float]:
    """PSNR, opacity and depth against the fullest render, and PSNR against the model as trained."""
    of = f"{task.point.model}-{identity}-{camera}.npz"
    fullest = task.point.group == "fullest"
    full = _kept(task.full / f"fullest-{of}", image, write=fullest)
    solid = np.isfinite(full["depth"]) & np.isfinite(image.depth)
    off = np.abs(image.depth - full["depth"])[solid] * 1000
    found = {
        "psnr_to_full": _decibels(image.rgb, full["rgb"]),
        "alpha_off": float(np.abs(image.alpha - full["alpha"]).mean()),
        "depth_off_median_mm": float(np.median(off)) if len(off) else 0.0,
        "depth_off_p95_mm": float(np.percentile(off, 95)) if len(off) else 0.0,
    }
    if fullest:  # which is measured before there is a render as trained
        return found
    trained = _kept(task.full / f"trained-{of}", image, write=task.point.as_trained)
    return {**found, "psnr_to_trained": _decibels(image.rgb, trained["rgb"])}


def _kept(path: Path, image: RenderedImage, *, write: bool) -> dict[str, np.ndarray]:
    """The render that others are compared with, written first if this is it."""
    if write:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **{name: getattr(image, name) for name in KEPT})
    with np.load(path) as kept:
        return {name: kept[name] for name in KEPT}


def _decibels(image: np.ndarray, other: np.ndarray) -> float:
    return min(psnr(torch.from_numpy(image), torch.from_numpy(other)), MOST)


def _operations(prior: Prior, model: PriorModel, dataset: Dataset, task: Task) -> float:
    """Floating-point operations of matrix products per ray of the first view, in millions, without the grid's."""
    identity, camera = task.views[0]
    space = space_of(prior)
    code = model.codes[prior.identities.index(identity)] if model.config.latent else None
    render = accelerate(model, code, space, task.point.shortcuts)
    standing = standing_camera(dataset, identity, camera)
    with FlopCounterMode(display=False) as counter:
        render_image(
            render, space, standing.camera, standing.canonical_from_camera, rays_at_a_time=RAYS_AT_A_TIME
        )
    return counter.get_total_flops() / (standing.camera.width * standing.camera.height) / 1e6


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def views_of(prior: Prior, dataset: Dataset, people: Sequence[str], each: int) -> tuple[tuple[str, str], ...]:
    """Views that the model has not seen, at most so many of each person."""
    from preface.model.evaluation.views import choose_views

    return tuple((who, name) for who in people for name in choose_views([prior], dataset, who, None)[:each])
