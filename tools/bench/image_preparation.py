"""What preparing photographs for shards costs, and what each cheaper choice costs in accuracy.

    python tools/bench/image_preparation.py [PICTURE ...] [--size 512x768] [--output image_preparation.json]

Without pictures it makes one of 4096x6144 pixels, of every scale of detail down to the pixel, and stores it as
JPEG, PNG with 8 and 16 bits and EXR. It prints two tables as Markdown and writes them as JSON:

- time: CPU milliseconds of this process for the stages of each file, and all of them against the bare decode
  (`cv2.imdecode`) of the same file in the same run;
- choices: what one picture costs, decoding included, with every filter, light, decode scale and route of
  undistortion, and how far its colours are from exact ones, as PSNR in dB over the sRGB values.

Exact: float64, linear light, the mean over what a result pixel covers; with distortion resampled away, the mean
over a grid of points, nine per source pixel, through the exact lens. Rounding to bytes alone leaves 58.9 dB.
Both are held against each other on bands of rows at the top, the middle and the bottom. Times are minima over
repetitions; on a busy machine they are too high, their ratios less so.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from preface.artifacts import provenance, write_bytes
from preface.capture.images import read_header, read_image, write_exr, write_jpeg, write_png
from preface.capture.preparation import PreparationOptions, Resampler, framing_window, split_alpha
from preface.capture.preparation.transfer import bytes_of_light, reader
from preface.capture.preparation.undistortion import Route
from preface.cli.usage import Parser
from preface.geometry import Camera, lens
from preface.srgb import decode, encode

MADE = (4096, 6144)
DISTORTION = (-0.1, 0.05, 1e-4, -2e-4)  # k1 k2 p1 p2 of a good studio lens
FOCAL = 13500 / 4096  # in widths of the image
BAND_ROWS = 8  # result rows that are compared, at three heights
POINTS = 3  # per source pixel and axis, of the exact undistortion


@dataclass(frozen=True)
class Choice:
    """One way to prepare a picture.

    Attributes:
        name: for the table.
        options: of the preparation.
        reduced: by how much the JPEG decoder reduces the picture already.
        route: of undistortion, None for the usual one.
    """

    name: str
    options: PreparationOptions
    reduced: int = 1
    route: Route | None = None


def choices(reducible: bool) -> list[Choice]:
    """All choices, the default first; ``reducible``: whether the picture is a JPEG."""
    keep = [
        Choice(f"{light} light, {filter}", PreparationOptions(filter, light, "keep"))
        for light in ("linear", "encoded")
        for filter in ("area", "lanczos", "bilinear")
    ]
    keep += [
        Choice(f"JPEG decoded at 1/{scale}, linear light, area", PreparationOptions(undistort="keep"), scale)
        for scale in ((2, 4) if reducible else ())
    ]
    undistorting = PreparationOptions(undistort="resample")
    routes = {
        "area/2, linear, 4x4 (at this ratio the usual)": None,
        "linear, 8x8 per pixel, no halving": Route(1, 8, 8, "linear"),
        "area/2, cubic, 4x4": Route(2, 4, 4, "cubic"),
        "area/4, linear, 2x2": Route(4, 2, 2, "linear"),
        "area/4, cubic, 2x2": Route(4, 2, 2, "cubic"),
        "after the downscale: area/8, linear, 1x1": Route(8, 1, 1, "linear"),
        "after the downscale: area/8, cubic, 1x1": Route(8, 1, 1, "cubic"),
    }
    return keep + [
        Choice(f"undistorted: {name}", undistorting, route=route) for name, route in routes.items()
    ]


def main() -> None:
    """Measure and print."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", nargs="*", type=Path, help="to measure instead of one that is made")
    parser.add_argument("--size", default="512x768", help="of the results")
    parser.add_argument("--repeats", type=int, default=5, help="of each measurement")
    parser.add_argument("--output", type=Path, default=Path("image_preparation.json"))
    arguments = parser.parse_args()
    across, down = (int(side) for side in arguments.size.split("x"))
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        pictures = arguments.pictures or made_pictures(Path(folder))
        stages = []
        for picture in pictures:
            stages.append(measure_stages(picture, (across, down), arguments.repeats))
            print_table([stages[-1]], header=len(stages) == 1)
        rows = []
        for picture in [path for path in pictures if read_header(path).format in ("JPEG", "PNG")][:2]:
            print(f"\n{picture.name}\n")
            rows += measure_choices(picture, (across, down), arguments.repeats)
            print_table([row for row in rows if row["picture"] == picture.name])
        inputs = {picture.name: picture for picture in pictures}
        origin = provenance({"size": arguments.size, "repeats": arguments.repeats}, inputs)
    document = {"stages": stages, "choices": rows, "provenance": origin}
    write_bytes(arguments.output, json.dumps(document, indent=1).encode())
    print(arguments.output)


