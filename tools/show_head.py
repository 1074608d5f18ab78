"""A picture of a head: photographs that it was fitted to, three at most, and renders in colour, depth and normals.

    preface-render head --orbit 5 --azimuth 50 --size 288x432 --output orbit
    python tools/show_head.py head orbit --shards shards --output head.jpg

Renders are shown as `preface-render` wrote them, with its legend below. The README's picture is made by this.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from demo_page.pictures import orbit_frames
from preface.artifacts import ArtifactError, write_bytes
from preface.capture.images import read_image
from preface.cli.output import exit_status
from preface.cli.render_frames import LEGEND_FILE
from preface.cli.usage import Parser
from preface.model.evaluation.evaluate import photograph_on_black
from preface.model.training.prior_files import read_prior
from preface.reports.pictures import Picture, as_picture, contact_sheet, stacked
from preface.reports.plots import encode_picture
from preface.shards import Dataset


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("head", type=Path, help="folder of a head")
    parser.add_argument("renders", type=Path, help="what preface-render made of it by --orbit")
    parser.add_argument("--shards", type=Path, required=True, help="that it was fitted to")
    parser.add_argument("--output", type=Path, required=True, help="picture to write, JPEG")
    options = parser.parse_args(arguments)

    def run() -> list[str]:
        picture = head_picture(options.head, options.renders, options.shards)
        return [str(write_bytes(options.output, encode_picture(picture, "jpeg")))]

    return exit_status(run, parser, parser.prog, lambda: (OSError,))


def head_picture(head: Path, renders: Path, shards: Path) -> Picture:
    """A column of photographs beside a row of renders each for colours, depths and normals.

    Raises:
        ArtifactError: unreadable, or a prior where a head is expected.
    """
    prior = read_prior(head)
    if prior.fit is None:
        raise ArtifactError(
            prior.path, "fit", "is missing: this is a prior", "Give a folder that preface-fit wrote"
        )
    frames = orbit_frames(renders)
    first = as_picture(read_image(renders / f"{frames[0]}.png"))
    with Dataset(shards) as dataset:
        photographs = [
            as_picture(photograph_on_black(dataset, prior.identities[0], view)[0])
            for view in prior.fit["views"]
        ]
    blank = np.zeros_like(first)
    tiles: list[tuple[Picture, str]] = []
    for row, kind in enumerate(("", ".depth", ".normals")):
        tiles.append((photographs[row], "photograph") if row < len(photographs) else (blank, ""))
        words = kind.removeprefix(".") or "render"
        tiles += [(as_picture(read_image(renders / f"{frame}{kind}.png")), words) for frame in frames]
    height, width = first.shape[:2]
    sheet = contact_sheet(tiles, 1 + len(frames), (width, height))
    return stacked(sheet, as_picture(read_image(renders / LEGEND_FILE)))


if __name__ == "__main__":
    sys.exit(main())
