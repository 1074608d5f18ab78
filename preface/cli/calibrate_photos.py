"""``preface-calibrate photos``: from photographs of no particular arrangement to a rig and its report."""

import argparse
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from preface.artifacts import provenance
from preface.capture.photo_report import photo_report
from preface.capture.photos import PhotoCalibration, PhotoOptions, calibrate_photos
from preface.capture.rig import write_rig
from preface.cli.usage import UsageError


def run(config: argparse.Namespace) -> list[str]:
    """Calibrate, write the report and then the rig; returns the lines to print."""
    options = PhotoOptions(
        cameras=config.cameras,
        take=config.take,
        masks=config.masks,
        known_distance=_known_distance(config.known_distance),
        seed=config.seed,
        threads=config.jobs or 0,
    )
    rig_path = config.output / "rig.json" if config.output.is_dir() else config.output
    report_path = config.report or rig_path.with_suffix(".report.html")
    if report_path.suffix != ".html":
        raise UsageError(f"--report: {report_path} does not end in .html")
    began = time.perf_counter()
    found = calibrate_photos(config.source, options)
    print(f"calibrated in {time.perf_counter() - began:.1f} s", file=sys.stderr)
    history = provenance(_plain(asdict(options)), _inputs(config.source, found), config.seed)
    rig = replace(found.rig, provenance=history)
    for warning in found.warnings:
        print(f"note: {warning}", file=sys.stderr)
    report = photo_report(replace(found, rig=rig)).write(report_path)
    chosen = found.candidates[found.chosen]
    held_out = "" if chosen.held_out_error is None else f", held out {chosen.held_out_error:.3f} px"
    return [
        f"{len(rig.cameras)} of {len(rig.cameras) + len(found.missing)} photographs registered",
        f"reprojection RMS {chosen.training_error:.3f} px{held_out}, camera model {chosen.model}",
        f"scale: {found.scale}",
        f"report: {report}",
        str(write_rig(rig_path, rig)),
    ]


def _known_distance(words: list[str] | None) -> tuple[str, str, float] | None:
    if words is None:
        return None
    first, second, metres = words
    try:
        return first, second, float(metres)
    except ValueError as error:
        raise UsageError(f"--known-distance: '{metres}' is not a length in metres") from error


def _inputs(source: Path, found: PhotoCalibration) -> dict[str, Path]:
    return {
        photograph.path.relative_to(source).as_posix(): photograph.path for photograph in found.photographs
    }


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings as JSON has them; what differs between machines without changing the result is left out."""
    kept = {name: value for name, value in settings.items() if name != "threads"}
    return {name: str(value) if isinstance(value, Path) else value for name, value in kept.items()}
