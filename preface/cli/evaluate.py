"""``preface-evaluate``: heads held against photographs that they were not fitted to.

This module reads the command line; `evaluate_heads` does the work and is imported when it is needed, so that
``--help`` does not wait for PyTorch.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from preface.cli.output import exit_status, interruptible, number
from preface.cli.render_flags import add_device_flags
from preface.cli.usage import Parser
from preface.model.evaluation.options import FACE_HALF_SIDE, LPIPS_CHOICES
from preface.model.pretrained import prior_flag
from preface.model.rendering.shortcuts import QUALITIES

_DESCRIPTION = (
    "Render heads at views that they were not fitted to, measure PSNR, SSIM and LPIPS against the photographs, and "
    "show both beside each other."
)
_EPILOG = (
    "It writes NAME/metrics.json, sheets of pictures, tables in Markdown and LaTeX, and report.html. "
    "Exit status: 0 when everything was written, 1 when something is wrong, 2 for wrong usage."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = _parser()
    config = parser.parse_args(arguments)
    return interruptible(lambda: exit_status(lambda: _run(config), parser, config.shards))


def _run(config: argparse.Namespace) -> list[str]:
    from preface.cli.evaluate_heads import run

    return run(config)


def _parser() -> argparse.ArgumentParser:
    parser = Parser("preface-evaluate", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "heads",
        type=prior_flag,
        nargs="+",
        metavar="HEAD",
        help="folder of a head, or of a prior; `pretrained` is the prior that comes with preface",
    )
    parser.add_argument("--shards", type=Path, required=True, help="with the photographs, at any resolution")
    parser.add_argument("--output", type=Path, required=True, help="folder, made if absent")
    what = parser.add_argument_group("of what")
    what.add_argument(
        "--identity", help="whose photographs (default: the identity of each head; a prior needs it)"
    )
    what.add_argument(
        "--views",
        nargs="+",
        metavar="CAMERA",
        help="cameras (default: all of the identity that none of the heads has seen)",
    )
    how = parser.add_argument_group("how")
    how.add_argument(
        "--lpips",
        choices=LPIPS_CHOICES,
        default="both",
        help="networks: vgg, what most papers report; alex, the default of LPIPS' authors (default: both)",
    )
    how.add_argument(
        "--face-half-side",
        type=number(1e-3, 10),
        default=FACE_HALF_SIDE,
        metavar="METRES",
        help=f"half the side of the square that is cropped about the face (default: {FACE_HALF_SIDE})",
    )
    how.add_argument("--images", action="store_true", help="also each view at its full size, as PNG")
    speed = parser.add_argument_group("speed")
    speed.add_argument(
        "--quality",
        choices=tuple(QUALITIES),
        default="reference",
        help="shortcuts of rendering (default: reference, none: the model as it was trained)",
    )
    speed.add_argument(
        "--normals",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="show normals on the sheets; no figure depends on them, and without them rendering takes some two thirds "
        "of the time (default: shown)",
    )
    add_device_flags(speed)
    return parser


if __name__ == "__main__":
    sys.exit(main())
