"""A prior's run from shards to a folder: resume or begin, train, look, save, and end in order.

    ended = train_prior(TrainConfig(Path("shards"), Path("prior"), ...), say=print)

The loop over steps is `_Run.go`; what a step is stands in `trainer`, what is asked of it in `prior_loss`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from preface.artifacts import ArtifactError, provenance, write_bytes
from preface.model.matmul import FP32_ERROR, Route, choose_route
from preface.model.model import PriorModel
from preface.model.training.checkpoint import STATE, WEIGHTS, read_tensors, write_checkpoint
from preface.model.training.configuration import TrainConfig, TrainingConfigError, check
from preface.model.training.data import TrainingData, open_data, spread
from preface.model.training.interruption import Interruption
from preface.model.training.lock import only_run
from preface.model.training.logs import RunLog
from preface.model.training.prior_files import MODEL_FILE, Prior, prior_payload, read_prior
from preface.model.training.prior_loss import prior_terms, renderer
from preface.model.training.progress import Progress, duration, train_flops_per_ray
from preface.model.training.ranks import Ranks, device_of_rank, joined_ranks
from preface.model.training.schedule import LogLinear
from preface.model.training.trainer import NonFiniteError, Options, Outcome, ParameterSet, Trainer
from preface.model.training.validation import Validation, Viewer, as_png, interpolation_sheet, view_sheet
from preface.shards import Batch, Dataset, Loader, PaperPattern

_SHARE_OF_RUN = 10  # validations of a run, unless their interval is given
Say = Callable[[str], None]


class TrainingError(RuntimeError):
    """A run that cannot go on; the message says why, what is kept, and what to do."""


@dataclass(frozen=True)
class Ended:
    """How a run ended: the path of model.json, and the exit status, 0 unless it was interrupted."""

    path: Path
    status: int


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
        data = open_data(dataset, config.training, config.model)
        speak = say if ranks.is_first else _silent
        if config.run.dry_run:
            speak(describe(config, data))
            return Ended(config.output / MODEL_FILE, 0)
        with _output(config.output, ranks):
            before = _resumed(config, data)
            if before is not None and before.finished and _was_looked_at(before):
                speak(f"{config.output}: all {before.steps:,} steps are taken already")
                return Ended(before.path, 0)
            return _Run(config, data, device, ranks, before, speak).go()


def _was_looked_at(prior: Prior) -> bool:
    """Whether a finished run's last figures are there, or cannot be."""
    return not prior.held_out or prior.validation.get("step") == prior.steps


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


@contextlib.contextmanager
def _output(folder: Path, ranks: Ranks) -> Iterator[None]:
    """Make the folder, and hold it in the process that writes."""
    if not ranks.is_first:
        yield
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArtifactError.from_os(folder, "writing", error) from error
    with only_run(folder):
        yield


def _resumed(config: TrainConfig, data: TrainingData) -> Prior | None:
    """The checkpoint to go on from, None to begin.

    Raises:
        ArtifactError: it is of another configuration or other shards; the message names the fields.
    """
    if not (config.output / MODEL_FILE).exists():
        return None
    prior = read_prior(config.output)
    manifest = provenance({}, {"manifest.json": data.dataset.manifest.path})["inputs"]
    ours = {**_flat(config.to_dict()), "shards": manifest["manifest.json"]}
    theirs = {**_flat(prior.configuration), "shards": prior.provenance["inputs"].get("manifest.json")}
    wrong = [
        f"{name} is {theirs.get(name)} there and {ours.get(name)} now"
        for name in sorted(ours.keys() | theirs.keys())
        if ours.get(name) != theirs.get(name) and name != "preset"
    ]
    if wrong:
        remedy = "Give the same flags to go on, or another --output to begin anew"
        raise ArtifactError(prior.path, "configuration", "; ".join(wrong), remedy)
    return prior


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat.update(
            _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
        )
    return flat


