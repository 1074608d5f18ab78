"""``preface-train``: from shards to a prior.

The flags are the fields of `preface.model.training.configuration.TrainConfig`, with the defaults of the preset that
``--preset`` names. PyTorch is imported when training begins, so that ``--help`` does not wait for it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import tyro

from preface.artifacts import ArtifactError
from preface.cli.output import print_lines, say
from preface.cli.typed_flags import parse_flags
from preface.model.configuration import ConfigurationError
from preface.model.training.configuration import (
    TRAINING_PRESETS,
    TrainConfig,
    TrainingConfigError,
    defaults,
)

DEFAULT_PRESET = "small"
INTERRUPTED = 130  # 128 + SIGINT, as shells report it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    config = parse(sys.argv[1:] if arguments is None else arguments)

    from preface.model.matmul import denormals_flushed, keep_freed_memory
    from preface.model.training.prior import TrainingError, train_prior

    keep_freed_memory()
    try:
        with denormals_flushed():
            ended = train_prior(config, say)
    except (TrainingConfigError, ConfigurationError) as error:
        return _complain(str(error), 2)
    except (TrainingError, ArtifactError) as error:
        return _complain(str(error), 1)
    except KeyboardInterrupt:  # before the first step, or a second time
        return _complain("interrupted; the same command goes on from the last checkpoint", INTERRUPTED)
    return print_lines([str(ended.path)] if ended.path.exists() else []) or ended.status


def parse(arguments: Sequence[str]) -> TrainConfig:
    """The configuration that arguments ask for; ends the process for help and for wrong usage."""
    first = argparse.ArgumentParser("preface-train", add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default=DEFAULT_PRESET)
    name = first.parse_known_args(arguments)[0].preset
    # An unknown name is refused below, with the names that there are.
    training, run, model = defaults(name if name in TRAINING_PRESETS else DEFAULT_PRESET)
    default = TrainConfig(shards=tyro.MISSING, training=training, run=run, model=model)
    return parse_flags(TrainConfig, "preface-train", arguments, default)


def _complain(message: str, status: int) -> int:
    print(f"preface-train: {message}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
