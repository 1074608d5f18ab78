"""A prior's run from shards to a folder: resume or begin, train, look, save, and end in order.

    ended = train_prior(TrainConfig(Path("shards"), Path("prior"), ...), say=print)

The loop over steps is `loop.take_steps`; what a step is stands in `trainer`, what is asked of it in `prior_loss`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from preface.artifacts import provenance
from preface.model.model import PriorModel
from preface.model.training.checkpoint import STATE, WEIGHTS, read_tensors, write_checkpoint
from preface.model.training.configuration import TrainConfig, TrainingConfigError, check
from preface.model.training.data import TrainingData, open_data, spread
from preface.model.training.folder import carry_template, held_folder, require_same_run, show
from preface.model.training.interruption import Interruption
from preface.model.training.logs import RunLog
from preface.model.training.loop import Ended, Pace, Phase, Say, take_steps
from preface.model.training.loop import TrainingError as TrainingError  # what `train_prior` raises
from preface.model.training.prior_files import MODEL_FILE, Prior, prior_payload, read_prior
from preface.model.training.prior_loss import prior_terms, renderer
from preface.model.training.products import chosen_products
from preface.model.training.progress import Progress, train_flops_per_ray
from preface.model.training.ranks import Ranks, device_of_rank, joined_ranks
from preface.model.training.schedule import LogLinear
from preface.model.training.trainer import Options, Outcome, ParameterSet, Trainer
from preface.model.training.validation import Validation, Viewer, interpolation_sheet, view_sheet
from preface.plain_words import duration
from preface.reports.pictures import Picture
from preface.shards import Dataset, Loader, PaperPattern

_SHARE_OF_RUN = 10  # validations of a run, unless their interval is given


def train_prior(config: TrainConfig, say: Say) -> Ended:
    """Train a prior, or go on training it.

    Args:
        config: of the command.
        say: tells a person what is going on.

    Raises:
        TrainingConfigError: a flag that cannot work.
        ArtifactError: shards or the output are not as they must be.
        TrainingError: a loss is not finite, or memory is short.
    """
    check(config)
    try:
        device = device_of_rank(config.run.device)
    except ValueError as error:
        raise TrainingConfigError(str(error)) from error
    with Dataset(config.shards) as dataset, joined_ranks(device) as ranks:
        require_shares(config, ranks)
        data = open_data(dataset, config.training, config.model)
        speak = say if ranks.is_first else _silent
        if config.run.dry_run:
            speak(describe(config, data))
            return Ended(config.output / MODEL_FILE, 0)
        with held_folder(config.output, ranks):
            before = _resumed(config, data)
            if ranks.is_first:
                carry_template(dataset.manifest.path.parent, config.output)
            if before is not None and before.finished and _was_looked_at(before):
                speak(f"{config.output}: all {before.steps:,} steps are taken already")
                return Ended(before.path, 0)
            return _Run(config, data, device, ranks, before, speak).go()


def _was_looked_at(prior: Prior) -> bool:
    """Whether a finished run's last figures are there, or cannot be."""
    return not prior.held_out or prior.validation.get("step") == prior.steps


def require_shares(config: TrainConfig, ranks: Ranks) -> None:
    """Refuse more processes than a step has views to share out.

    Raises:
        TrainingConfigError: saying what to change.
    """
    training = config.training
    views = training.identities * training.views
    if views < ranks.world:
        raise TrainingConfigError(
            f"--identities {training.identities} --views {training.views}: the {views} views of a step cannot be "
            f"shared out among {ranks.world} processes; give more of either, or start {views} processes at most"
        )


def _silent(words: str) -> None:
    """Processes other than the first say nothing."""


def describe(config: TrainConfig, data: TrainingData) -> str:
    """What a run would train on."""
    training, model = config.training, config.model.resolved(data.smallest_radius)
    parameters = sum(p.numel() for p in PriorModel(model, len(data.names)).parameters())
    rays = training.identities * training.views * training.rays
    width, height = data.scene.resolution
    lines = [
        f"{len(data.names)} identities of split '{training.split}', {len(data.train.pairs)} views of {width}x{height} "
        f"to train on, {len(data.held_out.pairs)} held out",
        f"{parameters:,} parameters, {model.levels} levels of encoding, {' + '.join(map(str, model.samples))} samples",
        f"{training.steps:,} steps of {training.identities} identities x {training.views} views x {training.rays} "
        f"rays = {rays:,} rays",
    ]
    return "\n".join(lines)


def _resumed(config: TrainConfig, data: TrainingData) -> Prior | None:
    """The checkpoint to go on from, None to begin.

    Raises:
        ArtifactError: it is of another configuration or other shards; the message names the fields.
    """
    if not (config.output / MODEL_FILE).exists():
        return None
    prior = read_prior(config.output)
    manifest = provenance({}, {"manifest.json": data.dataset.manifest.path})["inputs"]
    ours = {**config.to_dict(), "shards": manifest["manifest.json"]}
    theirs = {**prior.configuration, "shards": prior.provenance["inputs"].get("manifest.json")}
    require_same_run(prior.path, ours, theirs)
    return prior


