"""The work of ``preface-evaluate``: which heads at which views, and the files of each and of all."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, provenance, write_bytes
from preface.capture.images import write_png
from preface.cli.devices import usable_device
from preface.cli.folders import make_folder, require_own, require_writable
from preface.cli.output import say
from preface.model.evaluation import tables
from preface.model.evaluation.evaluate import EvaluatedView, evaluate_views, photograph_on_black
from preface.model.evaluation.figures import Judge, judge
from preface.model.evaluation.metrics_file import METRICS_FILE, Measured, write_metrics
from preface.model.evaluation.options import EvaluationOptions
from preface.model.evaluation.page import HeadResult, evaluation_page
from preface.model.evaluation.sheets import face_sheet, sheet, view_pictures
from preface.model.evaluation.views import (
    camera_names,
    choose_views,
    fitted_views,
    identity_of,
    require_same_space,
)
from preface.model.matmul import denormals_flushed, keep_freed_memory
from preface.model.pretrained import prior_path
from preface.model.rendering.showing import error_picture
from preface.model.training.prior_files import Prior, read_prior
from preface.reports.pictures import as_picture
from preface.shards import Dataset

MARKDOWN_FILE, LATEX_FILE, PAGE_FILE = "metrics.md", "metrics.tex", "report.html"
# What an evaluation leaves, an interrupted one, too.
OF_AN_EVALUATION = (MARKDOWN_FILE, LATEX_FILE, f"*/{METRICS_FILE}", "*/*.truth.png")


@dataclass(frozen=True, eq=False)
class Job:
    """A model, its name in tables, the identity, and the views to evaluate."""

    name: str
    prior: Prior
    identity: str
    views: tuple[str, ...]


def run(config: argparse.Namespace) -> list[str]:
    """Evaluate every head and write its files, then the tables and the page."""
    keep_freed_memory()
    options = EvaluationOptions(
        lpips=config.lpips,
        face_half_side=config.face_half_side,
        quality=config.quality,
        normals=config.normals,
        rays_at_a_time=config.rays_at_a_time,
        device=config.device,
    )
    with denormals_flushed(), Dataset(config.shards) as dataset:
        return _evaluated(config, dataset, options)


def _evaluated(config: argparse.Namespace, dataset: Dataset, options: EvaluationOptions) -> list[str]:
    jobs = _jobs(config, dataset)
    require_own(config.output, "an evaluation", OF_AN_EVALUATION)
    measure = judge(options.networks, usable_device(config.device))  # before anything takes time
    require_writable(config.output)
    folders = [make_folder(config.output / job.name) for job in jobs]
    settings = {key: _plain(value) for key, value in vars(config).items() if value is not None}
    results = []
    for job, folder in zip(jobs, folders, strict=True):
        result = _evaluate(job, folder, dataset, options, measure, images=config.images)
        write_metrics(folder / METRICS_FILE, result.measured, dataset, options, settings)
        _write_sheets(folder, result)
        results.append(result)
    rows = [tables.row_of(result.measured, len(result.fitted)) for result in results]
    write_bytes(config.output / LATEX_FILE, tables.latex(rows).encode())
    say(tables.markdown(rows).rstrip())
    inputs = {f"{job.name}/model.json": job.prior.path for job in jobs} | {
        "manifest.json": dataset.manifest.path
    }
    size = dataset.manifest.width, dataset.manifest.height
    page = evaluation_page(results, options, size, provenance(settings, inputs))
    write_bytes(config.output / MARKDOWN_FILE, tables.markdown(rows).encode())
    return [str(page.write(config.output / PAGE_FILE))]


# --------------------------------------------------------------------------------- who, and where


def _jobs(config: argparse.Namespace, dataset: Dataset) -> list[Job]:
    """What is to be done, once everything is known to fit together.

    Models of one identity are evaluated at the same views: those that none of them has seen.
    """
    priors = [read_prior(path) for path in config.heads]
    identities = [identity_of(prior, config.identity) for prior in priors]
    jobs = []
    for name, prior, identity in zip(_names(config.heads), priors, identities, strict=True):
        require_same_space(prior, dataset)
        prior.load_model()  # weights that are damaged are told of before anything takes time
        same = [p for p, i in zip(priors, identities, strict=True) if i == identity]
        jobs.append(Job(name, prior, identity, choose_views(same, dataset, identity, config.views)))
    return jobs


def _names(heads: Sequence[str | Path]) -> list[str]:
    """The names of heads: of their folders, with as many of those above as it takes to tell them apart.

    Raises:
        ArtifactError: one head is given twice.
    """
    paths = [prior_path(head) for head in heads]
    folders = [path.resolve() if path.is_dir() else path.resolve().parent for path in paths]
    for number, folder in enumerate(folders):
        if folder in folders[:number]:
            raise ArtifactError(heads[number], "HEAD", "is given twice", "Name each head once")
    for depth in range(1, max(len(folder.parts) for folder in folders) + 1):
        names = ["-".join(folder.parts[-depth:]).strip("/") for folder in folders]
        if len(set(names)) == len(names):
            return names
    return [f"{number}-{name}" for number, name in enumerate(names)]


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


# ---------------------------------------------------------------------------------- the evaluation


def _evaluate(
    job: Job, folder: Path, dataset: Dataset, options: EvaluationOptions, measure: Judge, *, images: bool
) -> HeadResult:
    """Evaluate a head view by view, keeping figures and small pictures."""
    figures, pictures, told, began = [], [], set[str](), time.perf_counter()
    evaluated = evaluate_views(job.prior, dataset, job.identity, job.views, options, measure)
    for number, view in enumerate(evaluated, 1):
        figures.append(view.figures)
        pictures.append(view_pictures(view))
        if images:
            _write_images(folder, view)
        passed = time.perf_counter() - began
        left = passed / number * (len(job.views) - number)
        say(
            f"{job.name}, {view.figures.name}: {view.figures.values['psnr']:.2f} dB; "
            f"{number} of {len(job.views)} views, {passed:.0f} s, about {left:.0f} s left"
        )
        for name, why in view.figures.left_out.items():
            if name not in told:  # once; the page lists every view
                say(f"{job.name}, from {view.figures.name} on: no {name}: {why}")
        told.update(view.figures.left_out)
    fitted = fitted_views(job.prior, dataset, job.identity)
    there = camera_names(dataset, job.identity)
    inputs = tuple(
        (photograph_on_black(dataset, job.identity, name)[0], name) for name in fitted if name in there
    )
    return HeadResult(
        Measured(job.name, job.prior, job.identity, tuple(figures)),
        fitted,
        inputs if job.prior.is_head else (),
        tuple(pictures),
    )


def _write_sheets(folder: Path, result: HeadResult) -> None:
    write_png(folder / "sheet.png", sheet(result.pictures))
    faces = face_sheet(result.pictures)
    if faces is not None:
        write_png(folder / "faces.png", faces)


def _write_images(folder: Path, view: EvaluatedView) -> None:
    """The photograph on black, the render, and their difference, at full size."""
    name = view.figures.name
    write_png(folder / f"{name}.truth.png", as_picture(view.truth))
    write_png(folder / f"{name}.png", as_picture(view.rgb))
    write_png(folder / f"{name}.error.png", error_picture(view.rgb, view.truth))