class _Clock:
    """Time since something was done last."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """It is done now."""
        self._at = time.monotonic()

    def older_than(self, minutes: float) -> bool:
        """Whether it was done more than so many minutes ago; never for 0."""
        return 0 < 60 * minutes < time.monotonic() - self._at


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
        training = config.training
        scale, views = data.scene.scene_scale, data.dataset.manifest.views
        pattern = PaperPattern(data.train, training.seed, training.identities, training.views, training.rays)
        self.model = (before.load_model() if before else self._new_model()).to(device)
        planes = torch.from_numpy(data.dataset.tables["near_far"].reshape(-1, 2) * scale).float().to(device)
        rows = torch.from_numpy(data.row).to(device)
        self.trainer = Trainer(
            parameter_sets(self.model, config),
            prior_terms(self.model.config.background, training.interlevel),
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
        self.saved, self.looked = _Clock(), _Clock()
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

    # ------------------------------------------------------------------------------------------ the loop

    def go(self) -> Ended:
        """Train until all steps are taken or a signal comes."""
        steps, start, run = self.config.training.steps, self.prior.step, self.config.run
        every = run.validate_every or max(steps // _SHARE_OF_RUN, 1)
        self.say(describe(self.config, self.data))
        with contextlib.ExitStack() as stack:
            interruption = stack.enter_context(Interruption())
            log = stack.enter_context(RunLog(self.config.output, start)) if self.ranks.is_first else None
            route = stack.enter_context(_products(self.prior, run.products, self.device))
            self.prior = replace(self.prior, products=route.name)
            progress = Progress(steps, train_flops_per_ray(self.model), 1e9 * route.gflops)
            if start == 0:
                self._save()
            batches = cast(Generator[tuple[int, Batch], None, None], self.loader.batches(start, steps))
            stack.callback(batches.close)  # ends the thread that forms them
            progress.start()
            for step, batch in batches:
                outcome = self._step(step, batch)
                progress.add(outcome)
                done, last = step + 1, step + 1 == steps
                self.prior = replace(self.prior, step=done)
                if log and (done % run.log_every == 0 or last):
                    values = progress.summary(outcome)
                    log.write(done, "train", values)
                    self.say(progress.line(done, values))
                signal = self.ranks.any(interruption.signal)
                if signal and not last:
                    self._save()
                    interruption.signal = signal
                    self.say(f"interrupted after step {done:,}; the same command goes on from there")
                    return Ended(self.prior.path, interruption.exit_status)
                if not last and (done % every == 0 or self.looked.older_than(run.validate_minutes)):
                    self._look(log, last=False)
                elif self.saved.older_than(run.checkpoint_minutes):
                    self._save()
                progress.start()
            self._look(log, last=True)
        return Ended(self.prior.path, 0)

    def _look(self, log: RunLog | None, last: bool) -> None:
        """Validate between two checkpoints: looking may take long, and be interrupted."""
        self._save()
        self._validate(log, self.prior.step, last)
        self._save()
        self.looked.restart()

    def _step(self, step: int, batch: Batch) -> Outcome:
        """One step; what goes wrong says what is kept and what to do."""
        try:
            return self.trainer.step(step, batch)
        except (NonFiniteError, ValueError) as error:  # ValueError: the model met a number that is none
            words = str(error) if isinstance(error, NonFiniteError) else f"step {step}: {error}"
            kept = f"the checkpoint in {self.config.output} is that of an earlier step"
            remedy = "train into another --output with a lower --rate, a --warmup or a smaller --clip"
            raise TrainingError(f"{words}; {kept}; {remedy}") from error
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            rays = self.config.run.micro_rays
            raise TrainingError(
                f"step {step}: memory ran out with {rays} rays at a time; run again with --micro-rays "
                f"{max(rays // 2, 1)}, which changes nothing but the time, or with a smaller model"
            ) from error

    def _save(self) -> None:
        if self.ranks.is_first:
            tensors: dict[str, Mapping[str, Tensor]] = {
                WEIGHTS: self.model.state_dict(),
                STATE: self.trainer.state(),
            }
            write_checkpoint(self.config.output, prior_payload(self.prior), tensors)
            self.saved.restart()

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

    def _show(self, log: RunLog, step: int, name: str, picture: Any) -> None:
        folder = self.config.output / "validation"
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise ArtifactError.from_os(folder, "writing", error) from error
        png = as_png(picture)
        path = folder / (f"{name}.png" if name == "interpolation" else f"{name}-{step:08d}.png")
        write_bytes(path, png)
        log.picture(step, name, png, (picture.shape[1], picture.shape[0]))
        self.say(str(path))


@contextlib.contextmanager
def _products(prior: Prior, wanted: str, device: torch.device) -> Iterator[Route]:
    """Multiply by the route wanted, by that of the steps before, or by the fastest exact one."""
    fastest = choose_route(prior.model.matmul, device, prior.model.nerf.width)
    named = device.type == "cpu" and prior.model.matmul == "fp32"
    name = (prior.products if wanted == "auto" else wanted) if named else ""
    route = replace(fastest, name=name or fastest.name)
    route.apply()
    try:
        if (
            wanted == "auto" and route.name != fastest.name and not _is_exact()
        ):  # it has moved to another machine
            route = fastest
            route.apply()
        yield route
    finally:
        Route("mkl", 0.0, 0.0).apply()  # PyTorch's own


def _is_exact() -> bool:
    """Whether float32 products on the CPU are, at present."""
    numbers = torch.linspace(-1, 1, 256 * 256).view(256, 256)
    exact = numbers.double() @ numbers.double()
    return float(((numbers @ numbers).double() - exact).abs().max() / exact.abs().max()) <= FP32_ERROR


def parameter_sets(model: PriorModel, config: TrainConfig) -> list[ParameterSet]:
    """Each network, and the codes, clipped by itself, all at the rate of the configuration."""
    training = config.training
    rate = LogLinear(training.rate, training.rate_last, training.steps, training.warmup)
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    return [
        ParameterSet(name, {names[id(p)]: p for p in parameters}, rate, training.clip or None)
        for name, parameters in model.parameter_groups().items()
    ]


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out, of the device or of the machine."""
    words = str(error)
    return isinstance(error, MemoryError | torch.OutOfMemoryError) or (
        "DefaultCPUAllocator" in words or "not enough memory" in words
    )
