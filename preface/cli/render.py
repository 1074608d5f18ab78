"""``preface-render``: images, depth and normals of a prior's identities, or of a head, from any camera.

This module reads the command line; `render_frames` does the work and is imported when it is needed, so that
``--help`` does not wait for PyTorch.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from preface.cli.output import exit_status, interruptible, number, size, whole_number
from preface.cli.render_flags import add_device_flags, add_quality_flags
from preface.cli.usage import Parser
from preface.model.pretrained import prior_flag

_DESCRIPTION = "Render what a model knows of a head: colour, opacity, depth and normals."
_EPILOG = "Exit status: 0 when everything was written, 1 when something is wrong, 2 for wrong usage."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = _parser()
    config = parser.parse_args(arguments)
    return interruptible(lambda: exit_status(lambda: _run(config), parser, config.model, _reasons))


def _run(config: argparse.Namespace) -> list[str]:
    from preface.cli.render_frames import run

    return run(config)


def _reasons() -> tuple[type[Exception], ...]:
    """Errors that tell a user what to do; anything else is a defect of this program."""
    from preface.geometry import GeometryError

    return (GeometryError,)


def _parser() -> argparse.ArgumentParser:
    parser = Parser("preface-render", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "model",
        type=prior_flag,
        help="folder of a prior or a head, or its model.json; `pretrained` is the prior that comes with preface",
    )
    parser.add_argument("--output", type=Path, required=True, help="folder for the images, made if absent")
    who = parser.add_argument_group("who")
    who.add_argument("--identity", help="whose code to render; may be left out if there is only one")
    who.add_argument(
        "--towards", help="another identity: codes go from the first to this one, frame by frame"
    )
    where = parser.add_argument_group("from where").add_mutually_exclusive_group()
    where.add_argument(
        "--orbit",
        type=whole_number(1),
        metavar="FRAMES",
        help="cameras around the head (default: one, in front)",
    )
    where.add_argument(
        "--cameras",
        type=Path,
        help="a rig.json or any format that preface-calibrate imports, whose cameras to use",
    )
    parser.add_argument(
        "--alignment",
        type=Path,
        help="<identity>.json that carries the rig of --cameras to the canonical frame (default: it is that frame)",
    )
    _add_the_orbit(parser)
    _add_what_is_written(parser)
    add_device_flags(parser.add_argument_group("speed"))
    add_quality_flags(parser)
    return parser


def _add_the_orbit(parser: argparse.ArgumentParser) -> None:
    path = parser.add_argument_group("the orbit")
    path.add_argument(
        "--azimuth",
        type=number(0, 180),
        default=40.0,
        help="degrees to either side, 180: all around (default: 40)",
    )
    path.add_argument(
        "--elevation", type=number(-85, 85), default=10.0, help="degrees up and down (default: 10)"
    )
    path.add_argument(
        "--distance",
        type=number(1e-3, 1e3),
        default=1.0,
        help="metres from the middle of the box (default: 1)",
    )


def _add_what_is_written(parser: argparse.ArgumentParser) -> None:
    image = parser.add_argument_group("the images")
    image.add_argument(
        "--size", type=size, metavar="WxH", help="of an orbit's images (default: those of training)"
    )
    image.add_argument(
        "--background", type=number(0, 1), default=0.0, help="grey value behind the head, 0 to 1 (default: 0)"
    )
    image.add_argument("--no-normals", action="store_true", help="save the time that normals take")
    image.add_argument("--no-exr", action="store_true", help="PNG only")
    image.add_argument("--video", action="store_true", help="also orbit.webm")
    mesh = parser.add_argument_group("the surface")
    mesh.add_argument("--mesh", type=Path, metavar="FILE", help="also write a mesh: .ply, .glb or .obj")
    mesh.add_argument(
        "--mesh-resolution",
        type=whole_number(2),
        default=256,
        metavar="N",
        help="voxels along the box's longest side (default: %(default)s)",
    )
    mesh.add_argument(
        "--surface",
        type=number(1e-3, 0.999),
        default=0.5,
        metavar="OPACITY",
        help="the surface is where a centimetre stops this share of the light (default: %(default)s)",
    )


if __name__ == "__main__":
    sys.exit(main())
