"""``preface-fit``: from a prior and one to seven views, or photographs, to a head.

The flags are the fields of `preface.model.fitting.configuration.FitConfig`, with the defaults of the quality that
``--quality`` names, and `PhotographsConfig`, for photographs of which nothing else is known. PyTorch is imported when
the fit begins, so that ``--help`` does not wait for it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

import tyro

from preface.cli.output import say
from preface.cli.training_runs import OF_A_RUN, run_to_end, training_status
from preface.cli.typed_flags import parse_flags
from preface.cli.usage import UsageError
from preface.model.fitting.configuration import QUALITIES, FitConfig, defaults

DEFAULT_QUALITY = "balanced"
PROGRAM = "preface-fit"
# What the stages before a fit leave in a head's folder when they are interrupted; `fit_photos` has their names.
OF_PHOTOGRAPHS = ("photos/template.json", "photos/alignment", "photos/shards")


@dataclass(frozen=True)
class PhotographsConfig:
    """Only where SHARDS is a folder of photographs."""

    template: Path | None = None
    """The template that the prior's heads were placed on (template.json, or the folder of an alignment). By default
    template.json in the prior's folder; if there is none, that of the face that is expected of everybody."""
    cameras: Path | None = None
    """The cameras, where they are known: a rig.json with one camera per photograph, by the file's name."""
    landmarks: Path | None = None
    """Landmarks, where another program has found them: a folder as data_specs/landmarks.md describes it."""
    masks: Path | None = None
    """Masks by the photographs' names, where there are some; otherwise they are found."""
    resolution: str = "auto"
    """WIDTHxHEIGHT of the views to fit to. By default the prior's, cut out around the head; for --quality paper
    the largest multiple of it that the photographs have."""


@dataclass(frozen=True)
class FitCommand(FitConfig):
    """Fit a prior to one to seven views of a head; the same command resumes a fit.

    Given a folder of one to seven photographs of one still person, it finds the cameras, places the face, cuts out
    the head, fits, and says how far the result can be trusted.

    Writes model.safetensors, model.json and training_state.safetensors, which every command takes that takes a
    prior; log.jsonl, events for TensorBoard and, in previews/, pictures of the views and of a new one. Exit status: 0
    when the head is fitted, 1 when something is wrong, 2 for wrong usage, 130 or 143 when interrupted (after a
    checkpoint).
    """

    shards: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SHARDS")]
    """Folder of the shards that hold the views, or of one to seven photographs."""
    views: tuple[str, ...] = ()
    """Names of one to seven cameras; of photographs, their names without suffix, by default all."""
    photos: PhotographsConfig = field(default_factory=PhotographsConfig)

    def fit(self, shards: Path, identity: str | None, views: tuple[str, ...]) -> FitConfig:
        """What is fitted once the shards are there."""
        chosen = {one.name: getattr(self, one.name) for one in fields(FitConfig)}
        return FitConfig(**{**chosen, "shards": shards, "identity": identity, "views": views})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    command = parse(sys.argv[1:] if arguments is None else arguments)
    return training_status(lambda: _fitted(command), PROGRAM, command.shards)


def _fitted(command: FitCommand) -> int:
    from preface.cli.folders import require_own

    require_own(command.output, "a head", OF_A_RUN + OF_PHOTOGRAPHS)
    if not is_shards(command.shards):
        return _fit_photographs(command)
    _require_no_photographs(command)
    return _fit(command.fit(command.shards, command.identity, command.views))


def parse(arguments: Sequence[str]) -> FitCommand:
    """The configuration that arguments ask for; ends the process for help and for wrong usage."""
    first = argparse.ArgumentParser(PROGRAM, add_help=False, allow_abbrev=False)
    first.add_argument("--quality", default=DEFAULT_QUALITY)
    name = first.parse_known_args(arguments)[0].quality
    # An unknown name is refused below, with the names that there are.
    quality: Any = name if name in QUALITIES else DEFAULT_QUALITY
    inversion, finetuning, run = defaults(quality)
    default = FitCommand(
        shards=tyro.MISSING, quality=quality, inversion=inversion, finetuning=finetuning, run=run
    )
    return parse_flags(FitCommand, PROGRAM, arguments, default)


def is_shards(path: Path) -> bool:
    """Whether a path is to be read as shards, a folder with their manifest or the manifest itself, or as photographs.

    Raises:
        ArtifactError: there is no such folder, or it is another file.
    """
    from preface.artifacts import ArtifactError
    from preface.shards.manifest import MANIFEST_FILE

    if path.is_dir():
        return (path / MANIFEST_FILE).exists()
    if path.name == MANIFEST_FILE and path.is_file():
        return True
    there = path.exists()
    problem = "is a file, and neither shards nor photographs" if there else "there is no such folder"
    remedy = "Give the folder of the shards, or one of one to seven photographs of one person"
    raise ArtifactError(path, "file" if there else "folder", problem, remedy)


def _require_no_photographs(command: FitCommand) -> None:
    default = PhotographsConfig()
    for one in fields(PhotographsConfig):
        if getattr(command.photos, one.name) != getattr(default, one.name):
            raise UsageError(
                f"--photos.{one.name} is for a folder of photographs, and {command.shards} holds shards"
            )


def _fit(config: FitConfig) -> int:
    from preface.model.fitting.run import fit_head

    return run_to_end(lambda: fit_head(config, say))


def _fit_photographs(command: FitCommand) -> int:
    """From photographs to a head, and how far it can be trusted."""
    from preface.cli.fit_photos import StageError, explain, prepare

    try:
        prepared = prepare(command, say)
    except StageError as error:  # the stage has said why
        return error.status
    status = _fit(command.fit(prepared.shards, prepared.identity, prepared.views))
    if status == 0:
        explain(prepared, command, say)
    return status


if __name__ == "__main__":
    sys.exit(main())
