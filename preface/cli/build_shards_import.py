"""``preface-build-shards import``: a public dataset in its own layout becomes a capture with rigs.

The heavy imports wait until there is something to do, so that ``--help`` does not.
"""

import argparse
from pathlib import Path

from preface.cli.output import positive, say
from preface.cli.usage import UsageError

LAYOUTS = ("cafca", "facescape")
MAX_NAMED = 8  # views in notes; capture.json has all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of ``preface-build-shards import``."""
    parser.add_argument("source", metavar="SOURCE", type=Path, help="folder of the dataset")
    parser.add_argument("--layout", choices=LAYOUTS, required=True, help="how the dataset lies there")
    parser.add_argument(
        "--output", type=Path, required=True, metavar="CAPTURE", help="folder to write; new, or empty"
    )
    parser.add_argument(
        "--link",
        choices=("hard", "copy"),
        default="hard",
        help="hard: images are linked, which needs no space but the same file system, and editing one edits both; "
        "copy: they are copied (default: hard)",
    )
    parser.add_argument(
        "--frames",
        nargs="+",
        default=["*"],
        metavar="PATTERN",
        help="only frames whose PERSON/FRAME matches one of these, such as '*/00000_000' or '1?/*_smile' "
        "(default: all)",
    )
    parser.add_argument(
        "--metres-per-unit",
        type=positive,
        metavar="METRES",
        help="length of the dataset's unit (default: 1)",
    )
    parser.add_argument(
        "--registrations",
        type=Path,
        metavar="FILE",
        help="facescape: the toolkit's Rt_scale_dict.json, which brings all frames to one frame, in millimetres",
    )
    parser.add_argument(
        "--strict",
        action="store_true",
        help="stop at the first view that must be left out, and write nothing",
    )


def run(config: argparse.Namespace) -> list[str]:
    """Import; returns the lines to print, the path last.

    Raises:
        UsageError: flags that contradict each other.
        ArtifactError: see `preface.capture.importers`.
    """
    from preface.capture.importers import ImportOptions, import_dataset

    if config.registrations is not None and config.layout != "facescape":
        raise UsageError(f"--registrations is for --layout facescape, not {config.layout}: leave it out")
    if config.registrations is not None and config.metres_per_unit is not None:
        raise UsageError("--registrations says the unit, millimetres: leave --metres-per-unit out")
    options = ImportOptions(
        link=config.link,
        patterns=tuple(config.frames),
        metres_per_unit=config.metres_per_unit or 1.0,
        registrations=config.registrations,
        strict=config.strict,
    )
    result = import_dataset(config.layout, config.source, config.output, options)
    for note in result.notes:
        say(f"note: {note}")
    for left in result.left_out[:MAX_NAMED]:
        say(f"left out: {left}")
    if len(result.left_out) > MAX_NAMED:
        say(f"and {len(result.left_out) - MAX_NAMED} more; capture.json lists them under metadata.imported")
    summary = (
        f"{result.subjects} subjects of {result.people} people, {result.views} views, {result.masks} masks, "
        f"{result.takes} takes; left out: {len(result.left_out)}"
    )
    return [summary, str(config.output)]
