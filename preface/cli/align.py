"""``preface-align``: from calibrated views, or a few photographs, to faces in one canonical frame.

This module reads the command line and prints; `align_studio` and `align_photos` do the work. They are imported
when they are needed, so that ``--help`` does not wait for numpy.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from preface.cli.output import exit_status, resumable, whole_number
from preface.cli.usage import Parser
from preface.model.pretrained import prior_flag, prior_path

_DESCRIPTION = "Find the face in every view and bring all faces into one canonical frame."
_EPILOG = "Exit status: 0 when the alignment was written, 1 when something is wrong, 2 for wrong usage."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = _parser()
    config = parser.parse_args(arguments)
    return resumable(lambda: exit_status(lambda: config.run(config), config.parser, config.source, _reasons))


def _reasons() -> tuple[type[Exception], ...]:
    """Errors that tell a user what to do; anything else is a defect of this program."""
    from preface.align.errors import AlignmentError
    from preface.geometry.errors import GeometryError

    return AlignmentError, GeometryError


# ------------------------------------------------------------------------------------- what to run


def _run_studio(config: argparse.Namespace) -> list[str]:
    from preface.cli.align_studio import run

    config.template = _template_path(config.template)
    return run(config)


def _run_photos(config: argparse.Namespace) -> list[str]:
    from preface.cli.align_photos import run

    config.template = _template_path(config.template)
    return run(config)


def _template_path(given: str | Path | None) -> Path | None:
    return None if given is None else prior_path(given)


# --------------------------------------------------------------------------------------- the flags


def _parser() -> argparse.ArgumentParser:
    parser = Parser("preface-align", description=_DESCRIPTION, epilog=_EPILOG)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_studio(commands)
    _add_photos(commands)
    return parser


def _command(commands: Any, name: str, run: Any, words: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name, help=words[:1].lower() + words[1:], description=f"{words}.", epilog=_EPILOG
    )
    parser.set_defaults(run=run, parser=parser, command=name)
    return parser


def _add_studio(commands: Any) -> None:
    words = "Align the people of a capture, seen by several calibrated cameras at once"
    parser = _command(commands, "studio", _run_studio, words)
    parser.add_argument(
        "source", metavar="CAPTURE", type=Path, help="folder of the capture, or its capture.json"
    )
    parser.add_argument(
        "--rig",
        nargs="+",
        type=Path,
        required=True,
        metavar="RIG",
        help="rig.json of each take, or folders that hold them (such as preface-calibrate's --output)",
    )
    _add_output(parser)
    parser.add_argument(
        "--only", nargs="+", metavar="IDENTITY", help="only these people (default: all of the capture)"
    )
    template = parser.add_argument_group("the canonical frame")
    template.add_argument(
        "--template",
        type=prior_flag,
        metavar="FILE",
        help="place everybody on this template (template.json, or the folder of an alignment or of a prior; "
        "`pretrained` is that of the prior that comes with preface) instead of making one: so a new person joins an "
        "old prior",
    )
    template.add_argument(
        "--identities",
        type=whole_number(1),
        metavar="N",
        help="make the template from the first N people (default: 260, as in the paper)",
    )
    template.add_argument(
        "--procrustes",
        action="store_true",
        help="bring the people together before the template is made, for takes without a common rig frame",
    )
    template.add_argument(
        "--scale",
        choices=("free", "fixed"),
        default="free",
        help="whether each person's scale is fitted (free, as in the paper) or kept, for metric rigs "
        "(default: free)",
    )
    _add_landmarks(parser, ("auto", "on", "off"), "auto, where mediapipe's own FaceMesh found them")


def _add_photos(commands: Any) -> None:
    words = "Align one still person in one to seven photographs, taken with one phone"
    parser = _command(commands, "photos", _run_photos, words)
    parser.add_argument("source", metavar="FOLDER", type=Path, help="folder of the photographs")
    _add_output(parser)
    parser.add_argument(
        "--cameras",
        type=Path,
        metavar="RIG",
        help="use these cameras (rig.json, one camera per photograph, by the file's name) instead of finding them",
    )
    parser.add_argument(
        "--template",
        type=prior_flag,
        metavar="FILE",
        help="place the person on this template (template.json, or the folder of an alignment or of a prior; "
        "`pretrained` is that of the prior that comes with preface)",
    )
    parser.add_argument("--identity", metavar="NAME", help="name of the person (default: the folder's)")
    parser.add_argument(
        "--only", nargs="+", metavar="PHOTO", help="only these photographs, by their names without suffix"
    )
    scale = parser.add_argument_group("the scale (default: the size that faces have)")
    scale.add_argument(
        "--known-distance",
        nargs=3,
        metavar=("A", "B", "METRES"),
        help="a measured distance: between two of right_eye_outer, left_eye_outer, nose_tip, mouth_center and chin, "
        "or between two photographs' cameras",
    )
    scale.add_argument(
        "--metric-cameras",
        action="store_true",
        help="the unit of the cameras that --cameras gives is the metre",
    )
    scale.add_argument(
        "--scale",
        choices=("free", "fixed"),
        default="free",
        help="whether the person's scale on the template is fitted or kept (default: free)",
    )
    # Learned on synthetic heads, it made the few real photographs that we have agree a little less with more of them.
    _add_landmarks(parser, ("off", "on"), "off")


def _add_landmarks(parser: argparse.ArgumentParser, bias: tuple[str, ...], bias_words: str) -> None:
    landmarks = parser.add_argument_group("2D landmarks")
    landmarks.add_argument(
        "--landmarks",
        type=Path,
        metavar="DIR",
        help="use the landmarks in this folder (data_specs/landmarks.md) instead of finding them",
    )
    landmarks.add_argument(
        "--landmark-model",
        type=Path,
        metavar="FILE",
        help="your own face_landmarker.task (default: the models in mediapipe 0.10.21)",
    )
    landmarks.add_argument(
        "--search-side",
        type=whole_number(64),
        metavar="PIXELS",
        help="faces are searched for in images reduced to this longer side, and refined at full resolution "
        "(default: 512)",
    )
    landmarks.add_argument(
        "--crops",
        type=whole_number(1),
        metavar="N",
        help="crops, each placed a little differently, whose agreement says how certain a landmark is (default: 8)",
    )
    landmarks.add_argument(
        "--landmark-bias",
        choices=bias,
        default=bias[0],
        help=f"whether landmarks are corrected by what FaceMesh gets wrong from each direction (default: {bias_words})",
    )
    landmarks.add_argument(
        "--jobs", type=whole_number(1), metavar="N", help="processes that look for faces (default: all cores)"
    )


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("alignment"),
        metavar="DIR",
        help="folder to write (default: alignment); landmarks found there are used again",
    )


if __name__ == "__main__":
    sys.exit(main())