def made_pictures(folder: Path) -> list[Path]:
    """A picture with edges and detail of every scale, in every format."""
    width, height = MADE
    rng = np.random.default_rng(0)
    encoded: np.ndarray = np.full((height, width, 3), 110, np.float32)
    for octave in range(0, 11, 2):
        size = (max(2, width >> octave), max(2, height >> octave))
        noise = rng.normal(0, 4 + 2.5 * octave, (size[1], size[0], 3)).astype(np.float32)
        encoded += cv2.resize(noise, MADE, interpolation=cv2.INTER_CUBIC)
    for _ in range(400):
        center = rng.uniform(0, MADE).astype(int).tolist()
        color = rng.uniform(0, 255, 3).tolist()
        cv2.circle(encoded, center, int(rng.uniform(2, 150)), color, -1 if rng.random() < 0.5 else 3)
    encoded = np.clip(encoded, 0, 255)
    paths = [folder / name for name in ("made.jpg", "made.png", "made16.png", "made.exr")]
    pixels = np.rint(encoded).astype(np.uint8)
    write_jpeg(paths[0], pixels, 95)
    write_png(paths[1], pixels)
    write_png(paths[2], np.rint(encoded * 257).astype(np.uint16))
    light = decode(encoded / 255).astype(np.float16)
    write_exr(paths[3], {name: light[..., channel] for channel, name in enumerate("RGB")})
    return paths


def camera_of(width: int, height: int) -> Camera:
    """A studio camera of that size, with distortion."""
    focal = FOCAL * width
    return Camera("OPENCV", width, height, np.array([focal, focal, width / 2, height / 2, *DISTORTION]))


def plan_for(camera: Camera, size: tuple[int, int], choice: Choice) -> Resampler:
    """The resampler of a choice; photographs that do not fit the size are framed in the centre."""
    return Resampler(camera, size, framing_window(camera, size, "center"), choice.options, choice.route)


def milliseconds(repeats: int, **work: Callable[[], Any]) -> dict[str, float]:
    """CPU time of this process, all threads, of pieces of work that take turns; the minimum over repetitions."""
    best = dict.fromkeys(work, np.inf)
    for _ in range(repeats):
        for name, piece in work.items():
            start = time.process_time()
            piece()
            best[name] = min(best[name], time.process_time() - start)
    return {name: round(1e3 * seconds, 1) for name, seconds in best.items()}


# ------------------------------------------------------------------------------------------- time


def measure_stages(path: Path, size: tuple[int, int], repeats: int) -> dict[str, Any]:
    """CPU-ms of the stages of one file by the default choice."""
    encoded = np.frombuffer(path.read_bytes(), np.uint8)
    pixels, _ = split_alpha(read_image(path))
    height, width = pixels.shape[:2]
    plan = plan_for(camera_of(width, height), size, choices(False)[0])
    read = reader(pixels.dtype, "linear", 1.0)
    lines = pixels.reshape(height, -1)
    light = np.empty((16, lines.shape[1]), np.float32)
    alpha = np.random.default_rng(0).uniform(0, 1, (height, width)).astype(np.float32)
    values = np.random.default_rng(0).uniform(0, 1, (size[1], size[0], 3)).astype(np.float32)

    def all_light() -> None:
        for row in range(0, height, len(light)):
            rows = lines[row : row + len(light)]
            read(rows, light[: len(rows)])

    def bare() -> np.ndarray:  # OpenCV's wheels decode no EXR: there it is `read_image`
        return read_image(path) if path.suffix == ".exr" else cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)

    took = milliseconds(
        repeats,
        bare=bare,
        read=lambda: read_image(path),
        light=all_light,
        bytes=lambda: bytes_of_light(values),
        colors=lambda: plan.colors(pixels),
        coverage=lambda: plan.coverage(alpha),
        foreground=lambda: plan.foreground(pixels, alpha),
    )
    return {
        "picture": f"{path.name} ({width}x{height} {pixels.dtype})",
        "bare decode": took["bare"],
        "read_image": took["read"],
        "colors": took["colors"],
        "of that: to light": took["light"],
        "rows and columns": round(took["colors"] - took["light"] - took["bytes"], 1),
        "to bytes": took["bytes"],
        "(read_image + colors) / bare decode": round((took["read"] + took["colors"]) / took["bare"], 2),
        "coverage of a float mask": took["coverage"],
        "colours, coverage and edges by a float mask": took["foreground"],
    }


# --------------------------------------------------------------------------------------- choices


