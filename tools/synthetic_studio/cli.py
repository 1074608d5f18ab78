"""The studio's command line: parse, check, run or estimate, and report."""

from __future__ import annotations

import shutil
from collections.abc import Sequence

import tyro

from preface.cli.output import exit_status, resumable, say
from preface.cli.typed_flags import refusing, told_in_a_line
from preface.plain_words import counted, disk_space
from synthetic_studio.assets import check_assets
from synthetic_studio.boards import markers_in_words
from synthetic_studio.config import StudioConfig, StudioError, validate
from synthetic_studio.estimate import estimate
from synthetic_studio.writer import write_studio

PROGRAM = "synthetic_studio"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the studio; returns the exit status: 0, 2 for wrong usage, 130 if interrupted, 1 otherwise."""
    with told_in_a_line(PROGRAM):
        config = tyro.cli(StudioConfig, prog=PROGRAM, args=arguments)
    reasons = (StudioError, OSError)
    return resumable(
        lambda: exit_status(lambda: _run(config), refusing(PROGRAM), config.output, lambda: reasons)
    )


def _run(config: StudioConfig) -> list[str]:
    """Write the studio, or say what that would take; returns the lines to print."""
    validate(config)
    if not config.dry_run:
        for line in markers_in_words(config):
            say(" ".join(line.split()))
        return [str(write_studio(config))]
    if config.assets is not None:
        check_assets(config.assets)
    return [describe(config)]


def describe(config: StudioConfig) -> str:
    """What a run would write, how long it would take, and the room there is."""
    cost = estimate(config)
    folder = config.output.absolute()
    existing = next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    free = shutil.disk_usage(existing).free
    minutes, workers = cost.seconds / config.workers / 60, counted(config.workers, "worker", "workers")
    lines = [
        f"photographs         {cost.photographs:>10,}",
        f"calibration images  {cost.calibration_images:>10,}",
        f"clean plates        {cost.plates:>10,}",
        f"disk                {disk_space(cost.bytes):>13}, truth included; {disk_space(free)} are free",
        f"time                {minutes:>10.1f} min on {workers}, by the studio's cost model",
        f"output              {config.output} (nothing written)",
    ]
    markers = markers_in_words(config)
    lines[3:3] = markers[:1]
    lines += markers[1:]
    if cost.bytes > free:
        lines.append(
            "The disk is too small: choose another --output, fewer --identities or a lower --resolution."
        )
    return "\n".join(lines)
