"""What regularised normals cost a step of finetuning on one processor core, and that their short way is exact.

    python tools/bench/normals_step.py --output normals.json

Normals are gradients of the density by position, and their loss takes gradients of these. Rows, per preset, processor
seconds for forward and backward of the same rays, the best of several repeats on one thread:

    without        no normals
    autograd       the density differentiated through sines and exponentials, by `coord.integrated_pos_enc`
    ours           the density differentiated by the encoding, see `encoding.slope_in_space`

and the largest differences between the last two: of normals, and of the gradients of all weights, as a share of the
largest gradient.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.training_step import CHUNK, SMALLEST_RADIUS, seconds, some_rays
from preface.cli.usage import Parser
from preface.model import coord, losses
from preface.model.configuration import PRESETS, ModelConfig, preset
from preface.model.matmul import choose_route, denormals_flushed, keep_freed_memory
from preface.model.model import PriorModel, Render
from preface.model.rays import Rays


class ThroughTheWaves(PriorModel):
    """The model, whose normals are found by automatic differentiation of the whole encoding."""

    def _final(
        self, rays: Rays, tdist: Tensor, biases: Sequence[Tensor], normals: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        mean, var = coord.project_frustums(rays.origins, rays.directions, tdist, rays.radii, self.basis)
        mean.requires_grad_()
        encoded = coord.integrated_pos_enc(mean, var, 0, self.levels).flatten(0, 1)
        features = self.nerf.trunk(encoded, biases, self.products)
        raw = self.nerf.raw_density(features, biases[len(self.nerf.layers)])
        (slope,) = torch.autograd.grad(raw.sum(), mean, create_graph=True)
        in_space = (slope[..., None, :] * self.basis).sum(dim=-1)
        return features, raw, losses.normals_from_density_gradient(in_space)


def step(model: PriorModel, rays: Rays, normals: bool) -> Render:
    """Forward and backward of colours, and of predicted normals if they are there."""
    model.zero_grad()
    rendered = model(rays, model.codes, normals=normals)
    loss = losses.l1(rendered.rgb, torch.full_like(rendered.rgb, 0.5))
    if normals:
        assert rendered.normals is not None
        assert rendered.normals_pred is not None
        weights = rendered.levels[-1].weights
        loss = loss + losses.predicted_normal(weights, rendered.normals, rendered.normals_pred)
    loss.backward(inputs=list(model.parameters()))
    return rendered


def bench(name: str, config: ModelConfig, count: int, repeats: int) -> dict[str, Any]:
    """The row of a preset."""
    torch.manual_seed(0)
    ours = PriorModel(dataclasses.replace(config, matmul="fp32", predicted_normals=True), 1)
    through = ThroughTheWaves(ours.config, 1)
    through.load_state_dict(ours.state_dict())
    choose_route("fp32", width=ours.nerf.width).apply()
    rays = some_rays(count)
    taken = {
        "without": seconds(lambda: step(ours, rays, False), repeats),
        "autograd": seconds(lambda: step(through, rays, True), repeats),
        "ours": seconds(lambda: step(ours, rays, True), repeats),
    }
    one, other = step(ours, rays, True).normals, step(through, rays, True).normals
    assert one is not None
    assert other is not None
    pairs = [(a.grad, b.grad) for a, b in zip(ours.parameters(), through.parameters(), strict=True)]
    gradients = [(a, b) for a, b in pairs if a is not None and b is not None]
    largest = max(float(b.abs().max()) for _, b in gradients)
    return {
        "preset": name,
        "rays": count,
        "cpu_s": taken,
        "autograd_over_ours": taken["autograd"] / taken["ours"],
        "ours_over_without": taken["ours"] / taken["without"],
        "normals_off": float((one - other).detach().abs().max()),
        "gradients_off": max(float((a - b).abs().max()) for a, b in gradients) / largest,
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = [
        "| preset | autograd over ours | ours over none | normals off | gradients off |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['preset']} | {row['autograd_over_ours']:.2f} | {row['ours_over_without']:.2f} "
        f"| {row['normals_off']:.1e} | {row['gradients_off']:.1e} |"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> int:
    """Run the benchmark."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["paper", "small", "tiny"], choices=list(PRESETS))
    parser.add_argument("--repeats", type=int, default=5, help="of which the fastest counts")
    parser.add_argument("--output", type=Path, default=Path("normals_step.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    with denormals_flushed():
        rows = [
            bench(name, preset(name).resolved(SMALLEST_RADIUS), CHUNK[name], options.repeats)
            for name in options.presets
        ]
    options.output.write_text(json.dumps({"torch": torch.__version__, "rows": rows}, indent=2) + "\n")
    print(table(rows))
    print(options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
