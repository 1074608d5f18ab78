"""The front of what is measured, and the rules by which qualities are chosen from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

LEAST_TIMES = 5.0  # as fast as the model as trained, that `balanced` has to be
LARGEST_LOSS = 0.1  # dB to the photographs, that it may lose against it
DRAFT_LOSS = 0.3  # the same of `draft`
MOST = 100.0  # dB, of images that are equal
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

    `reference`: the model as trained. `balanced`: what is nearest to it of all that is at least 5 times as fast and at
    most 0.1 dB lower to the photographs. `draft`: the cheapest on the front to the photographs that loses at most 0.3
    dB to them.
    """
    ours = [p for p in points if p["settings"]["model"] == 0 and p["group"] != "fullest"]
    reference = next(p for p in ours if p["group"] == "reference")

    def losing(loss: float) -> list[Measured]:
        return [p for p in ours if p["psnr"] >= reference["psnr"] - loss]

    fast = [p for p in losing(LARGEST_LOSS) if cost(reference, images) >= LEAST_TIMES * cost(p, images)]
    balanced = max(fast, key=lambda p: float(p["psnr_to_trained"]), default=None)
    on_front = front(ours, images, "psnr")
    draft = min(
        (p for p in losing(DRAFT_LOSS) if p["name"] in on_front), key=lambda p: cost(p, images), default=None
    )
    return {
        "draft": None if draft is None else draft["name"],
        "balanced": None if balanced is None else balanced["name"],
        "reference": reference["name"],
    }
