"""How fast a training step of the prior is, against the same model written plainly.

    python tools/bench/training_step.py --output step.json
    python tools/bench/training_step.py --device cuda --presets paper --compile --output step.json

Rays per second for forward and backward (the optimizer's step is not counted), the best of several repeats. On a
CPU they are of processor time, on one thread: the figure of a loaded machine is then too low, but not by how long a
step waits. On CUDA they are of a clock, with the device waited for, and a step has 65,536 rays that go through the
networks some at a time, as in training. All rays meet the box. Rows, per preset:

    concatenated     the paper's form in plain PyTorch: codes and encodings concatenated, `coord`'s encoding, MKL
    factored         ours, the same products by the same library
    route            ours, by the library that `preface.model.matmul` chooses; on a CPU only
    bf16             ours, bfloat16 products
    ..., compiled    the last of each precision once more, by torch.compile (`--compile`)

The share is that of the matmul peak of the row's precision, measured in the same run. The largest differences of
colours from those of the first row are printed too.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from preface.cli.usage import Parser
from preface.model import coord, losses, stepfun, volume
from preface.model.configuration import PRESETS, ModelConfig, preset
from preface.model.matmul import Route, choose_route, denormals_flushed, keep_freed_memory, measure_route
from preface.model.model import PriorModel
from preface.model.rays import Rays
from preface.model.training.progress import train_flops_per_ray

CHUNK = {"paper": 32, "studio": 64, "small": 256, "tiny": 512}
CPU = torch.device("cpu")
RATE = {"cpu": "rays_per_cpu_second", "cuda": "rays_per_second"}
CUDA_RAYS, CUDA_MICRO_RAYS = (
    65_536,
    2_048,
)  # the paper's step, and what a GPU of 80 GB takes in the plain form
CUDA_PEAK_WIDTH = 4096  # of the product whose speed counts as a GPU's peak; smaller ones do not fill it
SMALLEST_RADIUS = 0.012  # scene units: 96x144 pixels on a head of two units
RAYS_PER_VIEW = 32

Form = Callable[[PriorModel, Rays, Tensor, Tensor], tuple[Tensor, "Levels"]]
Levels = list[tuple[Tensor, Tensor]]


def some_rays(count: int) -> Rays:
    """Rays of a camera at distance 3 that cross the unit box."""
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor([0.0, 0.0, 3.0]).expand(count, 3).contiguous()
    directions = torch.cat([torch.rand(count, 2, generator=generator) * 0.6 - 0.3, -torch.ones(count, 1)], 1)
    viewdirs = directions / directions.norm(dim=-1, keepdim=True)
    column = torch.ones(count, 1)
    return Rays(origins, directions, viewdirs, 0.004 * column, 2 * column, 4 * column)


def views_of(rays: int) -> int:
    """How many views, and codes, a step's rays are of."""
    return max(rays // RAYS_PER_VIEW, 1)


def factored(model: PriorModel, rays: Rays, codes: Tensor, jitter: Tensor) -> tuple[Tensor, Levels]:
    """Colours and rounds of our model; codes [g, latent] of equal runs of rays."""
    rendered = model(rays, codes, train_frac=0.5, jitter=jitter)
    return rendered.rgb, [(level.sdist, level.weights) for level in rendered.levels]


def concatenated(model: PriorModel, rays: Rays, codes: Tensor, jitter: Tensor) -> tuple[Tensor, Levels]:
    """The same with the parameters in the paper's form."""
    config, levels = model.config, []
    codes = codes.repeat_interleave(len(rays) // len(codes), dim=0)
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


def train_step(form: Form, model: PriorModel, rays: Rays, jitter: Tensor, micro_rays: int) -> Tensor:
    """Forward and backward of a step whose rays go through the networks some at a time; the colours."""
    model.zero_grad()
    group, found = len(rays) // len(model.codes), []
    for first in range(0, len(rays), micro_rays):
        some = slice(first, first + micro_rays)
        codes = model.codes[first // group : -(-(first + micro_rays) // group)]
        rgb, levels = form(model, rays[some], codes, jitter[some])
        (sdist, weights), proposals = levels[-1], levels[:-1]
        loss = losses.l1(rgb, torch.full_like(rgb, 0.5)) + losses.interlevel(sdist, weights, proposals)
        (loss * (len(rgb) / len(rays))).backward()
        found.append(rgb.detach())
    return torch.cat(found)


def seconds(call: Callable[[], object], repeats: int, device: torch.device = CPU) -> float:
    """Time of the fastest of some calls, after one to warm up: of the processor, or by a clock for a device."""
    call()
    best = float("inf")
    for _ in range(repeats):
        started = _now(device)
        call()
        best = min(best, _now(device) - started)
    return best


def _now(device: torch.device) -> float:
    if device.type == "cpu":
        return time.process_time()
    torch.cuda.synchronize(device)
    return time.perf_counter()


@dataclasses.dataclass(frozen=True)
class Work:
    """What a step is: its rays, how many of them at a time, how often it is repeated, where, and by which compiler."""

    rays: int
    micro_rays: int
    repeats: int
    device: torch.device
    compiler: str | None


def forms(exact: PriorModel, reduced: PriorModel, work: Work) -> list[tuple[str, Form, PriorModel, Route]]:
    """Label, form, model and products of each row."""
    if work.device.type == "cpu":
        mkl, best = measure_route("mkl"), choose_route("fp32")
        half = choose_route("bf16")
        found: list[tuple[str, Form, PriorModel, Route]] = [
            ("concatenated", concatenated, exact, mkl),
            ("factored", factored, exact, mkl),
            ("route", factored, exact, best),
        ]
    else:
        best, half = (choose_route(name, work.device, CUDA_PEAK_WIDTH) for name in ("fp32", "bf16"))
        found = [("concatenated", concatenated, exact, best), ("factored", factored, exact, best)]
    found.append(("bf16", factored, reduced, half))
    for label, form, model, route in found[-2:] if work.compiler else []:
        found.append((f"{label}, compiled", compiled(form, model, str(work.compiler)), model, route))
    return found


def compiled(form: Form, model: PriorModel, compiler: str) -> Form:
    """A form with the model compiled."""
    quick = torch.compile(model, backend=compiler)
    return lambda _, *arguments: form(quick, *arguments)  # type: ignore[arg-type]


def bench(name: str, config: ModelConfig, work: Work) -> list[dict]:
    """All rows of one preset."""
    torch.manual_seed(0)
    views = views_of(work.rays)
    exact = PriorModel(dataclasses.replace(config, matmul="fp32"), views)
    reduced = PriorModel(dataclasses.replace(config, matmul="bf16"), views)
    reduced.load_state_dict(exact.state_dict())
    exact, reduced = exact.to(work.device), reduced.to(work.device)
    rays = some_rays(work.rays).to(work.device)
    jitter = torch.rand(work.rays, len(config.samples)).to(work.device)
    rows: list[dict[str, Any]] = []
    plain = None
    for label, form, model, route in forms(exact, reduced, work):
        route.apply()

        def step(form: Form = form, model: PriorModel = model) -> Tensor:
            return train_step(form, model, rays, jitter, work.micro_rays)

        taken = seconds(step, work.repeats, work.device)
        rgb = step()
        plain = rgb if plain is None else plain
        flops = train_flops_per_ray(model) * work.rays / taken / 1e9
        rows.append(
            {
                "preset": name,
                "form": label,
                "products": route.name,
                RATE[work.device.type]: work.rays / taken,
                "against_concatenated": taken,
                "gflops": flops,
                "share_of_peak": flops / route.gflops,
                "rgb_off": float((rgb - plain).abs().max()),
            }
        )
    for row in reversed(rows):
        row["against_concatenated"] = rows[0]["against_concatenated"] / row["against_concatenated"]
    return rows


def table(rows: list[dict], device: torch.device) -> str:
    """The rows as Markdown."""
    rate = RATE[device.type]
    per = rate.replace("_", " ").replace("cpu second", "CPU-second")
    lines = [
        f"| preset | form | products | {per} | against concatenated | share of peak | rgb off |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['preset']} | {row['form']} | {row['products']} | {row[rate]:.4g} | "
            f"{row['against_concatenated']:.2f} | {row['share_of_peak']:.2f} | {row['rgb_off']:.1e} |"
        )
    return "\n".join(lines)


def work_of(options: argparse.Namespace, preset: str) -> Work:
    """What was asked for, of a preset.

    Raises:
        ValueError: rays that cannot be shared out.
    """
    on_cpu = options.device == "cpu"
    rays = options.rays or (CHUNK[preset] if on_cpu else CUDA_RAYS)
    micro = min(options.micro_rays or (rays if on_cpu else CUDA_MICRO_RAYS), rays)
    views = views_of(rays)
    if rays % views or rays % micro or micro % (rays // views):
        raise ValueError(
            f"--rays {rays} --micro-rays {micro}: give multiples of {RAYS_PER_VIEW}, the first of the second"
        )
    return Work(rays, micro, options.repeats, torch.device(options.device), options.compile)


def arguments() -> argparse.ArgumentParser:
    """What can be asked for."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["paper", "small", "tiny"], choices=list(PRESETS))
    parser.add_argument("--device", choices=list(RATE), default="cpu", help="where (default: cpu)")
    parser.add_argument("--repeats", type=int, default=5, help="of which the fastest counts")
    parser.add_argument(
        "--rays", type=int, help="per step; by default what suits the preset, or 65,536 on cuda"
    )
    parser.add_argument("--micro-rays", type=int, help="at a time; by default all, or 2,048 on cuda")
    compiler = "add rows with torch.compile (default backend: inductor)"
    parser.add_argument("--compile", nargs="?", const="inductor", metavar="BACKEND", help=compiler)
    parser.add_argument("--output", type=Path, default=Path("training_step.json"))
    return parser


def main(given: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = arguments()
    options = parser.parse_args(given)
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: this PyTorch sees no CUDA device")
    try:
        works = {name: work_of(options, name) for name in options.presets}
    except ValueError as error:
        parser.error(str(error))
    torch.set_num_threads(1)
    keep_freed_memory()
    rows = []
    for name, work in works.items():
        config = preset(name).resolved(SMALLEST_RADIUS)
        with denormals_flushed():
            rows += bench(name, config, work)
    device = torch.device(options.device)
    written = {"torch": torch.__version__, "device": machine(device), "rows": rows}
    options.output.write_text(json.dumps(written, indent=2) + "\n")
    print(table(rows, device))
    print(options.output)
    return 0


def machine(device: torch.device) -> str:
    """What the figures are of."""
    return "cpu" if device.type == "cpu" else torch.cuda.get_device_name(device)


if __name__ == "__main__":
    sys.exit(main())
