"""What an image of the synthetic studio costs, beside the bare ray casting of the same rays.

    python tools/bench/studio_speed.py [--identities 4] [--resolution 256x384] [--antialias 2]

One thread, CPU seconds: building a head, rendering it, and casting the same rays with nothing else done.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from preface.cli.usage import Parser

sys.path.insert(0, str(Path(__file__).parents[1]))

from synthetic_studio.config import parse_resolution
from synthetic_studio.heads import build_head
from synthetic_studio.render import HeadRenderer, pixel_rays
from synthetic_studio.rig import nominal_rig
from synthetic_studio.template import head_template


def main() -> None:
    """Measure and print."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--identities", type=int, default=4)
    parser.add_argument("--resolution", default="256x384")
    parser.add_argument("--antialias", type=int, default=2)
    arguments = parser.parse_args()
    cameras = nominal_rig(13, parse_resolution(arguments.resolution), seed=0)
    head_template()
    totals = np.zeros(3)
    for index in range(arguments.identities):
        head, build = _timed(partial(build_head, 0, index))
        renderer = HeadRenderer(head)
        for view in cameras:
            view_of = (view.camera, view.camera_from_rig)
            renderer.render(*view_of, arguments.antialias)  # fills the cache of lens directions
            _, render = _timed(lambda: renderer.render(*view_of, arguments.antialias))  # noqa: B023
            rays = pixel_rays(*view_of, 0, view.camera.height, arguments.antialias)
            _, cast = _timed(lambda: head.scene.cast_rays(rays, nthreads=1))  # noqa: B023
            totals += (0.0, render, cast)
        totals[0] += build
        print(f"identity {index}: {head.parameters['hair_style']:10s} build {build:.2f} s")
    build, render, cast = totals / (arguments.identities * np.array([1, 13, 13]))
    print(f"head: {build:.2f} CPU s")
    print(f"image: {render:.3f} CPU s, of which bare ray casting {cast:.3f} ({render / cast:.1f}x)")
    print(f"per image with its share of the head, 13 views: {render + build / 13:.3f} CPU s")


Result = TypeVar("Result")


def _timed(work: Callable[[], Result]) -> tuple[Result, float]:
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


if __name__ == "__main__":
    main()