def measure_choices(path: Path, size: tuple[int, int], repeats: int) -> list[dict[str, Any]]:
    """Every choice's cost, decoding included, and its error."""
    pixels, _ = split_alpha(read_image(path))
    height, width = pixels.shape[:2]
    is_jpeg = read_header(path).format == "JPEG"
    flags = {
        1: cv2.IMREAD_COLOR_RGB,
        2: cv2.IMREAD_REDUCED_COLOR_2,
        4: cv2.IMREAD_REDUCED_COLOR_4,
    }
    encoded = np.frombuffer(path.read_bytes(), np.uint8)
    exact: dict[bool, np.ndarray] = {}
    rows: list[dict[str, Any]] = []
    default_cost = 0.0
    for choice in choices(is_jpeg):
        camera = camera_of(width, height)
        source = pixels
        if choice.reduced > 1:
            source = np.ascontiguousarray(cv2.imdecode(encoded, flags[choice.reduced])[..., ::-1])
            camera = camera.resized(source.shape[1], source.shape[0])
        plan = plan_for(camera, size, choice)
        if plan.undistorted not in exact:
            whole = plan_for(camera_of(width, height), size, choice)
            exact[plan.undistorted] = (
                exact_undistorted(pixels, whole) if plan.undistorted else exact_area(pixels, whole)
            )
        found = compared(plan.colors(source)) / 255.0
        error = np.mean((found - exact[plan.undistorted]) ** 2)
        took = milliseconds(
            repeats,
            decode=partial(cv2.imdecode, encoded, flags[choice.reduced]),
            colors=partial(plan.colors, source),
        )
        cost = took["decode"] + took["colors"]
        default_cost = default_cost or cost
        rows.append(
            {
                "picture": path.name,
                "choice": choice.name,
                "CPU-ms with decode": round(cost, 1),
                "cost / default": round(cost / default_cost, 2),
                "PSNR dB": round(float(-10 * np.log10(error)), 2),
            }
        )
    return rows


def bands(height: int) -> list[range]:
    """The result rows that are compared."""
    starts = (0, (height - BAND_ROWS) // 2, height - BAND_ROWS)
    return [range(start, start + BAND_ROWS) for start in starts]


def compared(colors: np.ndarray) -> np.ndarray:
    """Those rows of a result."""
    return np.concatenate([colors[band.start : band.stop] for band in bands(len(colors))])


def light_of(pixels: np.ndarray) -> np.ndarray:
    """Integer pixels as linear light, float64."""
    return decode(pixels / np.float64(np.iinfo(pixels.dtype).max))


def exact_area(pixels: np.ndarray, plan: Resampler) -> np.ndarray:
    """The encoded means over what result pixels cover, float64, of the compared rows."""
    window, camera = plan.window, plan.camera
    across = covered_parts(pixels.shape[1], window.x, window.width, camera.width)
    made = []
    for band in bands(camera.height):
        step = window.height / camera.height
        low, high = int(window.y + band.start * step), int(np.ceil(window.y + band.stop * step))
        high = min(high, len(pixels))
        down = covered_parts(high - low, window.y + band.start * step - low, BAND_ROWS * step, BAND_ROWS)
        made.append(np.einsum("ih,hwc,jw->ijc", down, light_of(pixels[low:high]), across, optimize=True))
    return encode(np.concatenate(made))


def covered_parts(length: int, start: float, span: float, count: int) -> np.ndarray:
    """How much of each result pixel (rows) each source pixel covers, float64; rows add up to 1."""
    edges = start + np.arange(count + 1) * span / count
    places = np.arange(length)
    parts = np.minimum(places + 1, edges[1:, None]) - np.maximum(places, edges[:-1, None])
    return np.maximum(parts, 0) * count / span


def exact_undistorted(pixels: np.ndarray, plan: Resampler) -> np.ndarray:
    """The encoded means over a fine grid through the exact lens, float64, of the compared rows."""
    camera, source = plan.camera, plan.source
    fine = POINTS * round(plan.window.width / camera.width)
    fx, fy, cx, cy = camera.intrinsics[:4]
    x = ((np.arange(camera.width * fine) + 0.5) / fine - cx) / fx
    made = []
    for row in (row for band in bands(camera.height) for row in band):
        y = (row + (np.arange(fine) + 0.5) / fine - cy) / fy
        bent = lens.distort(source.intrinsics, x[None, :], y[:, None])
        columns = np.floor(source.intrinsics[0] * bent.x + source.intrinsics[2]).astype(int)
        rows = np.floor(source.intrinsics[1] * bent.y + source.intrinsics[3]).astype(int)
        seen = pixels[np.clip(rows, 0, len(pixels) - 1), np.clip(columns, 0, pixels.shape[1] - 1)]
        made.append(light_of(seen).reshape(fine, camera.width, fine, 3).mean((0, 2)))
    return encode(np.stack(made))


def print_table(rows: list[dict[str, Any]], header: bool = True) -> None:
    """Print rows of equal keys as Markdown."""
    if header:
        print("| " + " | ".join(rows[0]) + " |")
        print("|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(str(value) for value in row.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
