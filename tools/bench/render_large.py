"""Memory and time of large images, and whether they depend on how they are cut.

    python tools/bench/render_large.py MODEL [--identity id0001] [--sides 512 1024 2048 4096] [--output large.json]

Each size is rendered by a process of its own, from the front, with the shortcuts of a quality: colour, opacity, depth
and normals. Peak memory is that of the process above what it held when the head was prepared. Of it, 32 bytes per
pixel are the image itself; the rest is what one call of the renderer and one strip of rays take, which must not grow
with the image. Images up to `--equal` are also rendered in one piece, by calls of 1000 rays, and by calls of a row and
seven pixels, and the largest differences of colours are printed. The same command goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from preface.cli.output import say
from preface.cli.usage import Parser
from preface.model.matmul import denormals_flushed, keep_freed_memory
from preface.model.pretrained import prior_flag
from preface.model.rendering.image import RenderedImage, RenderRays, Space, render_image, space_of
from preface.model.rendering.paths import framing_camera, on_sphere
from preface.model.rendering.shortcuts import DEFAULT_QUALITY, QUALITIES, accelerate
from preface.model.training.prior_files import read_prior

BYTES_PER_PIXEL = 32  # colour 12, opacity 4, depth 4, normals 12


@dataclass(frozen=True)
class Size:
    """An image to render: its side in pixels, and how."""

    model: str | Path
    identity: str | None
    side: int
    quality: str
    rays_at_a_time: int
    equal: bool


def measure(size: Size) -> dict[str, Any]:
    """Render one size, in this process."""
    torch.set_num_threads(1)
    keep_freed_memory()
    with denormals_flushed():
        prior = read_prior(size.model)
        model = prior.load_model().requires_grad_(False)
        space = space_of(prior)
        row = 0 if size.identity is None else prior.identities.index(size.identity)
        code = model.codes[row] if model.config.latent else None
        render = accelerate(model, code, space, QUALITIES[size.quality], normals=True)
        before, began = _peak_mib(), time.process_time()
        image = _image(render, space, size.side, size.rays_at_a_time)
        taken, peak = time.process_time() - began, _peak_mib() - before
        found: dict[str, Any] = {
            "side": size.side,
            "quality": size.quality,
            "rays_at_a_time": size.rays_at_a_time,
            "cpu_s": taken,
            "cpu_us_per_ray": taken / size.side**2 * 1e6,
            "peak_mib": peak,
            "pixels_mib": BYTES_PER_PIXEL * size.side**2 / 2**20,
        }
        if size.equal:
            cuts = {"one piece": size.side**2, "1000 rays": 1000, "a row and 7": size.side + 7}
            for name, rays in cuts.items():
                other = _image(render, space, size.side, rays)
                off = np.abs(other.rgb - image.rgb)
                found[f"{name}: largest difference"] = float(off.max())
                found[f"{name}: pixels that differ by half a grey value"] = int(
                    (off.max(axis=-1) > 0.5 / 255).sum()
                )
        return found


def _image(render: RenderRays, space: Space, side: int, rays_at_a_time: int) -> RenderedImage:
    camera = framing_camera(space.box.half_sides, 1.0, side, side)
    pose = on_sphere(space.box.center, 0.0, 0.0, 1.0)
    return render_image(render, space, camera, pose, rays_at_a_time=rays_at_a_time)


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown, with what is beyond the pixels themselves."""
    lines = [
        "| image | CPU s | us per ray | peak MiB | of it pixels | rest | largest difference by cut |",
        "|" + "---|" * 7,
    ]
    for row in rows:
        off = [f"{value:.1e}" for name, value in row.items() if name.endswith("largest difference")]
        lines.append(
            f"| {row['side']}x{row['side']} | {row['cpu_s']:.0f} | {row['cpu_us_per_ray']:.1f} | {row['peak_mib']:.0f} "
            f"| {row['pixels_mib']:.0f} | {row['peak_mib'] - row['pixels_mib']:.0f} | {', '.join(off)} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Run the benchmark."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=prior_flag)
    parser.add_argument("--identity")
    parser.add_argument("--sides", type=int, nargs="+", default=[512, 1024, 2048, 4096])
    parser.add_argument("--equal", type=int, default=512, help="largest side that is also cut otherwise")
    parser.add_argument("--quality", choices=list(QUALITIES), default=DEFAULT_QUALITY)
    parser.add_argument("--rays-at-a-time", type=int, default=4096)
    parser.add_argument("--output", type=Path, default=Path("render_large.json"))
    options = parser.parse_args()
    rows: list[dict[str, Any]] = json.loads(options.output.read_text()) if options.output.exists() else []
    for side in options.sides:
        size = Size(
            options.model,
            options.identity,
            side,
            options.quality,
            options.rays_at_a_time,
            side <= options.equal,
        )
        if any(row["side"] == side and row["quality"] == size.quality for row in rows):
            continue
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            rows.append(pool.submit(measure, size).result())
        options.output.write_text(json.dumps(rows, indent=2) + "\n")
        say(f"{side}x{side}: {rows[-1]['cpu_s']:.0f} CPU s, {rows[-1]['peak_mib']:.0f} MiB")
    print(table(rows))
    print(options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
