"""``preface-train``: from shards to a prior.

The flags are the fields of `preface.model.training.configuration.TrainConfig`, with the defaults of the preset that
``--preset`` names. PyTorch is imported when training begins, so that ``--help`` does not wait for it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import tyro

from preface.cli.output import say
from preface.cli.training_runs import OF_A_RUN, run_to_end, training_status
from preface.cli.typed_flags import parse_flags
from preface.model.training.configuration import TRAINING_PRESETS, TrainConfig, defaults

DEFAULT_PRESET = "small"
PROGRAM = "preface-train"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    config = parse(sys.argv[1:] if arguments is None else arguments)
    return training_status(lambda: _train(config), PROGRAM, config.shards)


def _train(config: TrainConfig) -> int:
    from preface.cli.folders import require_own
    from preface.model.training.prior import train_prior

    require_own(config.output, "a prior", OF_A_RUN)

    return run_to_end(lambda: train_prior(config, say))


def parse(arguments: Sequence[str]) -> TrainConfig:
    """The configuration that arguments ask for; ends the process for help and for wrong usage."""
    first = argparse.ArgumentParser(PROGRAM, add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default=DEFAULT_PRESET)
    name = first.parse_known_args(arguments)[0].preset
    # An unknown name is refused below, with the names that there are.
    training, run, model = defaults(name if name in TRAINING_PRESETS else DEFAULT_PRESET)
    default = TrainConfig(shards=tyro.MISSING, training=training, run=run, model=model)
    return parse_flags(TrainConfig, PROGRAM, arguments, default)


if __name__ == "__main__":
    sys.exit(main())
