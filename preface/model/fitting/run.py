"""A fit from views to a head's folder: find the views, invert, finetune, look, save, and end in order.

    ended = fit_head(FitConfig(Path("shards"), Path("head"), Path("prior"), "id0007", ("cam03", "cam09")), say=print)

Both phases go through `preface.model.training.loop`, one after the other, and into one checkpoint: its step counts
those of inversion, then those of finetuning.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from preface.artifacts import ArtifactError, provenance, sha256
from preface.geometry import Box
from preface.model.configuration import ModelConfig
from preface.model.fitting.cameras import CameraCorrections
from preface.model.fitting.configuration import FitConfig, check, finetuning_steps
from preface.model.fitting.finetuning import finetuning_trainer
from preface.model.fitting.heads import Correction, head_from_scratch, head_of_prior, with_predicted_normals
from preface.model.fitting.inversion import Refined, inversion_trainer
from preface.model.fitting.observations import fitted_views, grids, observe
from preface.model.fitting.previews import Previewer
from preface.model.fitting.reduction import FOLDER, reduce_views, reduced_size
from preface.model.fitting.starts import start_code
from preface.model.model import PriorModel
from preface.model.training.checkpoint import STATE, WEIGHTS, read_tensors, write_checkpoint
from preface.model.training.configuration import TrainingConfigError
from preface.model.training.data import TrainingData
from preface.model.training.folder import held_folder, require_same_run, show
from preface.model.training.interruption import Interruption
from preface.model.training.logs import RunLog
from preface.model.training.loop import Ended, Pace, Phase, Say, take_steps
from preface.model.training.prior_files import MODEL_FILE, Prior, prior_payload, read_prior
from preface.model.training.products import chosen_products
from preface.model.training.progress import Progress, train_flops_per_ray
from preface.model.training.ranks import Ranks, device_of_rank
from preface.model.training.trainer import Outcome, Trainer
from preface.shards import Dataset, Loader

PREVIEWS = "previews"
_COMPARED = 16  # pixels per side of a view that neighbours are sought by


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
    prior = _read_prior(Path(config.prior), say) if config.from_prior else None
    if config.like is not None:
        config = replace(config, model=read_prior(config.like).model)
    with Dataset(config.shards) as dataset:
        data = observe(dataset, config.identity, config.views, prior)
        config = replace(config, identity=data.names[0])
        with held_folder(config.output, Ranks()):
            before = _resumed(config, data, prior)
            if before is not None and before.finished and _preview(config.output, before.step).exists():
                say(f"{config.output}: all {before.steps:,} steps are taken already")
                return Ended(before.path, 0)
            return _Fit(config, data, prior, before, device, say).go()


def _read_prior(path: Path, say: Say) -> Prior:
    prior = read_prior(path)
    if prior.is_head:
        problem = "is that of a head, which knows one identity"
        raise ArtifactError(prior.path, "fit", problem, "Give the folder of a prior, or --prior none")
    if not prior.finished:
        say(
            f"{prior.path}: trained for {prior.step:,} of {prior.steps:,} steps only; the fit can be as good as that"
        )
    return prior


def _resumed(config: FitConfig, data: TrainingData, prior: Prior | None) -> Prior | None:
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
    inputs = provenance({}, _inputs(data, prior))["inputs"]
    ours = {**config.to_dict(), "inputs": inputs}
    require_same_run(before.path, ours, {**before.configuration, "inputs": dict(before.provenance["inputs"])})
    return before


def _inputs(data: TrainingData, prior: Prior | None) -> dict[str, Path]:
    return {"manifest.json": data.dataset.manifest.path, **({} if prior is None else {"prior": prior.path})}


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
        device: torch.device,
        say: Say,
    ):
        self.config, self.data, self.device, self.say = config, data, device, say
        self.output, self.ranks = config.output, Ranks()
        self._open = contextlib.ExitStack()
        self._prior, self._before = prior, before
        self._inversion_steps = config.inversion_steps()
        self._finetuning_steps = finetuning_steps(config.finetuning, *data.scene.resolution)
        self._pairs = fitted_views(data, config.views)
        self._phase: Phase | None = None
        self._correction = self._corrections(before) if config.refine_cameras else None
        self.model, self.head = self._new() if before is None else (before.load_model().to(device), before)

    # -------------------------------------------------------------------------------------- the phases

    def go(self) -> Ended:
        """Invert and finetune until all steps are taken or a signal comes."""
        run = self.config.run
        with self._open:
            interruption = self._open.enter_context(Interruption())
            self.say(self._plan())
            log = self._open.enter_context(RunLog(self.output, self.head.step))
            products = chosen_products(self.head.model, self.head.products, run.products, self.device)
            route = self._open.enter_context(products)
            self.head = replace(self.head, products=route.name)
            for prepare in (self._inversion, self._finetuning):
                phase = prepare()
                if phase is None:
                    continue
                self._phase = phase
                self._resume(phase)
                progress = Progress(phase.steps, train_flops_per_ray(self.model), 1e9 * route.gflops)
                if not take_steps(self, phase, progress, log, interruption):
                    return Ended(self.head.path, interruption.exit_status)
            if self._phase is None:  # no steps at all
                self.save()
                self.look(log, last=True)
        return Ended(self.head.path, 0)

    def _plan(self) -> str:
        if self._before is not None:
            return f"goes on from step {self.head.step:,} of {self.output}"
        width, height = self.data.scene.resolution
        return (
            f"{self.data.names[0]}: {len(self._pairs)} views of {width}x{height}; {self._inversion_steps:,} steps of "
            f"inversion, {self._finetuning_steps:,} of finetuning"
        )

    def _new(self) -> tuple[PriorModel, Prior]:
        """A head to begin with: the prior's, where its code starts, or random weights."""
        config = self.config
        if self._prior is None:
            model = head_from_scratch(config.model.resolved(self.data.smallest_radius), config.seed)
            return model.to(self.device), self._described(model.config)
        networks = self._prior.load_model().to(self.device)
        views = grids(self.data, _COMPARED, self.device)
        head = head_of_prior(networks, start_code(networks, config.inversion.start, views, config.seed))
        return head, self._described(head.config)

    def _described(self, model: ModelConfig) -> Prior:
        """What model.json says of the head before its first step."""
        config, data = self.config, self.data
        configuration = config.to_dict()
        width, height = data.scene.resolution
        fit = {
            "identity": data.names[0],
            "views": list(config.views),
            "shards": {"manifest": sha256(data.dataset.manifest.path), "path": str(config.shards)},
            "resolution": {"width": width, "height": height},
            "prior": None if self._prior is None else sha256(self._prior.path),
            "inversion": {"steps": self._inversion_steps, "loss": None},
            "finetuning": {"steps": self._finetuning_steps},
            "cameras": {},
            "quality": config.quality,
        }
        return Prior(
            path=self.output / MODEL_FILE,
            model=model,
            identities=data.names,
            scene=data.scene,
            configuration=configuration,
            step=0,
            steps=self._inversion_steps + self._finetuning_steps,
            held_out=data.held_out_names,
            validation={},
            products="",
            provenance=provenance(configuration, _inputs(data, self._prior), config.seed),
            files={},
            fit=fit,
        )

    def _inversion(self) -> Phase | None:
        """The steps of inversion that are left; None if there are none."""
        steps = self._inversion_steps
        if self.head.step >= steps:
            return None
        assert self._prior is not None
        size = reduced_size(self.data.scene.resolution, self._prior.scene.resolution)
        data = self.data
        if size != data.scene.resolution:
            manifest = reduce_views(data, size, self.output / FOLDER)
            data = observe(
                self._open.enter_context(Dataset(manifest)), data.names[0], self.config.views, self._prior
            )
        config, run, finetuning = self.config.inversion, self.config.run, self.config.finetuning
        refined = None
        if self._correction is not None:
            correction = self._correction
            if data is not self.data:  # whose views are those fitted to, in the same order
                rows = correction.rows[torch.from_numpy(self.data.train.pairs[:, 1]).to(self.device)]
                correction = replace(correction, rows=rows)
            refined = Refined(correction, finetuning.camera_rate, finetuning.camera_weight)
        trainer, loader = inversion_trainer(
            self.model, config, data, self.config.seed, run.micro_rays, self.device, refined
        )
        less = f"--inversion.patches {max(config.patches // 2, 1)} or a smaller --inversion.patch"
        remedy = "fit into another --output with a lower --inversion.rate"
        return self._phase_of("inversion", trainer, loader, 0, steps, remedy, f"fit again with {less}")

    def _finetuning(self) -> Phase | None:
        """The steps of finetuning that are left; None if there are none."""
        steps, config, run = self._finetuning_steps, self.config.finetuning, self.config.run
        if steps == 0:
            return None
        if config.normals > 0:
            self.model = with_predicted_normals(self.model, self.config.seed)
            self.head = replace(self.head, model=self.model.config)
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
        less = f"--micro-rays {max(run.micro_rays // 2, 1)}, which changes nothing but the time"
        remedy = "fit into another --output with a lower --finetuning.rate"
        return self._phase_of(
            "finetuning", trainer, loader, self._inversion_steps, steps, remedy, f"fit again with {less}"
        )

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
            kind,
            f"{kind}: ",
            before,
        )

    def _resume(self, phase: Phase) -> None:
        """Give the phase that a checkpoint was written in what Adam remembered."""
        if self._before is not None and phase.start > 0:
            phase.trainer.load_state(read_tensors(self._before.path, {"files": self._before.files}, STATE))

    def _corrections(self, before: Prior | None) -> Correction:
        """Corrections of the cameras: none at first, or those of the checkpoint."""
        scene, person = self.data.scene, int(self._pairs[0, 0])
        cameras = CameraCorrections(len(self._pairs))
        known: Mapping[str, Any] = {} if before is None else cast(Mapping[str, Any], before.fit)["cameras"]
        with torch.no_grad():
            for row, name in enumerate(self.config.views):
                if name in known:
                    cameras.rotation[row] = torch.tensor(known[name]["rotation"], dtype=torch.float64)
                    moved = torch.tensor(known[name]["translation_m"], dtype=torch.float64)
                    cameras.translation[row] = moved * scene.scene_scale
        rows = torch.full((self.data.dataset.tables["view_valid"].shape[1],), -1)
        rows[torch.from_numpy(self._pairs[:, 1])] = torch.arange(len(self._pairs))
        assert (self._pairs[:, 0] == person).all()
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
