"""A fit from views to a head's folder: find the views, invert, finetune, look, save, and end in order.

    ended = fit_head(FitConfig(Path("shards"), Path("head"), Path("prior"), "id0007", ("cam03", "cam09")), say=print)

All phases go through `preface.model.training.loop`, one after the other, and into one checkpoint, whose step counts
those of inversion, then those of finetuning. Between them, if cameras are refined, lie the steps in which these move,
and those of inversion once more, which are skipped when the corrections are not kept.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from preface.geometry import Box
from preface.model.configuration import ModelConfig
from preface.model.fitting.beginning import (
    checkpoint_of,
    like_its_prior,
    may_correct,
    note_template,
    prior_of,
)
from preface.model.fitting.cameras import CameraCorrections
from preface.model.fitting.configuration import FitConfig, check
from preface.model.fitting.description import described_head, ends_of, levels_of_head
from preface.model.fitting.finetuning import finetuning_trainer
from preface.model.fitting.heads import Correction, head_from_scratch, head_of_prior, with_predicted_normals
from preface.model.fitting.inversion import inversion_trainer
from preface.model.fitting.observations import grids, observe, view_numbers
from preface.model.fitting.previews import Previewer
from preface.model.fitting.reduction import FOLDER, reduce_views, reduced_size
from preface.model.fitting.refinement import gain, refinement_trainer, said_of_gain
from preface.model.fitting.starts import start_code
from preface.model.levels import with_levels
from preface.model.model import PriorModel
from preface.model.training.checkpoint import STATE, WEIGHTS, read_tensors, write_checkpoint
from preface.model.training.configuration import TrainingConfigError
from preface.model.training.data import TrainingData
from preface.model.training.folder import held_folder, show
from preface.model.training.interruption import Interruption
from preface.model.training.logs import RunLog
from preface.model.training.loop import Ended, Pace, Phase, Say, memory_explained, take_steps
from preface.model.training.prior_files import Prior, prior_payload
from preface.model.training.products import chosen_products
from preface.model.training.progress import Progress, train_flops_per_ray
from preface.model.training.ranks import Ranks, device_of_rank
from preface.model.training.trainer import Outcome, Trainer
from preface.shards import Dataset, Loader

PREVIEWS = "previews"
_START_GRID = 16  # pixels per side of a view by which the identity to start from is sought


def fit_head(config: FitConfig, say: Say) -> Ended:
    """Fit a head, or go on fitting it.

    Args:
        config: of the command.
        say: tells a person what is going on.

    Raises:
        TrainingConfigError: a flag that cannot work.
        ArtifactError: shards, prior, weights of LPIPS or the output are not as they must be.
        TrainingError: a loss is not finite, or memory is short.
    """
    check(config)
    try:
        device = device_of_rank(config.run.device)
    except ValueError as error:
        raise TrainingConfigError(str(error)) from error
    prior, config = prior_of(config, say), like_its_prior(config)
    with Dataset(config.shards) as dataset:
        data = observe(dataset, config.identity, config.views, prior)
        levels = levels_of_head(config, prior, data.smallest_radius)
        if prior is not None:
            note_template(dataset, prior, say)
        config = replace(config, identity=data.names[0])
        with held_folder(config.output, Ranks()):
            before = checkpoint_of(config, data, prior)
            if before is not None and before.finished and _preview(config.output, before.step).exists():
                say(f"{config.output}: all {before.steps:,} steps are taken already")
                return Ended(before.path, 0)
            return _Fit(config, data, prior, before, levels, device, say).go()


def _preview(folder: Path, step: int) -> Path:
    return folder / PREVIEWS / f"views-{step:08d}.png"


class _Fit:
    """A fit under way."""

    def __init__(
        self,
        config: FitConfig,
        data: TrainingData,
        prior: Prior | None,
        before: Prior | None,
        levels: int,
        device: torch.device,
        say: Say,
    ):
        self.config, self.data, self.device, self.say = config, data, device, say
        self._levels = levels
        self.output, self.ranks = config.output, Ranks()
        self._open = contextlib.ExitStack()
        self._prior, self._before = prior, before
        self._ends = ends_of(config, *data.scene.resolution)
        self._pairs = view_numbers(data, config.views)
        self._phase: Phase | None = None
        self._correction = None
        if config.refine_cameras and (before is None or may_correct(before)):
            self._correction = self._corrections(before)
        self._reduced: TrainingData | None = None
        self.model, self.head = self._new() if before is None else (before.load_model().to(device), before)

    # -------------------------------------------------------------------------------------- the phases

    def go(self) -> Ended:
        """Invert, correct the cameras and finetune, until all steps are taken or a signal comes."""
        run = self.config.run
        with self._open:
            interruption = self._open.enter_context(Interruption())
            self.say(self._plan())
            log = self._open.enter_context(RunLog(self.output, self.head.step))
            products = chosen_products(self.head.model, self.head.products, run.products, self.device)
            route = self._open.enter_context(products)
            self.head = replace(self.head, products=route.name)
            for prepare in (self._inversion, self._refinement, self._second_inversion, self._finetuning):
                phase = prepare()
                if phase is None:
                    continue
                self._phase = phase
                self._resume(phase)
                progress = Progress(phase.steps, train_flops_per_ray(self.model), 1e9 * route.gflops)
                if not take_steps(self, phase, progress, log, interruption):
                    return Ended(self.head.path, interruption.exit_status)
            if not _preview(self.output, self.head.step).exists():  # the last phase had no steps
                self.save()
                with memory_explained("what was found could not be shown", self._less()):
                    self.look(log, last=True)
        return Ended(self.head.path, 0)

    def _plan(self) -> str:
        if self._before is not None:
            return f"goes on from step {self.head.step:,} of {self.output}"
        width, height = self.data.scene.resolution
        cameras = f"{self.config.cameras.steps:,} of cameras, " if self.config.refine_cameras else ""
        return (
            f"{self.data.names[0]}: {len(self._pairs)} views of {width}x{height}; {self._ends.inversion:,} steps of "
            f"inversion, {cameras}{self._ends.finetuning - self._ends.second_inversion:,} of finetuning"
        )

    def _new(self) -> tuple[PriorModel, Prior]:
        """A head to begin with: the prior's, where its code starts, or random weights."""
        config = self.config
        if self._prior is None:
            model = head_from_scratch(replace(config.model, levels=self._levels), config.seed)
            return model.to(self.device), self._described(model.config)
        networks = self._prior.load_model().to(self.device)
        head = head_of_prior(networks, self._start_code(networks))
        return head, self._described(head.config)

    def _described(self, model: ModelConfig) -> Prior:
        return described_head(self.config, self.data, self._prior, model, self._ends)

    def _start_code(self, networks: PriorModel) -> Tensor:
        views = grids(self.data, _START_GRID, self.device)
        return start_code(networks, self.config.inversion.start, views, self.config.seed)

    def _inversion(self) -> Phase | None:
        """The steps of inversion that are left; None if there are none."""
        return self._inverting(0, None) if self.head.step < self._ends.inversion else None

    def _inverting(self, before: int, correction: Correction | None) -> Phase:
        """Inversion after so many steps of the run."""
        data = self._as_the_prior_sees()
        config, run = self.config.inversion, self.config.run
        trainer, loader = inversion_trainer(
            self.model, config, data, self.config.seed, run.micro_rays, self.device, correction
        )
        less = (
            f"fit again with --inversion.patches {max(config.patches // 2, 1)} or a smaller --inversion.patch"
        )
        remedy = "fit into another --output with a lower --inversion.rate"
        steps = self._ends.inversion
        return self._phase_of("inversion", trainer, loader, before, steps, remedy, less)

    def _refinement(self) -> Phase | None:
        """The steps in which cameras move that are left; None if there are none."""
        if self._correction is None or self.head.step >= self._ends.cameras:
            return None
        data = self._as_the_prior_sees()
        correction = self._seen_through(self._correction, data)
        config, run = self.config.cameras, self.config.run
        trainer, loader = refinement_trainer(
            self.model, config, data, self.config.seed, run.micro_rays, self.device, correction
        )
        remedy = "fit into another --output with a lower --cameras.rate"
        before, steps = self._ends.inversion, config.steps
        return self._phase_of("cameras", trainer, loader, before, steps, remedy, self._less())

    def _second_inversion(self) -> Phase | None:
        """Inversion's steps with corrected cameras that are left; None without, or where they are not kept."""
        self._judge()
        correction = self._correction
        if correction is None or self.head.step >= self._ends.second_inversion:
            return None
        phase = self._inverting(self._ends.cameras, self._seen_through(correction, self._as_the_prior_sees()))
        if phase.start == 0:
            assert self._prior is not None
            with torch.no_grad():
                self.model.codes.copy_(self._start_code(self._prior.load_model().to(self.device))[None])
        return phase

    def _judge(self) -> None:
        """Keep the corrections or drop them, found out once; nothing moves them from here on."""
        correction = self._correction
        if correction is None:
            return
        assert self.head.fit is not None
        correction.cameras.requires_grad_(False)
        if "refinement" in self.head.fit:
            return
        data, least = self._as_the_prior_sees(), self.config.cameras.least_gain
        found = gain(self.model, self._seen_through(correction, data), data, self.device)
        self.say(said_of_gain(found, least))
        self._note_gain(found, found >= least)
        self.save()  # there may be no step after it that would

    def _note_gain(self, found: float, kept: bool) -> None:
        """Note what was found; corrections that are not kept are forgotten, and the second inversion is done."""
        fit = {**(self.head.fit or {}), "refinement": {"gain_db": found, "kept": kept}}
        self.head = replace(self.head, fit=fit)
        if not kept:
            self._correction = None
            self.head = replace(self.head, step=self._ends.second_inversion, fit={**fit, "cameras": {}})

    def _as_the_prior_sees(self) -> TrainingData:
        """The views at the prior's resolution."""
        if self._reduced is None:
            assert self._prior is not None
            data = self.data
            size = reduced_size(data.scene.resolution, self._prior.scene.resolution)
            if size != data.scene.resolution:
                views = self._open.enter_context(Dataset(reduce_views(data, size, self.output / FOLDER)))
                data = observe(views, data.names[0], self.config.views, self._prior)
            self._reduced = data
        return self._reduced

    def _seen_through(self, correction: Correction, data: TrainingData) -> Correction:
        """The correction for rays of `data`: reduced views are those fitted to, in the same order, without others."""
        if data is self.data:
            return correction
        rows = correction.rows[torch.from_numpy(self.data.train.pairs[:, 1]).to(self.device)]
        return replace(correction, rows=rows)

    def _finetuning(self) -> Phase | None:
        """The steps of finetuning that are left; None if there are none."""
        steps = self._ends.finetuning - self._ends.second_inversion
        config, run = self.config.finetuning, self.config.run
        if steps == 0:
            return None
        self._grow()
        trainer, loader = finetuning_trainer(
            self.model,
            config,
            steps,
            self.data,
            self.config.seed,
            run.micro_rays,
            self.device,
            knows_heads=self._prior is not None,
            correction=self._correction,
        )
        remedy = "fit into another --output with a lower --finetuning.rate"
        return self._phase_of(
            "finetuning",
            trainer,
            loader,
            self._ends.second_inversion,
            steps,
            remedy,
            self._less(),
        )

    def _grow(self) -> None:
        """Give the model what finetuning asks for: levels for what the views show, and the layer for normals."""
        if self.model.levels < self._levels:
            before, self.model = self.model.levels, with_levels(self.model, self._levels)
            self.say(
                f"finetuning: {self._levels} levels of the encoding, of which the prior has {before}; the others, "
                "which are finer, begin at zero"
            )
        if self.config.finetuning.normals > 0:
            self.model = with_predicted_normals(self.model, self.config.seed)
        self.head = replace(self.head, model=self.model.config)

    def _phase_of(
        self, kind: str, trainer: Trainer, loader: Loader, before: int, steps: int, remedy: str, less: str
    ) -> Phase:
        run = self.config.run
        every = run.preview_every or steps
        return Phase(
            trainer,
            loader,
            self.head.step - before,
            steps,
            Pace(run.log_every, every, 0.0, run.checkpoint_minutes),
            remedy,
            less,
            self._less(),
            kind,
            f"{kind}: ",
            before,
        )

    def _less(self) -> str:
        """What to do when memory runs out where rays go through the networks `micro_rays` at a time."""
        fewer = max(self.config.run.micro_rays // 2, 1)
        return f"fit again with --micro-rays {fewer}, which changes nothing but the time"

    def _resume(self, phase: Phase) -> None:
        """Give the phase that a checkpoint was written in what Adam remembered."""
        if self._before is not None and phase.start > 0:
            phase.trainer.load_state(read_tensors(self._before.path, {"files": self._before.files}, STATE))

    def _corrections(self, before: Prior | None) -> Correction:
        """Corrections of the cameras: none at first, or those of the checkpoint."""
        known = {} if before is None or before.fit is None else before.fit["cameras"]
        scene, views = self.data.scene, self.data.dataset.tables["view_valid"].shape[1]
        cameras = CameraCorrections.of(known, self.config.views, scene.scene_scale)
        rows = torch.full((views,), -1)
        rows[torch.from_numpy(self._pairs[:, 1])] = torch.arange(len(self._pairs))
        box = Box(scene.box[0], scene.box[1])
        return Correction(cameras.to(self.device), rows.to(self.device), box, scene.scene_scale)

    # ------------------------------------------------------------------------- what the loop asks for

    def taken(self, done: int, outcome: Outcome) -> None:
        """Note how many steps of the phase are taken, and inversion's last loss."""
        assert self._phase is not None
        assert self.head.fit is not None
        fit = dict(self.head.fit)
        if self._phase.kind == "inversion":
            fit["inversion"] = {**fit["inversion"], "loss": outcome.loss}
        self.head = replace(self.head, step=self._phase.before + done, fit=fit)

    def save(self) -> None:
        """Write a checkpoint."""
        if self._correction is not None and self.head.fit is not None:
            cameras = self._correction.cameras.described(self.config.views, self._correction.scale)
            self.head = replace(self.head, fit={**self.head.fit, "cameras": cameras})
        tensors: dict[str, Mapping[str, Tensor]] = {
            WEIGHTS: self.model.state_dict(),
            STATE: {} if self._phase is None else self._phase.trainer.state(),
        }
        write_checkpoint(self.output, prior_payload(self.head), tensors)

    def look(self, log: RunLog | None, last: bool) -> None:
        """Show the views fitted to, and a new one of each."""
        assert log is not None
        previewer = Previewer(
            self.model, self.data, self._pairs, self._correction, min(self.config.run.micro_rays, 8192)
        )
        sheet, found = previewer.sheet()
        step = self.head.step
        values = dict(zip(self.config.views, found, strict=True))
        log.write(step, "preview", {"psnr": values})
        each = ", ".join(f"{name} {quality:.2f}" for name, quality in values.items())
        self.say(f"PSNR of the views fitted to, dB: {each}")
        self.say(str(show(_preview(self.output, step), log, step, "views", sheet)))
