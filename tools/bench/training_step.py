"""How fast a training step of the prior is on one processor core, against the same model written plainly.

    python tools/bench/training_step.py --output step.json

Rays per second of processor time for forward and backward (the optimizer's step is not counted), the best of
several repeats, on one thread: the figure of a loaded machine is then too low, but not by how long a step waits.
All rays meet the box. Rows, per preset:

    concatenated   the paper's form in plain PyTorch: codes and encodings concatenated, `coord`'s encoding, MKL
    factored       ours, the same products by the same library
    route          ours, by the library that `preface.model.matmul` chooses
    bf16           ours, bfloat16 products

The share is that of the matmul peak of the row's precision, measured in the same run. The largest differences of
colours between the first two rows are printed too.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from preface.model import coord, losses, stepfun, volume
from preface.model.configuration import PRESETS, ModelConfig, preset
from preface.model.matmul import choose_route, denormals_flushed, keep_freed_memory, measure_route
from preface.model.model import PriorModel
from preface.model.rays import Rays
from preface.model.training.progress import train_flops_per_ray

CHUNK = {"paper": 32, "studio": 64, "small": 256, "tiny": 512}
SMALLEST_RADIUS = 0.012  # scene units: 96x144 pixels on a head of two units
RAYS_PER_VIEW = 32

Levels = list[tuple[Tensor, Tensor]]


def some_rays(count: int) -> Rays:
    """Rays of a camera at distance 3 that cross the unit box."""
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor([0.0, 0.0, 3.0]).expand(count, 3).contiguous()
    directions = torch.cat([torch.rand(count, 2, generator=generator) * 0.6 - 0.3, -torch.ones(count, 1)], 1)
    viewdirs = directions / directions.norm(dim=-1, keepdim=True)
    column = torch.ones(count, 1)
    return Rays(origins, directions, viewdirs, 0.004 * column, 2 * column, 4 * column)


def factored(model: PriorModel, rays: Rays, views: int, jitter: Tensor) -> tuple[Tensor, Levels]:
    """Colours and rounds of our model."""
    rendered = model(rays, model.codes[:views], train_frac=0.5, jitter=jitter)
    return rendered.rgb, [(level.sdist, level.weights) for level in rendered.levels]


def concatenated(model: PriorModel, rays: Rays, views: int, jitter: Tensor) -> tuple[Tensor, Levels]:
    """The same with the parameters in the paper's form."""
    config, levels = model.config, []
    codes = model.codes[:views].repeat_interleave(len(rays) // views, dim=0)
    sdist, weights, expected = (
        torch.cat([0 * rays.near, 0 * rays.far + 1], -1),
        torch.ones_like(rays.near),
        1.0,
    )
    for index, samples in enumerate(config.samples):
        with torch.no_grad():
            if index:
                dilation = config.dilation_bias + config.dilation_multiplier * expected
                sdist, weights = stepfun.max_dilate_weights(sdist, weights, dilation, (0.0, 1.0), True)
                sdist, weights = sdist[..., 1:-1], weights[..., 1:-1]
            logits = stepfun.resampling_logits(sdist, weights, stepfun.anneal_exponent(0.5))
            sdist = stepfun.sample_intervals(sdist, logits, samples, jitter[:, index : index + 1], (0.0, 1.0))
        expected /= samples
        tdist = rays.near + sdist * (rays.far - rays.near)
        mean, var = coord.project_frustums(rays.origins, rays.directions, tdist, rays.radii, model.basis)
        encoded = coord.integrated_pos_enc(mean, var, 0, model.levels)
        last = index == len(config.samples) - 1
        network = model.nerf if last else model.proposal
        code = codes[:, None].expand(-1, samples, -1)
        features = encoded
        for number, layer in enumerate(network.layers):
            weight = layer.concatenated()  # type: ignore[operator]
            features = torch.cat([features, code], dim=-1)
            features = torch.relu(torch.nn.functional.linear(features, weight, layer.bias))  # type: ignore[arg-type]
            if number == network.skip:
                features = torch.cat([features, encoded], dim=-1)
        features = torch.cat([features, code], dim=-1)
        head = network.density
        raw = torch.nn.functional.linear(features, head.concatenated(), head.bias)[..., 0]
        weights = volume.compute_alpha_weights(volume.density_from_raw(raw), tdist, rays.directions)[0]
        levels.append((sdist, weights))
    nerf = model.nerf
    seen = torch.nn.functional.linear(features, nerf.bottleneck.concatenated(), nerf.bottleneck.bias)
    view = coord.pos_enc(rays.viewdirs, 0, config.view_levels)[:, None].expand(-1, config.samples[-1], -1)
    rgb = nerf.color(torch.relu(nerf.view(torch.cat([seen, view], -1))))
    return volume.composite(weights, volume.color_from_raw(rgb)), levels


def train_step(form: Callable, model: PriorModel, rays: Rays, views: int, jitter: Tensor) -> Tensor:
    """Forward and backward; the colours."""
    model.zero_grad()
    rgb, levels = form(model, rays, views, jitter)
    (sdist, weights), proposals = levels[-1], levels[:-1]
    loss = losses.l1(rgb, torch.full_like(rgb, 0.5)) + losses.interlevel(sdist, weights, proposals)
    loss.backward()
    return rgb.detach()


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Processor time of the fastest of some calls, after one to warm up."""
    call()
    best = float("inf")
    for _ in range(repeats):
        started = time.process_time()
        call()
        best = min(best, time.process_time() - started)
    return best


def bench(name: str, config: ModelConfig, rays_per_chunk: int, repeats: int) -> list[dict]:
    """All rows of one preset."""
    torch.manual_seed(0)
    views = max(rays_per_chunk // RAYS_PER_VIEW, 1)
    exact = PriorModel(dataclasses.replace(config, matmul="fp32"), max(views, 1))
    reduced = PriorModel(dataclasses.replace(config, matmul="bf16"), max(views, 1))
    reduced.load_state_dict(exact.state_dict())
    rays, jitter = some_rays(rays_per_chunk), torch.rand(rays_per_chunk, len(config.samples))
    mkl, best, half = measure_route("mkl"), choose_route("fp32"), choose_route("bf16")
    rows: list[dict[str, Any]] = []
    plain = None
    for label, form, model, route in (
        ("concatenated", concatenated, exact, mkl),
        ("factored", factored, exact, mkl),
        ("route", factored, exact, best),
        ("bf16", factored, reduced, half),
    ):
        route.apply()
        taken = seconds(lambda: train_step(form, model, rays, views, jitter), repeats)  # noqa: B023
        rgb = train_step(form, model, rays, views, jitter)
        plain = rgb if plain is None else plain
        flops = train_flops_per_ray(model) * rays_per_chunk / taken / 1e9
        rows.append(
            {
                "preset": name,
                "form": label,
                "products": route.name,
                "rays_per_cpu_second": rays_per_chunk / taken,
                "against_concatenated": 1.0,
                "gflops": flops,
                "share_of_peak": flops / route.gflops,
                "rgb_off": float((rgb - plain).abs().max()),
            }
        )
    for row in rows:
        row["against_concatenated"] = row["rays_per_cpu_second"] / rows[0]["rays_per_cpu_second"]
    return rows


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    lines = [
        "| preset | form | products | rays per CPU-second | against concatenated | share of peak | rgb off |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['preset']} | {row['form']} | {row['products']} | {row['rays_per_cpu_second']:.4g} | "
            f"{row['against_concatenated']:.2f} | {row['share_of_peak']:.2f} | {row['rgb_off']:.1e} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["paper", "small", "tiny"], choices=list(PRESETS))
    parser.add_argument("--repeats", type=int, default=5, help="of which the fastest counts")
    parser.add_argument("--rays", type=int, help="per step; by default what suits the preset")
    parser.add_argument("--output", type=Path, default=Path("training_step.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    rows = []
    for name in options.presets:
        config = preset(name).resolved(SMALLEST_RADIUS)
        with denormals_flushed():
            rows += bench(name, config, options.rays or CHUNK[name], options.repeats)
    options.output.write_text(json.dumps({"torch": torch.__version__, "rows": rows}, indent=2) + "\n")
    print(table(rows))
    print(options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
