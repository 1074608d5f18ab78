"""The stages of the table: what was measured of each, its default and why; those up to the shards have their rows here.

A stage is data. Its rows come from a measurement that was kept (`keeping`) and from nowhere else, and the default is
marked by what the code has as its default, where a module says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from preface.align.detection import DetectionOptions
from preface.capture.preparation.options import PreparationOptions


@dataclass(frozen=True)
class Row:
    """A choice: in words, its time and its error with their units, and whether it is the default."""

    choice: str
    time: str
    error: str
    default: bool = False


@dataclass(frozen=True)
class Stage:
    """A stage of the way from photographs to images.

    Attributes:
        title: of it in the table.
        source: whose measurements it shows, a key of `SCRIPTS`.
        default: what is done unless told otherwise.
        why: a sentence.
        rows: of a measurement.
    """

    title: str
    source: str
    default: str
    why: str
    rows: Callable[[Any], Iterable[Row]]


SCRIPTS = {
    "calibration": "tools/bench/calibration_tradeoff.py",
    "alignment": "tools/bench/alignment_tradeoff.py",
    "image-preparation": "tools/bench/image_preparation.py",
    "foreground-masks": "tools/bench/foreground_masks.py",
    "shard-reader": "tools/bench/shard_reader.py",
    "training-step": "tools/bench/training_step.py",
    "training": "preface-train",
    "fit": "tools/measure_tradeoff.py fit",
    "render": "tools/measure_tradeoff.py render",
    "large-images": "tools/bench/render_large.py",
    "evaluation": "tools/bench/evaluation_choices.py",
    "real-faces": "tools/real_faces.py",
}


DETECTIONS = {"full": "full detection", "search": "searched at {}", "images": "images of {}"}


def processor_time(seconds: float, per: str) -> str:
    """CPU time of something, with a unit that it is readable in."""
    unit, scale = next(((u, s) for u, s in (("s", 1.0), ("ms", 1e3)) if seconds * s >= 1), ("us", 1e6))
    value = seconds * scale
    return f"{value:{'.2f' if value < 10 else '.0f'}} CPU-{unit} {per}"


def calibration(measured: Any) -> Iterator[Row]:
    """Detections, numbers of frames and backends, of a studio's board."""
    per_image = {d["scale"]: d["seconds_per_image"] for d in measured["detection"] if "failed" not in d}
    images = {d["scale"]: d["images"] for d in measured["detection"] if "failed" not in d}
    most = max(line["frames"] for line in measured["studio"])
    for line in measured["studio"]:
        if line["errors"] is None:
            continue
        scale, frames = line["scale"], line["frames"]
        finding = per_image[scale] * images[scale] * frames / most
        words = DETECTIONS[scale.split(" ")[0]].format(scale.split(" ")[-1])
        yield Row(
            f"{words}, {frames} frames, {line['backend']} solver",
            f"{finding:.0f} s to detect, {line['seconds']:.1f} s to solve",
            _centres(line["errors"]),
            (scale, frames, line["backend"]) == ("full", most, "own"),
        )
    for line in measured["simulated"]:
        if line["errors"] is not None:
            choice = f"simulated corners, {line['frames']} frames, {line['backend']} solver"
            yield Row(choice, f"{line['seconds']:.1f} s to solve", _centres(line["errors"]))


def _centres(errors: Mapping[str, float]) -> str:
    bound = errors["center"] / errors["center_bound"]
    return (
        f"camera centres {1e3 * errors['center']:.4f} mm, {bound:.2f} of the Cramer-Rao bound; "
        f"corners to {errors['noise']:.3f} pixels"
    )


def alignment(measured: Any) -> Iterator[Row]:
    """Search sides, crops, views and triangulations."""
    usual, tables = DetectionOptions(), measured["tables"]
    views = max((row["views"] for row in tables["views"]), default=0)
    most = max(row["keypoints"] for rows in tables.values() for row in rows if "RMS mm" in row)
    told: dict[str, tuple[str, Callable[[Any], str], Any]] = {
        "scale": ("search side", lambda value: f"faces searched at {value} pixels", usual.scale),
        "crops": (
            "crops",
            lambda value: f"{value} crop{'' if value == 1 else 's'} of each face",
            usual.jitters,
        ),
        "views": ("views", lambda value: f"{value} views", views),
    }
    for table, (key, words, default) in told.items():
        for row in tables[table]:
            if "RMS mm" in row:
                seconds = row["read s"] + row["find s"] + row["align s"]
                time = processor_time(seconds, "per person")
                yield Row(words(row[key]), time, _keypoints(row, most), row[key] == default)
    for row in tables["triangulation"]:
        if "RMS mm" in row:
            time = processor_time(row["align s"], "per person")
            yield Row(f"triangulation: {row['method']}", time, _keypoints(row, most), row["method"] == "ours")


