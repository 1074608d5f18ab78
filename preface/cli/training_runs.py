"""What `preface-train` and `preface-fit` share: running to the end, and the exit status of whatever comes between."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from preface.cli.output import complaining, print_lines, resumable
from preface.cli.typed_flags import refusing
from preface.cli.usage import UsageError

if TYPE_CHECKING:
    from preface.model.training.loop import Ended

# What every run leaves in its folder, before its first checkpoint and after; `preface.model.training` has their names.
OF_A_RUN = ("model.json", ".run.lock")


def training_status(work: Callable[[], int], prog: str, subject: object) -> int:
    """The exit status of a command that trains, told as every command tells it.

    Args:
        work: see `run_to_end`.
        prog: the command's name.
        subject: the folder that it was given.
    """
    return resumable(lambda: complaining(work, refusing(prog), subject, _reasons))


def run_to_end(run: Callable[[], Ended]) -> int:
    """Train or fit, and print the path of model.json if it is there.

    Args:
        run: the work; an interruption after which it can be resumed ends it, too.

    Returns:
        The exit status of how it ended.

    Raises:
        UsageError: a configuration that cannot be.
        ArtifactError, TrainingError: see `preface.model`.
    """
    from preface.model.configuration import ConfigurationError
    from preface.model.matmul import denormals_flushed, keep_freed_memory
    from preface.model.training.configuration import TrainingConfigError

    keep_freed_memory()
    try:
        with denormals_flushed():
            ended = run()
    except (TrainingConfigError, ConfigurationError) as error:
        raise UsageError(str(error)) from error
    return print_lines([str(ended.path)] if ended.path.exists() else []) or ended.status


def _reasons() -> tuple[type[Exception], ...]:
    """Errors that tell a user what to do; anything else is a defect of this program."""
    from preface.model.training.loop import TrainingError

    return (TrainingError,)
