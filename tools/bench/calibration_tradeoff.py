"""What a faster calibration costs in accuracy: fewer frames, smaller images, another backend.

    python tools/bench/calibration_tradeoff.py [STUDIO] [--output tradeoff] [--frames 5 10 20 40 80]

STUDIO is a directory that `tools/synthetic_studio` wrote. Its board is detected

  full         searched for and refined at the images' own size
  search 1/n   searched for in images reduced n times, refined in the full ones (preface-calibrate's --search-side)
  images 1/n   in photographs that are n times smaller to begin with

and each take is calibrated from some of its frames, spread evenly, as `preface-calibrate board` does it; where
they are too few to choose a model by held-out ones, the true model is named, and a flat board. Without STUDIO,
and besides it, the same is done with simulated corners of the reference rig of `calibration_scene`, 2% of them
outliers. Errors are RMS over cameras and takes (or seeds); see `calibration_reference` for the bound.

OUTPUT.json holds every measurement, OUTPUT.md the tables, which are printed as well. Times are wall times:
run this on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

# As preface-calibrate does: the threads of the BLAS cost more than they bring.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.calibration_reference import Errors, Reference, errors, of_scene, of_studio
from bench.calibration_scene import SceneConfig, simulate
from preface.artifacts import ArtifactError, provenance, write_bytes
from preface.capture.calibration import Calibration, CalibrationError, CalibrationOptions, calibrate_rig
from preface.capture.calibration_files import CalibrationTake, find_calibration
from preface.capture.detection import DetectionError, DetectionOptions, detect_corners
from preface.capture.images import read_header, read_image, write_png
from preface.capture.observations import Observations
from preface.cli.usage import Parser

BACKENDS = ("own", "pycolmap")


@dataclass(frozen=True)
class Detection:
    """How the corners of one take were found, and what that took.

    Attributes:
        scale: as in the module's text.
        observations: the corners, in pixels of the original images.
        truth: of the same take.
        images: how many were looked at.
        seconds: wall time per image, all workers together.
        found: share of the corners to be seen.
    """

    scale: str
    observations: Observations
    truth: Reference
    images: int
    seconds: float
    found: float


@dataclass(frozen=True)
class Measured:
    """One line of a table: a calibration per take or seed.

    Attributes:
        scale, frames, backend: what was asked for.
        failed: what went wrong with those that failed.
        seconds: wall time of the calibration, model selection and uncertainty included, median.
        left_out: share of the corners found that the calibration left out.
        errors: root mean squares; None if all failed.
        models: the camera models that were chosen.
    """

    scale: str
    frames: int
    backend: str
    failed: tuple[str, ...]
    seconds: float | None
    left_out: float | None
    errors: Errors | None
    models: tuple[str, ...]


def main() -> None:
    """Measure, print and write."""
    arguments = _arguments()
    frames, jobs = sorted(arguments.frames), arguments.jobs or len(os.sched_getaffinity(0))
    content: dict[str, Any] = {
        "provenance": provenance({name: str(value) for name, value in vars(arguments).items()}, {}),
        "cores": len(os.sched_getaffinity(0)),
    }
    text = []
    if arguments.studio:
        detections, lines = studio(arguments.studio, frames, arguments.scales, jobs)
        content |= {"detection": detections, "studio": [asdict(line) for line in lines]}
        text += [
            _detection_table(detections, jobs),
            _table(f"Synthetic studio, {arguments.studio.name}", lines),
        ]
    lines = simulated(frames, arguments.seeds)
    content["simulated"] = [asdict(line) for line in lines]
    text.append(_table(f"Simulated corners of the reference rig, {arguments.seeds} seeds", lines))
    print("\n".join(text))
    write_bytes(arguments.output.with_suffix(".md"), "\n".join(text).encode())
    encoded = json.dumps(content, indent=1, allow_nan=False).encode()
    print(write_bytes(arguments.output.with_suffix(".json"), encoded))


def _arguments() -> argparse.Namespace:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studio", nargs="?", type=Path)
    parser.add_argument("--output", type=Path, default=Path("tradeoff"))
    parser.add_argument("--frames", nargs="+", type=int, default=[5, 10, 20, 40, 80])
    parser.add_argument("--scales", nargs="+", type=int, default=[2, 4], help="how many times smaller")
    parser.add_argument("--seeds", type=int, default=5, help="of the simulation")
    parser.add_argument("--jobs", type=int, default=0, help="workers of the detection; 0 uses every core")
    return parser.parse_args()


# ---------------------------------------------------------------------------------------- measuring


def studio(
    folder: Path, frames: list[int], scales: list[int], jobs: int
) -> tuple[list[dict[str, Any]], list[Measured]]:
    """Detect and calibrate every take of a studio.

    Returns:
        what each detection found and took, JSON types; the lines of the table: all numbers of frames and both
        backends with the full detection, then the other detections with all frames.
    """
    takes = find_calibration(folder / "capture")
    scaled = [f"{kind} 1/{scale}" for kind in ("search", "images") for scale in scales]
    full = [detect(folder, take, "full", jobs) for take in takes]
    available = min(len(each.observations.frame_ids) for each in full)
    counts = [count for count in frames if count <= available] or [available]
    given = [(each.observations, each.truth) for each in full]
    lines = [measure("full", count, backend, given) for count in counts for backend in BACKENDS]
    summaries = [_summary("full", full)]
    for scale in scaled:
        try:
            found = [detect(folder, take, scale, jobs) for take in takes]
        except DetectionError as error:  # the board is too small in such images
            summaries.append({"scale": scale, "failed": error.problem})
            continue
        summaries.append(_summary(scale, found))
        lines.append(measure(scale, counts[-1], "own", [(each.observations, each.truth) for each in found]))
    return summaries, lines


def simulated(frames: list[int], seeds: int) -> list[Measured]:
    """Calibrate simulated corners of the reference rig."""
    lines = []
    for count in frames:
        scenes = [simulate(SceneConfig(frames=count, outliers=0.02), seed) for seed in range(seeds)]
        given = [(scene.observations, of_scene(scene)) for scene in scenes]
        lines += [measure("-", count, backend, given) for backend in BACKENDS]
    return lines


def detect(folder: Path, take: CalibrationTake, scale: str, jobs: int) -> Detection:
    """Find the corners of a take, as `scale` says."""
    assert take.board is not None  # the studio's manifest describes it
    kind, _, times = scale.partition(" 1/")
    with tempfile.TemporaryDirectory(prefix="preface-tradeoff-") as scratch:
        smaller = _reduced(take, int(times), Path(scratch)) if kind == "images" else take
        images = [file for files in smaller.cameras.values() for file in files]
        longest = max(max(header.width, header.height) for header in map(read_header, images))
        side = longest // int(times) if kind == "search" else longest
        began = time.perf_counter()
        seen = detect_corners(smaller, take.board, DetectionOptions(search_side=side, jobs=jobs)).observations
        seconds = (time.perf_counter() - began) / len(images)
    sizes = [read_header(take.cameras[name][0]) for name in seen.camera_ids]
    full = tuple((header.width, header.height) for header in sizes)
    enlarged = np.array(full) / np.array(seen.image_sizes)
    seen = replace(seen, image_sizes=full, pixels=seen.pixels * enlarged[seen.camera])
    truth = of_studio(folder, take.id, seen)
    return Detection(scale, seen, truth, len(images), seconds, len(seen) / truth.visible)


def _reduced(take: CalibrationTake, times: int, scratch: Path) -> CalibrationTake:
    """The same photographs, so many times smaller."""
    cameras = {}
    for name, files in take.cameras.items():
        folder = scratch / name
        folder.mkdir()
        cameras[name] = tuple(folder / f"{file.stem}.png" for file in files)
        for file, smaller in zip(files, cameras[name], strict=True):
            image = read_image(file)
            size = (round(image.shape[1] / times), round(image.shape[0] / times))
            write_png(smaller, cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    return replace(take, folder=scratch, cameras=cameras)


def measure(scale: str, frames: int, backend: str, given: list[tuple[Observations, Reference]]) -> Measured:
    """Calibrate each take or seed from so many frames."""
    found: list[tuple[Calibration, Errors, float]] = []
    failed = []
    for seen, truth in given:
        chosen = np.unique(np.linspace(0, len(seen.frame_ids) - 1, frames).round().astype(int))
        kept = np.isin(seen.frame, chosen)
        options = CalibrationOptions(backend=backend)  # type: ignore[arg-type]
        if frames < 2 * options.folds:
            model = truth.cameras[0].model
            options = replace(options, camera_model=model, board_warp="off")  # type: ignore[arg-type]
        began = time.perf_counter()
        try:
            calibration = calibrate_rig(seen.subset(kept), options)
        except CalibrationError as error:
            failed.append(str(error))
            continue
        seconds = time.perf_counter() - began
        found.append((calibration, errors(calibration, replace(truth, pixels=truth.pixels[kept])), seconds))
    if not found:
        return Measured(scale, frames, backend, tuple(failed), None, None, None, ())
    return Measured(
        scale=scale,
        frames=frames,
        backend=backend,
        failed=tuple(failed),
        seconds=float(np.median([seconds for _, _, seconds in found])),
        left_out=float(1 - np.mean([calibration.inliers.mean() for calibration, _, _ in found])),
        errors=_root_mean_square([each for _, each, _ in found]),
        models=tuple(sorted({calibration.cameras[0].model for calibration, _, _ in found})),
    )


def _root_mean_square(each: list[Errors]) -> Errors:
    rows = [asdict(one) for one in each]
    return Errors(**{name: float(np.sqrt(np.mean([row[name] ** 2 for row in rows]))) for name in rows[0]})


def _summary(scale: str, found: list[Detection]) -> dict[str, Any]:
    return {
        "scale": scale,
        "images": sum(each.images for each in found),
        "seconds_per_image": float(
            np.average([each.seconds for each in found], weights=[e.images for e in found])
        ),
        "corners": sum(len(each.observations) for each in found),
        "corners_found": float(np.mean([each.found for each in found])),
    }


# ------------------------------------------------------------------------------------------- tables


def _detection_table(detections: list[dict[str, Any]], jobs: int) -> str:
    rows = [
        f"| {d['scale']} | failed: {d['failed']} |"
        if "failed" in d
        else f"| {d['scale']} | {d['images']} | {1e3 * d['seconds_per_image']:.0f} | {d['corners']:,} | "
        f"{1 - d['corners_found']:.2%} |"
        for d in detections
    ]
    head = f"| detection | images | ms per image, {jobs} workers | corners | of those to be seen, not found |"
    return "\n".join([head, "|---|---|---|---|---|", *rows, ""])


def _table(title: str, lines: list[Measured]) -> str:
    head = (
        "| detection | frames | backend | calibration s | corners left out | noise px | camera centre mm | "
        "over the bound | focal length | over the bound | model |\n|---|---|---|---|---|---|---|---|---|---|---|"
    )
    return "\n".join([f"{title}:", "", head, *map(_row, lines), ""])


def _row(line: Measured) -> str:
    start = f"| {line.scale} | {line.frames} | {line.backend} |"
    if line.errors is None or line.seconds is None or line.left_out is None:
        return f"{start} failed: {line.failed[0]} |"
    some = f" ({len(line.failed)} failed)" if line.failed else ""
    e = line.errors
    return (
        f"{start} {line.seconds:.2f} | {line.left_out:.2%} | {e.noise:.3f} | {1e3 * e.center:.4f} | "
        f"{e.center / e.center_bound:.2f} | {e.focal:.1e} | {e.focal / e.focal_bound:.2f} | "
        f"{', '.join(line.models)}{some} |"
    )


if __name__ == "__main__":
    try:
        main()
    except ArtifactError as error:
        sys.exit(str(error))
