"""The front of what is measured, and the rules by which qualities are chosen from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

LEAST_TO_FULL = 45.0  # dB, what `balanced` has to reach
LARGEST_LOSS = 0.1  # dB to the photographs, that `balanced` may lose against the model as trained
DRAFT_LOSS = 0.3  # the same of `draft`
IMAGES = 24  # of a head, that share what is prepared for it
Measured = Mapping[str, Any]


def cost(point: Measured, images: int) -> float:
    """CPU seconds of an image, if so many of them share what is prepared for a head."""
    return float(point["prepare_cpu_s"]) / images + float(point["cpu_us_per_ray"]) * point["rays"] / 1e6


def front(points: Sequence[Measured], images: int, figure: str) -> list[str]:
    """Names of the points to which no other is both cheaper and better, from the cheapest."""
    best, names = -float("inf"), []
    for point in sorted(points, key=lambda p: (cost(p, images), -p[figure])):
        if point[figure] > best:
            best = point[figure]
            names.append(str(point["name"]))
    return names


def chosen(points: Sequence[Measured], images: int) -> dict[str, str | None]:
    """Names by quality, of points of the first model on a front; None where no point will do.

    `reference`: the model as trained. `balanced`: the cheapest on the front to the fullest render that is at least 45
    dB from it at every view, and at most 0.1 dB lower to the photographs than the reference. `draft`: the cheapest on
    the front to the photographs that loses at most 0.3 dB to them.
    """
    ours = [p for p in points if p["settings"]["model"] == 0 and p["group"] != "fullest"]
    reference = next(p for p in ours if p["group"] == "reference")

    def cheapest(figure: str, loss: float, least: float) -> str | None:
        names = front(ours, images, figure)
        fit = [
            p for p in ours
            if p["name"] in names and p["psnr"] >= reference["psnr"] - loss and p["lowest_psnr_to_full"] >= least
        ]  # fmt: skip
        return min(fit, key=lambda p: cost(p, images))["name"] if fit else None

    return {
        "draft": cheapest("psnr", DRAFT_LOSS, 0.0),
        "balanced": cheapest("psnr_to_full", LARGEST_LOSS, LEAST_TO_FULL),
        "reference": reference["name"],
    }
