"""The loop over steps that a prior's training, inversion and finetuning share.

    with Interruption() as interruption:
        done = take_steps(run, phase, progress, log, interruption)

What a step is stands in `trainer`. Here is what happens between steps: progress, log, checkpoints, pictures, signals,
and what is said when a step fails. What a checkpoint holds and what is looked at, the run knows.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import torch

from preface.model.training.interruption import Interruption
from preface.model.training.logs import RunLog
from preface.model.training.progress import Progress
from preface.model.training.ranks import Ranks
from preface.model.training.trainer import NonFiniteError, Outcome, Trainer
from preface.shards import Batch, Loader

Say = Callable[[str], None]


class TrainingError(RuntimeError):
    """A run that cannot go on; the message says why, what is kept, and what to do."""


@dataclass(frozen=True)
class Ended:
    """How a run ended: the path of model.json, and the exit status, 0 unless it was interrupted."""

    path: Path
    status: int


@dataclass(frozen=True)
class Pace:
    """How often the loop does what it does between steps.

    Attributes:
        log_every: steps between two lines of the log.
        look_every: steps between two looks.
        look_minutes: minutes after which there is a look too, if there was none; 0 for none.
        checkpoint_minutes: minutes between two checkpoints; 0 for those before and after looks only.
    """

    log_every: int
    look_every: int
    look_minutes: float
    checkpoint_minutes: float


@dataclass(frozen=True, eq=False)
class Phase:
    """Consecutive steps of one kind.

    Attributes:
        trainer, loader: take steps 0 to `steps` - 1.
        start: steps taken already.
        steps: of the phase.
        pace: see there.
        remedy: what to do when a loss is not finite.
        memory_remedy: what to do when memory runs out in a step.
        look_remedy: what to do when it runs out in a look.
        kind: of the log's entries.
        title: in front of lines about steps.
        before: steps of the run before the phase, which the log counts too.
    """

    trainer: Trainer
    loader: Loader
    start: int
    steps: int
    pace: Pace
    remedy: str
    memory_remedy: str
    look_remedy: str
    kind: str = "train"
    title: str = ""
    before: int = 0


class Run(Protocol):
    """What the loop asks of a run."""

    @property
    def output(self) -> Path:
        """The folder of the checkpoint."""
        ...

    @property
    def ranks(self) -> Ranks:
        """The processes."""
        ...

    @property
    def say(self) -> Say:
        """Tells a person what is going on."""
        ...

    def taken(self, done: int, outcome: Outcome) -> None:
        """Note how many steps of the phase are taken, and what the last one measured."""
        ...

    def save(self) -> None:
        """Write a checkpoint."""
        ...

    def look(self, log: RunLog | None, last: bool) -> None:
        """Measure and show what is learned so far."""
        ...


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


def take_steps(
    run: Run, phase: Phase, progress: Progress, log: RunLog | None, interruption: Interruption
) -> bool:
    """Take the steps of a phase that are left.

    Args:
        run: see there.
        phase: see there.
        progress: of the phase.
        log: in the process that writes, None in others.
        interruption: entered.

    Returns:
        Whether all are taken; otherwise a signal came, and a checkpoint was written after the step.

    Raises:
        TrainingError: a loss is not finite, or memory is short.
    """
    pace, steps = phase.pace, phase.steps
    saved, looked = _Clock(), _Clock()

    def save() -> None:
        run.save()
        saved.restart()

    def look(last: bool) -> None:
        """Look between two checkpoints: it may take long, and be interrupted."""
        save()
        where = f"{phase.title}what is learned so far could not be shown"
        kept = f"the checkpoint in {run.output} has all steps so far"
        with memory_explained(where, f"{kept}; {phase.look_remedy}"):
            run.look(log, last)
        save()
        looked.restart()

    if phase.start == 0:
        save()
    batches = cast(Generator[tuple[int, Batch], None, None], phase.loader.batches(phase.start, steps))
    with contextlib.closing(batches):  # ends the thread that forms them
        progress.start()
        for step, batch in batches:
            outcome = _step(run, phase, step, batch)
            progress.add(outcome)
            done, last = step + 1, step + 1 == steps
            run.taken(done, outcome)
            if log and (done % pace.log_every == 0 or last):
                values = progress.summary(outcome)
                log.write(phase.before + done, phase.kind, values)
                run.say(phase.title + progress.line(done, values))
            signal = run.ranks.any(interruption.signal)
            if signal and not last:
                save()
                interruption.signal = signal
                run.say(f"{phase.title}interrupted after step {done:,}; the same command goes on from there")
                return False
            if not last and (done % pace.look_every == 0 or looked.older_than(pace.look_minutes)):
                look(last=False)
            elif saved.older_than(pace.checkpoint_minutes):
                save()
            progress.start()
    look(last=True)
    return True


def _step(run: Run, phase: Phase, step: int, batch: Batch) -> Outcome:
    """One step; what goes wrong says what is kept and what to do."""
    rays = phase.trainer.options.micro_rays
    how = f" with {rays} rays at a time"
    try:
        with memory_explained(f"{phase.title}step {step}", phase.memory_remedy, how):
            return phase.trainer.step(step, batch)
    except (NonFiniteError, ValueError) as error:  # ValueError: the model met a number that is none
        words = str(error) if isinstance(error, NonFiniteError) else f"step {step}: {error}"
        kept = f"the checkpoint in {run.output} is that of an earlier step"
        raise TrainingError(f"{phase.title}{words}; {kept}; {phase.remedy}") from error


@contextlib.contextmanager
def memory_explained(where: str, remedy: str, how: str = "") -> Iterator[None]:
    """Say where and perhaps how memory ran out, if it does, and what to do.

    Raises:
        TrainingError: it did.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise TrainingError(f"{where}: memory ran out{how}; {remedy}") from error


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out, of the device or of the machine."""
    words = str(error)
    return isinstance(error, MemoryError | torch.OutOfMemoryError) or (
        "DefaultCPUAllocator" in words or "not enough memory" in words
    )
