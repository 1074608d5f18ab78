"""The stages from the shards on: train, fit, render, evaluate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from preface.cli.train import DEFAULT_PRESET
from preface.model.configuration import PRESETS
from preface.model.fitting.configuration import FitConfig
from preface.model.rendering.shortcuts import DEFAULT_QUALITY, QUALITIES, Shortcuts
from speed_table.stages import TO_SHARDS, Row, Stage, processor_time
from tradeoff.fitting import means
from tradeoff.front import IMAGES, LARGEST_LOSS, MOST, cost
from tradeoff.points import NORMALS

NOT_SHOWN = {"fullest", "reference", "together", "samples", "width", *NORMALS}  # of the render's groups
FORMS = {
    "route": "float32 products",
    "bf16": "bfloat16 products",
    "concatenated": "the paper's form, float32",
}


def training_step(measured: Any) -> Iterator[Row]:
    """A preset's products, and the same model written plainly."""
    for row in measured["rows"]:
        if row["form"] in FORMS:
            time = processor_time(1 / row["rays_per_cpu_second"], "per ray")
            error = "colours exact" if row["rgb_off"] == 0 else f"colours off by at most {row['rgb_off']:.0e}"
            default = row["form"] == "route" and row["preset"] == DEFAULT_PRESET
            yield Row(f"a step of `{row['preset']}`, {FORMS[row['form']]}", time, error, default)


def training(measured: Any) -> Iterator[Row]:
    """A prior."""
    validation, size = measured["validation"], measured["resolution"]
    yield Row(
        f"`{measured['preset']}`, {measured['matmul']}, {measured['steps']:,} steps, {measured['people']} people at "
        f"{size['width']}x{size['height']}",
        f"{measured['seconds'] / 60:.1f} min of steps",
        f"{validation['psnr']:.1f} dB on {validation['views']} views not trained on",
        (measured["preset"], measured["matmul"]) == (DEFAULT_PRESET, PRESETS[DEFAULT_PRESET].matmul),
    )


def fit(measured: Any) -> Iterator[Row]:
    """Qualities end to end, and what is on the front when one thing is varied."""
    rows = means(list(measured["points"].values()))
    for row in rows:
        ends = row["group"] == "quality"
        if ends or row["front"]:
            name = f"`{row['name'].removeprefix('quality ')}`, fitted and rendered" if ends else row["name"]
            yield Row(
                f"{name}, {row['people']} {'person' if row['people'] == 1 else 'people'}",
                f"{row['cpu_s']:.0f} CPU-s, then {processor_time(row['view_cpu_s'], 'per image')}",
                _likeness(row),
                row["name"] == f"quality {FitConfig.quality}",
            )


def _likeness(row: Mapping[str, Any]) -> str:
    shown = (("psnr", "{:.2f} dB"), ("ssim", "SSIM {:.3f}"), ("lpips", "LPIPS {:.3f}"))
    return ", ".join(words.format(row[name]) for name, words in shown if name in row)


def render(measured: Any) -> Iterator[Row]:
    """Qualities as they are now, then each shortcut alone."""
    points = [p for p in measured["points"].values() if p["settings"]["model"] == 0]
    usual = asdict(Shortcuts())
    for quality, shortcuts in QUALITIES.items():
        for point in points:
            same = {**usual, **point["settings"]["shortcuts"]} == asdict(shortcuts)
            if same and point["settings"]["samples"] is None and point["group"] not in NORMALS:
                yield _rendered(f"`{quality}`", point, default=quality == DEFAULT_QUALITY)
                break
    for point in points:
        if point["group"] not in NOT_SHOWN:
            yield _rendered(f"alone: {point['name']}", point, default=False)


def _rendered(choice: str, point: Mapping[str, Any], *, default: bool) -> Row:
    to_trained = None if point["group"] == "reference" else point.get("psnr_to_trained")
    own = "" if to_trained is None else f"{_decibels(to_trained)} to the model as trained, "
    error = f"{own}{point['psnr_to_full']:.1f} dB to the fullest render, {point['psnr']:.2f} to photographs"
    return Row(choice, processor_time(cost(point, IMAGES) / point["rays"], "per ray"), error, default)


def _decibels(psnr: float) -> str:
    return "equal" if psnr >= MOST else f"{psnr:.1f} dB"


def large_images(measured: Any) -> Iterator[Row]:
    """Sides of an image, by one quality."""
    for row in measured:
        time = f"{processor_time(row['cpu_s'], 'per image')}, {row['peak_mib']:.0f} MiB"
        same = row.get("one piece: pixels that differ by half a grey value")
        error = "–" if same is None else f"{same} pixels differ from a render in one piece"
        yield Row(f"{row['side']}x{row['side']}, `{row['quality']}`, with normals", time, error)


def evaluation(measured: Any) -> Iterator[Row]:
    """Qualities, with normals and without."""
    for row in measured["rows"]:
        off = f"PSNR off by at most {row['psnr_off']:.2f} dB" if row["psnr_off"] > 0 else "none"
        yield Row(
            f"`{row['quality']}`, {'with' if row['normals'] else 'without'} normals",
            processor_time(row["cpu_s_per_view"], f"per view of {measured['size']}"),
            off,
            row["quality"] == "reference" and row["normals"],
        )


STAGES = (
    *TO_SHARDS,
    Stage(
        "Train, products",
        "training-step",
        "float32 products by the library that is found to be faster",
        "A processor without bfloat16 products gains nothing from them, so that only the preset for a GPU has them.",
        training_step,
    ),
    Stage(
        "Train, presets",
        "training",
        f"`--preset {DEFAULT_PRESET}`",
        "It is the largest that two processor cores train within the hour.",
        training,
    ),
    Stage(
        "Fit",
        "fit",
        f"`--quality {FitConfig.quality}`",
        "It takes minutes; `draft` is to look at, `reference` for who can wait, `paper` for a GPU. Longer fits gain "
        "likeness; where two views leave open what a third one sees, they drift, and lose decibels there.",
        fit,
    ),
    Stage(
        "Render, shortcuts",
        "render",
        f"`--quality {DEFAULT_QUALITY}`",
        f"It takes a fifth of the time of the model as trained and loses less than {LARGEST_LOSS:g} dB to photographs.",
        render,
    ),
    Stage(
        "Render, size",
        "large-images",
        "4,096 rays at a time",
        "Time goes with the pixels and memory far slower, so that size is a matter of patience.",
        large_images,
    ),
    Stage(
        "Evaluate",
        "evaluation",
        "`reference`, with normals",
        "Figures are to be those of the model as trained; normals are shown because a head can be right in colour and "
        "wrong in shape.",
        evaluation,
    ),
)
