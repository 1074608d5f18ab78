"""What an evaluation costs, with normals and without them, by quality, and how far a quality moves its figures.

    python tools/bench/evaluation_choices.py SHARDS MODEL --people id0000 id0012 --output evaluation.json

MODEL is a head or a prior, or `pretrained`; it is evaluated at the views that it has not seen. CPU seconds are of one
thread, per view, without LPIPS, whose cost does not depend on how a head is rendered; so are the figures. The choices
are compared with the first, `reference` with normals, which is what `preface-evaluate` does unless told otherwise:
`psnr_off` is the largest difference of a view's PSNR. Prints a table and writes JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from preface.artifacts import provenance, write_bytes
from preface.cli.output import exit_status
from preface.cli.usage import Parser
from preface.model.evaluation.evaluate import Evaluation, evaluate_head
from preface.model.evaluation.options import EvaluationOptions
from preface.model.matmul import denormals_flushed, keep_freed_memory
from preface.model.pretrained import prior_flag
from preface.model.rendering.shortcuts import QUALITIES
from preface.model.training.prior_files import Prior, read_prior
from preface.shards import Dataset


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the bench and return its exit status."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shards", type=Path)
    parser.add_argument("model", type=prior_flag)
    parser.add_argument("--people", nargs="+", help="identities (default: the first of the model)")
    parser.add_argument("--output", type=Path, default=Path("evaluation.json"))
    options = parser.parse_args(arguments)
    return exit_status(lambda: measure(options), parser, parser.prog, lambda: (OSError,))


def measure(options: argparse.Namespace) -> list[str]:
    """Measure every choice, print the table, write the JSON."""
    torch.set_num_threads(1)
    keep_freed_memory()
    prior, rows, usual = read_prior(options.model), [], None
    people = options.people or list(prior.identities[:1])
    with denormals_flushed(), Dataset(options.shards) as dataset:
        evaluated(prior, dataset, people[:1], EvaluationOptions(lpips="none", quality="draft"))  # warms up
        for quality in reversed(QUALITIES):
            for normals in (True, False):
                began = time.process_time()
                choice = EvaluationOptions(lpips="none", quality=quality, normals=normals)
                found = evaluated(prior, dataset, people, choice)
                seconds = time.process_time() - began
                usual = found if usual is None else usual
                rows.append({"quality": quality, "normals": normals, **compared(found, usual, seconds)})
        size = f"{dataset.manifest.width}x{dataset.manifest.height}"
    settings = {"people": people, "size": size}
    content: dict[str, Any] = {**settings, "rows": rows, "provenance": provenance(settings, {})}
    print(markdown(rows))
    return [str(write_bytes(options.output, (json.dumps(content, indent=1) + "\n").encode()))]


def evaluated(
    prior: Prior, dataset: Dataset, people: Sequence[str], options: EvaluationOptions
) -> list[Evaluation]:
    """Each person at the views that the model has not seen."""
    return [evaluate_head(prior, dataset, person, None, options) for person in people]


def compared(found: Sequence[Evaluation], usual: Sequence[Evaluation], seconds: float) -> dict[str, Any]:
    """Figures of a choice, and how far they are from the usual ones."""
    ours, theirs = (
        [view.figures.values["psnr"] for e in some for view in e.views] for some in (found, usual)
    )
    return {
        "views": len(ours),
        "cpu_s_per_view": seconds / len(ours),
        "psnr": sum(ours) / len(ours),
        "psnr_off": max(abs(one - other) for one, other in zip(ours, theirs, strict=True)),
    }


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """A table."""
    lines = [
        "| quality | normals | views | CPU s per view | PSNR | largest difference, dB |",
        "|" + "---|" * 6,
    ]
    lines += [
        f"| {row['quality']} | {'yes' if row['normals'] else 'no'} | {row['views']} | {row['cpu_s_per_view']:.2f} "
        f"| {row['psnr']:.3f} | {row['psnr_off']:.3f} |"
        for row in rows
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
