"""``preface-build-shards``: from photographs, rigs and an alignment to a dataset of shards.

This module reads the command line and prints; `build_shards_dataset`, `build_shards_export` and `build_shards_import`
do the work. They are imported when they are needed, so that ``--help`` does not wait for numpy.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

from preface.cli.output import exit_status, number, positive, resumable, size, whole_number
from preface.cli.usage import Parser

_DESCRIPTION = "Build a dataset of shards from a capture, its rigs and its alignment."
_EPILOG = (
    "'preface-build-shards export --help' and 'preface-build-shards import --help' tell how shards become the files of "
    "other trainers, and how public datasets become captures. "
    "Exit status: 0 when the dataset is complete, 1 when something is wrong, 2 for wrong usage."
)
_OTHERS = {
    "export": ("preface.cli.build_shards_export", "Write shards, or a part of them, for other trainers."),
    "import": ("preface.cli.build_shards_import", "Turn a public dataset into a capture with rigs."),
}
MAX_BOX = 100.0  # metres from the face; more is another unit
METHODS = ("auto", "given", "green", "black", "plate", "selfie", "onnx", "none")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser, run = _chosen(words)
    config = parser.parse_args(words)
    return resumable(lambda: exit_status(lambda: run(config), parser, config.source, _reasons))


def _reasons() -> tuple[type[Exception], ...]:
    """Errors that tell a user what to do; anything else is a defect of this program."""
    from preface.capture.preparation import PreparationError
    from preface.geometry.errors import GeometryError

    return GeometryError, PreparationError


def _chosen(words: list[str]) -> tuple[argparse.ArgumentParser, Callable[[argparse.Namespace], list[str]]]:
    """The parser and what it runs, by the first word, which is taken off where it is a subcommand."""
    if not words or words[0] not in _OTHERS:
        return _parser(), _build
    name = words.pop(0)
    module, description = _OTHERS[name]
    found = import_module(module)
    parser = Parser(f"preface-build-shards {name}", description=description)
    found.add_arguments(parser)
    return parser, found.run


def _build(config: argparse.Namespace) -> list[str]:
    from preface.cli.build_shards_dataset import run

    return run(config)


# --------------------------------------------------------------------------------------- the flags


def _parser() -> argparse.ArgumentParser:
    parser = Parser("preface-build-shards", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "source",
        metavar="CAPTURE",
        type=Path,
        help="folder of the capture, or its capture.json; or the folder of photographs that preface-align photos was "
        "given",
    )
    parser.add_argument(
        "--rig",
        nargs="+",
        type=Path,
        required=True,
        metavar="RIG",
        help="rig.json of each take, or folders that hold them",
    )
    parser.add_argument(
        "--alignment", type=Path, required=True, metavar="DIR", help="what preface-align wrote"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("shards"), metavar="DIR", help="folder to write (default: shards)"
    )
    parser.add_argument(
        "--resolution",
        type=size,
        required=True,
        metavar="WIDTHxHEIGHT",
        help="size of all views, pixels, such as 512x768",
    )
    parser.add_argument(
        "--only", nargs="+", metavar="IDENTITY", help="only these people (default: all that are aligned)"
    )
    _add_images(parser)
    _add_foreground(parser)
    _add_dataset(parser)
    _add_running(parser)
    return parser


def _add_images(parser: argparse.ArgumentParser) -> None:
    images = parser.add_argument_group("images")
    images.add_argument(
        "--framing",
        choices=("whole", "center", "box"),
        default="whole",
        help="the whole image (default; the aspect must be the resolution's), its middle, or around the head's box",
    )
    images.add_argument(
        "--filter",
        choices=("area", "lanczos", "bilinear"),
        default="area",
        help="how images are reduced (default: area)",
    )
    images.add_argument(
        "--light",
        choices=("linear", "encoded"),
        default="linear",
        help="whether they are reduced in linear light (default) or as encoded, which is faster and darkens detail",
    )
    images.add_argument(
        "--undistort",
        choices=("auto", "keep", "resample"),
        default="auto",
        help="keep lens distortion in the cameras, resample it away, or keep it unless a lens folds (default: auto)",
    )
    images.add_argument(
        "--white",
        type=positive,
        default=1.0,
        metavar="LIGHT",
        help="linear light of EXR images that becomes white (default: 1)",
    )
    images.add_argument(
        "--max-pixels",
        type=whole_number(1),
        default=2**28,
        metavar="N",
        help="leave out images of more pixels, before they are decoded (default: %(default)s)",
    )
    images.add_argument(
        "--box",
        nargs=6,
        type=number(-MAX_BOX, MAX_BOX),
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="the box that holds a head, canonical frame, metres (default: -0.20 -0.25 -0.25 0.20 0.25 0.12)",
    )


def _add_foreground(parser: argparse.ArgumentParser) -> None:
    foreground = parser.add_argument_group("foreground")
    foreground.add_argument(
        "--foreground",
        choices=METHODS,
        default="auto",
        help="how it is found (default: auto, which says for each take what it chose and why)",
    )
    foreground.add_argument(
        "--matting-model", type=Path, metavar="FILE", help="your ONNX matting model, for the method onnx"
    )
    foreground.add_argument(
        "--masks",
        type=Path,
        metavar="DIR",
        help="masks of a folder of photographs, by the photographs' names; a capture has its own",
    )


def _add_dataset(parser: argparse.ArgumentParser) -> None:
    dataset = parser.add_argument_group("the dataset")
    dataset.add_argument(
        "--holdout",
        nargs="+",
        default=[],
        metavar="WHO",
        help="how many identities are not for training: a number, a share (0.1 or 10%%), or their names",
    )
    dataset.add_argument(
        "--seed", type=whole_number(0), default=0, help="who is held out by number (default: 0)"
    )
    dataset.add_argument(
        "--pixel-order",
        choices=("raster", "permuted"),
        default="raster",
        help="permuted is for datasets larger than the memory of who reads them (default: raster)",
    )
    dataset.add_argument(
        "--identities-per-shard",
        type=whole_number(1),
        metavar="N",
        help="default: what makes about 256 MiB, 16 at most",
    )
    dataset.add_argument("--name", default="preface-heads", help="name of the dataset (default: %(default)s)")
    dataset.add_argument(
        "--strict", action="store_true", help="stop at what cannot be used, instead of leaving it out"
    )


def _add_running(parser: argparse.ArgumentParser) -> None:
    running = parser.add_argument_group("running (finished shards are verified and kept)")
    running.add_argument("--dry-run", action="store_true", help="say what it would take, and write nothing")
    running.add_argument(
        "--jobs", type=whole_number(1), metavar="N", help="processes on this machine (default: all cores)"
    )
    running.add_argument(
        "--scheduler",
        choices=("local", "dask"),
        default="local",
        help="who runs the tasks, one per shard (default: processes on this machine)",
    )
    running.add_argument(
        "--dask-address",
        metavar="ADDRESS",
        help="of the cluster's scheduler, such as tcp://host:8786 (default: a cluster on this machine)",
    )
    running.add_argument(
        "--shard",
        type=whole_number(0),
        metavar="K",
        help="build this shard only, as one task of a job array does (--dry-run says how many there are)",
    )
    running.add_argument(
        "--finish",
        action="store_true",
        help="write the manifest of shards that are all there, as the last job of an array does",
    )


if __name__ == "__main__":
    sys.exit(main())
