"""The studio's command line: parse, check, run or estimate, and report."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence

import tyro

from preface.artifacts import ArtifactError
from synthetic_studio.assets import check_assets
from synthetic_studio.config import StudioConfig, StudioError, UsageError, validate
from synthetic_studio.estimate import estimate
from synthetic_studio.writer import write_studio

INTERRUPTED = 130  # 128 + SIGINT, as shells report it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the studio; returns the exit status: 0, 2 for wrong usage, 130 if interrupted, 1 otherwise."""
    config = tyro.cli(StudioConfig, prog="synthetic_studio", args=arguments)
    try:
        if config.dry_run:
            validate(config)
            if config.assets is not None:
                check_assets(config.assets)
            print(describe(config))
        else:
            print(write_studio(config))
    except UsageError as error:
        return _complain(str(error), 2)
    except (StudioError, ArtifactError, OSError) as error:
        return _complain(str(error), 1)
    except KeyboardInterrupt:
        return _complain("interrupted; run the same command again to resume", INTERRUPTED)
    return 0


def describe(config: StudioConfig) -> str:
    """What a run would write, how long it would take, and the room there is."""
    cost = estimate(config)
    folder = config.output.absolute()
    existing = next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    free = shutil.disk_usage(existing).free
    minutes = cost.seconds / config.workers / 60
    lines = [
        f"photographs         {cost.photographs:>10,}",
        f"calibration images  {cost.calibration_images:>10,}",
        f"clean plates        {cost.plates:>10,}",
        f"disk                {cost.bytes / 1e9:>10.2f} GB, truth included; {free / 1e9:.1f} GB are free",
        f"time                {minutes:>10.1f} min on {config.workers} workers, by the studio's cost model",
        f"output              {config.output} (nothing written)",
    ]
    if cost.bytes > free:
        lines.append(
            "The disk is too small: choose another --output, fewer --identities or a lower --resolution."
        )
    return "\n".join(lines)


def _complain(message: str, status: int) -> int:
    print(f"synthetic_studio: {message}", file=sys.stderr)
    return status
