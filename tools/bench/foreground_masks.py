"""How right the foreground masks are, by method, against masks that are known, and what they cost.

    python tools/bench/foreground_masks.py --studio STUDIO --portrait FOLDER --identities 8 --output masks.json

STUDIO is what `python tools/synthetic_studio` writes: its true coverage is the truth. FOLDER holds ``images/`` and
``matte/`` with equal names. Each method that suits a take is measured on it; clean plates are put together from what
the studio's people leave uncovered. Printed as a Markdown table and written as JSON:

- IoU of the masks cut at one half, its mean and its worst;
- soft IoU: sum of the minima over the sum of the maxima of the coverages;
- boundary: mean distance in pixels between the two outlines, both ways;
- band: mean error of the coverage within 3 pixels of the true outline;
- CPU seconds per megapixel, the minimum over the images, of this process's one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from preface.artifacts import write_bytes
from preface.capture.foreground import Hints, Segmenter, make_segmenter
from preface.capture.images import read_image
from preface.capture.manifest import Capture, read_capture
from preface.cli.usage import Parser

BAND = 3  # pixels


@dataclass(frozen=True)
class View:
    """A photograph with its true coverage and a clean plate, where there is one."""

    name: str
    pixels: np.ndarray
    truth: np.ndarray
    plate: np.ndarray | None


def main() -> None:
    """Measure, print and write."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studio", type=Path, help="a synthetic studio")
    parser.add_argument("--portrait", type=Path, help="a folder with images/ and matte/")
    parser.add_argument("--identities", type=int, default=8, help="of each take")
    parser.add_argument("--cameras", type=int, default=4, help="spread over the rig")
    parser.add_argument("--output", type=Path, help="the figures as JSON")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rows = []
    if arguments.studio:
        capture = read_capture(arguments.studio / "capture")
        for take in capture.manifest.takes:
            views = list(
                studio_views(arguments.studio, capture, take.id, arguments.identities, arguments.cameras)
            )
            methods = (take.background, "plate", "selfie")
            rows += [measure(f"studio, {take.background}", method, views) for method in methods]
    if arguments.portrait:
        rows.append(measure("portrait", "selfie", list(portrait_views(arguments.portrait))))
    print(markdown(rows))
    if arguments.output:
        print(write_bytes(arguments.output, json.dumps(rows, indent=1).encode()))


def studio_views(root: Path, capture: Capture, take: str, identities: int, cameras: int) -> Iterator[View]:
    """Photographs of a studio, some people by some cameras."""
    people = [subject.id for subject in capture.manifest.subjects if subject.take == take]
    names = [camera.id for camera in capture.manifest.cameras]
    people, names = (spread(found, count) for found, count in ((people, identities), (names, cameras)))
    for camera in names:
        pixels = [read_image(capture.images[person, camera]) for person in people]
        truths = [
            read_image(root / "truth/identities" / person / f"mask/{camera}.png")[..., 0] / np.float32(65535)
            for person in people
        ]
        plate = plate_of(pixels, truths)
        for person, image, truth in zip(people, pixels, truths, strict=True):
            yield View(f"{person} {camera}", image, truth, plate)


def portrait_views(folder: Path) -> Iterator[View]:
    """Photographs and their mattes."""
    for path in sorted((folder / "images").glob("*.png")):
        matte = read_image(folder / "matte" / path.name)[..., 0] / np.float32(255)
        yield View(path.stem, read_image(path), matte, None)


def spread(names: Sequence[str], count: int) -> list[str]:
    """So many of the names, evenly."""
    return [
        names[i] for i in sorted({round(i) for i in np.linspace(0, len(names) - 1, min(count, len(names)))})
    ]


def plate_of(images: Sequence[np.ndarray], truths: Sequence[np.ndarray]) -> np.ndarray:
    """The background of a camera: one of the photographs that show it there, and their mean where none does."""
    plate = np.zeros_like(images[0])
    known = np.zeros(plate.shape[:2], bool)
    for image, truth in zip(images, truths, strict=True):
        free = (cv2.dilate(truth, np.ones((5, 5))) == 0) & ~known
        plate[free] = image[free]
        known |= free
    plate[~known] = np.median(plate[known], axis=0).astype(plate.dtype)
    return plate


def measure(data: str, method: str, views: Sequence[View]) -> dict[str, float | str | int]:
    """The figures of a method on some photographs."""
    segmenter = make_segmenter(method)
    figures, seconds = [], []
    for view in views:
        alpha, cost = timed(segmenter, view.pixels, Hints(plate=view.plate if method == "plate" else None))
        figures.append(compare(alpha, view.truth))
        seconds.append(cost / (view.truth.size / 1e6))
    table = np.array(figures)
    worst = int(np.argmin(table[:, 0]))
    return {
        "data": data,
        "method": method,
        "photographs": len(views),
        "iou": float(table[:, 0].mean()),
        "worst iou": float(table[worst, 0]),
        "worst": views[worst].name,
        "soft iou": float(table[:, 1].mean()),
        "boundary px": float(table[:, 2].mean()),
        "band error": float(table[:, 3].mean()),
        "cpu s per megapixel": min(seconds),
    }


def timed(segmenter: Segmenter, pixels: np.ndarray, hints: Hints) -> tuple[np.ndarray, float]:
    """A photograph's coverage, and the CPU seconds it took."""
    begin = time.process_time()
    found = segmenter(pixels, hints)
    return found.alpha, time.process_time() - begin


def compare(alpha: np.ndarray, truth: np.ndarray) -> tuple[float, float, float, float]:
    """IoU, soft IoU, boundary distance in pixels and mean error in the band."""
    found, true = alpha >= 0.5, truth >= 0.5
    union = max(int((found | true).sum()), 1)
    soft = float(np.minimum(alpha, truth).sum() / max(float(np.maximum(alpha, truth).sum()), 1e-9))
    edges = outline(found), outline(true)
    distances = [to_nearest(edges[0], edges[1]), to_nearest(edges[1], edges[0])]
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BAND + 1, 2 * BAND + 1))
    band = cv2.dilate(edges[1].astype(np.uint8), kernel) > 0
    error = float(np.abs(alpha - truth)[band].mean()) if band.any() else 0.0
    return float((found & true).sum() / union), soft, float(np.mean(distances)), error


def outline(mask: np.ndarray) -> np.ndarray:
    """The pixels of a mask that have a neighbour outside it."""
    return mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)


def to_nearest(places: np.ndarray, others: np.ndarray) -> float:
    """Mean distance in pixels from some pixels to the nearest of others."""
    if not places.any() or not others.any():
        return float(np.hypot(*places.shape)) if places.any() != others.any() else 0.0
    distance = cv2.distanceTransform((~others).astype(np.uint8), cv2.DIST_L2, 5)
    return float(distance[places].mean())


def markdown(rows: Sequence[dict[str, float | str | int]]) -> str:
    """A table."""
    names = list(rows[0]) if rows else []
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for row in rows:
        cells = [f"{value:.4f}" if isinstance(value, float) else str(value) for value in row.values()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
