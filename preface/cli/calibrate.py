"""``preface-calibrate``: from pictures of a board, or photographs, to a rig; and rigs of other programs.

This module reads the command line and prints; `calibrate_board` and `calibrate_photos` do the work. They are
imported when they are needed, so that ``--help`` does not wait for numpy.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from preface.cli.output import exit_status, interruptible, length, whole_number
from preface.cli.usage import Parser

_DESCRIPTION = "Calibrate the cameras of a capture, or bring in the calibration of another program."
_EPILOG = "Exit status: 0 when the rig was written, 1 when something is wrong, 2 for wrong usage."
CAMERA_MODELS = ("PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FORMATS = (
    "colmap-text",
    "colmap-binary",
    "nerfstudio",
    "opencv",
    "anipose",
    "caliscope",
    "facescape",
    "mrcal",
    "cafca",
    "nersemble",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    _keep_blas_to_one_thread()
    parser = _parser()
    config = parser.parse_args(arguments)
    return interruptible(
        lambda: exit_status(lambda: config.run(config), config.parser, config.source, _reasons)
    )


def _keep_blas_to_one_thread() -> None:
    """Before numpy is loaded: its threads only hinder small solves, a hundredfold on cores that are busy.

    Whoever set a number of threads is obeyed.
    """
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _reasons() -> tuple[type[Exception], ...]:
    """Errors that tell a user what to do; anything else is a defect of this program."""
    from preface.capture.boards import BoardError
    from preface.capture.calibration import CalibrationError
    from preface.capture.observations import ObservationError
    from preface.geometry.errors import GeometryError

    return BoardError, CalibrationError, GeometryError, ObservationError


# ------------------------------------------------------------------------------------- what to run


def _run_board(config: argparse.Namespace) -> list[str]:
    from preface.cli.calibrate_board import run

    return run(config)


def _run_photos(config: argparse.Namespace) -> list[str]:
    from preface.cli.calibrate_photos import run

    return run(config)


def _run_import(config: argparse.Namespace) -> list[str]:
    from dataclasses import replace

    from preface.artifacts import provenance
    from preface.capture.formats import read_rig_from
    from preface.capture.rig import write_rig
    from preface.cli.folders import make_folder
    from preface.cli.rig_files import new_rig_file

    rig = read_rig_from(config.source, config.format)
    source = config.source
    files = [source] if source.is_file() else sorted(f for f in source.iterdir() if f.is_file())
    history = provenance({"command": "import", "format": config.format}, {file.name: file for file in files})
    named = replace(rig, take=config.take or rig.take, scale=config.scale, provenance=history)
    path = new_rig_file(config.output)
    make_folder(path.parent)
    written = write_rig(path, named)
    assumed = [f"assumed: {words}" for words in rig.metadata["imported"]["assumptions"]]
    return [
        f"{len(rig.cameras)} cameras of format {rig.metadata['imported']['format']}",
        *assumed,
        str(written),
    ]


def _run_export(config: argparse.Namespace) -> list[str]:
    from preface.capture.formats import export_rig
    from preface.capture.rig import read_rig
    from preface.cli.rig_files import one_rig_file

    rig = read_rig(one_rig_file(config.source))
    return [str(export_rig(rig, config.output, config.format))]


# --------------------------------------------------------------------------------------- the flags


def _parser() -> argparse.ArgumentParser:
    parser = Parser("preface-calibrate", description=_DESCRIPTION, epilog=_EPILOG)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_board(commands)
    _add_photos(commands)
    _add_import(commands)
    _add_export(commands)
    return parser


def _command(commands: Any, name: str, run: Any, words: str, source: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name, help=words[:1].lower() + words[1:], description=f"{words}.", epilog=_EPILOG
    )
    parser.set_defaults(run=run, parser=parser, command=name)
    parser.add_argument("source", metavar=source.split(":")[0], type=Path, help=source.split(": ")[1])
    return parser


def _add_board(commands: Any) -> None:
    words = "Calibrate fixed cameras from pictures of a board"
    parser = _command(
        commands, "board", _run_board, words, "CAPTURE: folder of the capture, or its capture.json"
    )
    _add_the_board(parser)
    _add_the_model(parser)
    _add_what_is_used(parser)
    _add_output(parser, "for several takes a folder, which then holds rigs/TAKE.json")
    parser.set_defaults(output=None)  # what it is depends on the number of takes


def _add_the_board(parser: argparse.ArgumentParser) -> None:
    board = parser.add_argument_group("the board (default: as the manifest says)")
    board.add_argument("--board", choices=("charuco", "chessboard", "aprilgrid"), help="what it is")
    board.add_argument(
        "--squares",
        metavar="COLUMNSxROWS",
        help="of squares; inner corners of a chessboard, tags of an aprilgrid",
    )
    board.add_argument(
        "--square-size",
        type=length,
        metavar="METRES",
        help="edge of a square, measured; tag to tag in an aprilgrid",
    )
    board.add_argument("--marker-size", type=length, metavar="METRES", help="edge of a marker")
    board.add_argument("--dictionary", metavar="NAME", help="OpenCV's name, such as DICT_4X4_50")
    board.add_argument("--legacy", action="store_true", help="a ChArUco board made with OpenCV before 4.6")
    board.add_argument("--inverted", action="store_true", help="printed white on black")


def _add_the_model(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("the model")
    model.add_argument(
        "--camera-model",
        choices=("auto", *CAMERA_MODELS),
        default="auto",
        help="auto: the simplest that held-out frames support (default: auto)",
    )
    model.add_argument(
        "--board-warp",
        choices=("auto", "on", "off"),
        default="auto",
        help="whether the board may bow; auto: if held-out frames support it (default: auto)",
    )
    model.add_argument(
        "--backend", choices=("own", "pycolmap"), default="own", help="who solves (default: own)"
    )
    model.add_argument(
        "--held-out",
        type=whole_number(2),
        default=5,
        metavar="N",
        help="hold every N-th frame out, each in turn, to measure the error on frames not seen (default: 5)",
    )


def _add_what_is_used(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--take", action="append", metavar="NAME", help="only this take; may be given several times"
    )
    parser.add_argument(
        "--leave-out",
        action="append",
        metavar="CAMERA",
        help="without this camera; may be given several times",
    )
    parser.add_argument(
        "--known-distance",
        nargs=3,
        metavar=("CAMERA", "CAMERA", "METRES"),
        help="a measured distance between two cameras, which shows a wrong square size",
    )
    parser.add_argument(
        "--search-side",
        type=whole_number(64),
        default=2048,
        metavar="PIXELS",
        help="boards are searched for in images reduced to this longer side (default: 2048)",
    )
    parser.add_argument(
        "--every",
        type=whole_number(1),
        default=1,
        metavar="N",
        help="take every N-th frame of videos without timestamps (default: 1)",
    )
    parser.add_argument(
        "--corners",
        type=Path,
        metavar="FILE",
        help="use these corners (corners.json) instead of finding the board",
    )
    parser.add_argument(
        "--jobs", type=whole_number(1), metavar="N", help="processes that find boards (default: all cores)"
    )


def _add_photos(commands: Any) -> None:
    words = "Calibrate from photographs of one person, taken with one or more cameras from all around"
    parser = _command(commands, "photos", _run_photos, words, "CAPTURE: folder of the photographs")
    parser.add_argument(
        "--cameras",
        choices=("one", "folder", "each"),
        default="one",
        help="which photographs share a lens: all, those of a folder, or none (default: one)",
    )
    parser.add_argument(
        "--masks", type=Path, metavar="FOLDER", help="masks, one per photograph, of where to look"
    )
    parser.add_argument(
        "--known-distance",
        nargs=3,
        metavar=("PHOTO", "PHOTO", "METRES"),
        help="distance between two photographs' cameras; without it the scale is arbitrary",
    )
    parser.add_argument("--take", metavar="NAME", default="photos", help="name of the take (default: photos)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of everything random (default: 0)")
    parser.add_argument("--jobs", type=whole_number(1), metavar="N", help="threads (default: all cores)")
    _add_output(parser, "the rig, with one camera per photograph")


def _add_import(commands: Any) -> None:
    words = "Read a rig of another program"
    parser = _command(commands, "import", _run_import, words, "SOURCE: its file or folder")
    parser.add_argument("--format", choices=FORMATS, help="default: found out")
    parser.add_argument("--take", metavar="NAME", help="name of the take (default: default)")
    parser.add_argument(
        "--scale",
        choices=("metric", "arbitrary"),
        default="metric",
        help="whether its lengths are metres, or nothing said how long a metre is, as in COLMAP's own models; no "
        "format says which (default: metric)",
    )
    parser.add_argument(
        "--output", type=Path, default=Path("rig.json"), metavar="PATH", help="default: rig.json"
    )


def _add_export(commands: Any) -> None:
    words = "Write a rig for another program"
    parser = _command(commands, "export", _run_export, words, "RIG: rig.json, or a folder that holds one")
    parser.add_argument("--format", choices=FORMATS, required=True, help="what to write")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH", help="file or folder to write")


def _add_output(parser: argparse.ArgumentParser, more: str) -> None:
    parser.add_argument(
        "--output", type=Path, default=Path("rig.json"), metavar="PATH", help=f"default: rig.json; {more}"
    )
    parser.add_argument(
        "--report", type=Path, metavar="PATH.html", help="default: beside the rig, as rig.report.html"
    )


if __name__ == "__main__":
    sys.exit(main())