def _keypoints(row: Any, all_of_them: int) -> str:
    """Errors of the keypoints that were found; none where half are missing, since those left are the easy ones."""
    found = row["keypoints"]
    missing = f"{all_of_them - found} of {all_of_them} keypoints not found" if found < all_of_them else ""
    if 2 * found <= all_of_them:
        return f"–; {missing}"
    figures = f"keypoints {row['median mm']:.2f} mm in the median, {row['RMS mm']:.2f} RMS"
    return f"{figures}; {missing}" if missing else figures


def image_preparation(measured: Any) -> Iterator[Row]:
    """Filters, light, decoding and, of routes of undistortion, the usual and the short ones; PSNR to exact colours."""
    usual = PreparationOptions()
    default = f"{usual.light} light, {usual.filter}"
    for row in measured["choices"]:
        choice = row["choice"]
        if "undistorted" not in choice or "the usual" in choice or "after the downscale" in choice:
            time = processor_time(row["CPU-ms with decode"] / 1e3, "per image")
            yield Row(choice, time, f"{row['PSNR dB']:.1f} dB to exact colours", choice == default)


def foreground_masks(measured: Any) -> Iterator[Row]:
    """Methods by kind of photograph; the default is what `--foreground auto` takes for it."""
    for row in measured:
        declared = row["data"].removeprefix("studio, ")
        yield Row(
            f"{row['data']}: {row['method']}",
            processor_time(row["cpu s per megapixel"], "per megapixel"),
            f"IoU {row['iou']:.4f}, worst {row['worst iou']:.4f}; outline off by {row['boundary px']:.2f} pixels",
            row["method"] == declared or (declared == "portrait" and row["method"] == "selfie"),
        )


def shard_reader(measured: Any) -> Iterator[Row]:
    """Full batches of ours through distorting lenses and, where they were measured, of other libraries."""
    for line in measured["timings"]:
        if line["what"].startswith("full batches") and "pinhole" not in line["section"]:
            where, how = line["section"].split(", 4.0")[0], line["what"].removeprefix("full batches")
            time = f"{1e3 * line['median']:.2f} ms for {line['rays']:,} rays"
            yield Row(f"{where}{how}", time, "none", "distorted, mmap" in where)
    for peer in measured["peers"]:
        if "hot" in peer:
            name = f"{peer['library']} {peer['version']}, the paper's pattern, pixels only"
            yield Row(name, f"{1e3 * peer['hot']:.0f} ms, {peer['ratio']:.0f} times ours", "–")


TO_SHARDS = (
    Stage(
        "Calibrate",
        "calibration",
        "full detection, every frame, our own solver",
        "Detection is most of the time, so that fewer frames save more than smaller images, and at less error.",
        calibration,
    ),
    Stage(
        "Align",
        "alignment",
        f"faces searched at {DetectionOptions().scale} pixels, {DetectionOptions().jitters} crops, every view",
        "It runs once per person; what it gets wrong, no later stage can mend. Choices are by the median: of so few "
        "people, one keypoint of one of them moves the RMS by more than any choice.",
        alignment,
    ),
    Stage(
        "Build shards, images",
        "image-preparation",
        "linear light, area; the lens stays in the camera",
        "Mixing light as a larger pixel would is the most exact, and resampling the lens away costs several times as "
        "much and is not needed: rays go through the lens when they are read.",
        image_preparation,
    ),
    Stage(
        "Build shards, masks",
        "foreground-masks",
        "what the background that was declared allows, otherwise MediaPipe's selfie segmentation",
        "A background that is known is a better witness than a network.",
        foreground_masks,
    ),
    Stage(
        "Read shards",
        "shard-reader",
        "mapped files, batches by the compiled kernel where numba is installed",
        "Rays are formed when they are read, so that the lens is exact and a ray takes four bytes.",
        shard_reader,
    ),
)