class _Run:
    """A run under way."""

    def __init__(
        self,
        config: TrainConfig,
        data: TrainingData,
        device: torch.device,
        ranks: Ranks,
        before: Prior | None,
        say: Say,
    ):
        self.config, self.data, self.ranks, self.say, self.device = config, data, ranks, say, device
        self.output = config.output
        training = config.training
        scale, views = data.scene.scene_scale, data.dataset.manifest.views
        pattern = PaperPattern(data.train, training.seed, training.identities, training.views, training.rays)
        self.model = (before.load_model() if before else self._new_model()).to(device)
        planes = torch.from_numpy(data.dataset.tables["near_far"].reshape(-1, 2) * scale).float().to(device)
        rows = torch.from_numpy(data.row).to(device)
        self.trainer = Trainer(
            parameter_sets(self.model, config),
            prior_terms(self.model.config.background, training),
            renderer(self.model, rows, planes, views, training.seed, training.steps),
            Options(eps=training.eps, micro_rays=config.run.micro_rays),
            pattern.groups,
            ranks,
        )
        self.loader = Loader(
            data.dataset,
            pattern,
            device=device,
            placement=config.run.placement,
            scale=scale,
            rank=ranks.rank,
            world=ranks.world,
        )
        self.viewer = Viewer(self.model, data, planes, config.run.micro_rays)
        self.prior = before or self._new_description()
        if before:
            self.trainer.load_state(read_tensors(before.path, {"files": before.files}, STATE))
            say(f"goes on from step {before.step:,} of {config.output}")

    def _new_model(self) -> PriorModel:
        """Random weights as a function of the seed, the same for every device."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.training.seed)
            return PriorModel(self.config.model.resolved(self.data.smallest_radius), len(self.data.names))

    def _new_description(self) -> Prior:
        files = {"manifest.json": self.data.dataset.manifest.path}
        configuration = self.config.to_dict()
        return Prior(
            path=self.config.output / MODEL_FILE,
            model=self.model.config,
            identities=self.data.names,
            scene=self.data.scene,
            configuration=configuration,
            step=0,
            steps=self.config.training.steps,
            held_out=self.data.held_out_names,
            validation={},
            products="",
            provenance=provenance(configuration, files, self.config.training.seed),
            files={},
        )

    def go(self) -> Ended:
        """Train until all steps are taken or a signal comes."""
        run = self.config.run
        self.say(describe(self.config, self.data))
        with contextlib.ExitStack() as stack:
            interruption = stack.enter_context(Interruption())
            start = self.prior.step
            log = stack.enter_context(RunLog(self.output, start)) if self.ranks.is_first else None
            products = chosen_products(self.prior.model, self.prior.products, run.products, self.device)
            route = stack.enter_context(products)
            self.prior = replace(self.prior, products=route.name)
            steps = self.config.training.steps
            progress = Progress(steps, train_flops_per_ray(self.model), 1e9 * route.gflops)
            done = take_steps(self, self._phase(), progress, log, interruption)
            return Ended(self.prior.path, 0 if done else interruption.exit_status)

    def _phase(self) -> Phase:
        run, steps = self.config.run, self.config.training.steps
        less = (
            f"run again with --micro-rays {max(run.micro_rays // 2, 1)}, which changes nothing but the time"
        )
        every = run.validate_every or max(steps // _SHARE_OF_RUN, 1)
        return Phase(
            self.trainer,
            self.loader,
            self.prior.step,
            steps,
            Pace(run.log_every, every, run.validate_minutes, run.checkpoint_minutes),
            "train into another --output with a lower --rate, a --warmup or a smaller --clip",
            f"{less}, or train a smaller model into another --output",
            less,
        )

    def taken(self, done: int, outcome: Outcome) -> None:
        """Note how many steps are taken."""
        self.prior = replace(self.prior, step=done)

    def save(self) -> None:
        """Write a checkpoint."""
        if self.ranks.is_first:
            tensors: dict[str, Mapping[str, Tensor]] = {
                WEIGHTS: self.model.state_dict(),
                STATE: self.trainer.state(),
            }
            write_checkpoint(self.output, prior_payload(self.prior), tensors)

    def look(self, log: RunLog | None, last: bool) -> None:
        """Validate."""
        self._validate(log, self.prior.step, last)

    def _validate(self, log: RunLog | None, step: int, last: bool) -> None:
        """Measure and show held-out views; at the end also the faces between the identities."""
        if log is None:
            return
        run = self.config.run
        if len(self.data.held_out.pairs):
            started = time.perf_counter()
            found = Validation.of(
                self.viewer, spread(self.data.held_out, run.final_views if last else run.validate_views)
            )
            self.prior = replace(self.prior, validation={"step": step, **found.figures})
            log.write(step, "validation", found.figures)
            self.say(
                f"step {step:>7,}: {found.figures['views']:.0f} held-out views, PSNR "
                f"{found.figures.get('psnr', float('nan')):.2f} dB in the box, "
                f"{found.figures.get('psnr_foreground', float('nan')):.2f} dB on the foreground "
                f"({duration(time.perf_counter() - started)})"
            )
            self._show(log, step, "views", view_sheet(found.shown, self.data.scene.near_far))
        people = self.data.train.identities.tolist()
        count = min(run.faces_between, len(people) // 2)
        if last and count:
            pairs = [(people[i], people[len(people) - 1 - i]) for i in range(count)]
            names = [(self.data.dataset.names[one], self.data.dataset.names[other]) for one, other in pairs]
            sheet = interpolation_sheet(self.viewer.interpolate(pairs), names)
            self._show(log, step, "interpolation", sheet)

    def _show(self, log: RunLog, step: int, name: str, picture: Picture) -> None:
        file = f"{name}.png" if name == "interpolation" else f"{name}-{step:08d}.png"
        self.say(str(show(self.output / "validation" / file, log, step, name, picture)))


def parameter_sets(model: PriorModel, config: TrainConfig) -> list[ParameterSet]:
    """Each network, and the codes, clipped by itself, all at the rate of the configuration."""
    training = config.training
    rate = LogLinear(training.rate, training.rate_last, training.steps, training.warmup)
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    return [
        ParameterSet(name, {names[id(p)]: p for p in parameters}, rate, training.clip or None)
        for name, parameters in model.parameter_groups().items()
    ]
