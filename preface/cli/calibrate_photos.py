"""``preface-calibrate photos``: from photographs of no particular arrangement to a rig and its report."""

import argparse
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from preface.artifacts import provenance
from preface.capture.photo_report import photo_report
from preface.capture.photos import PhotoCalibration, PhotoOptions, calibrate_photos
from preface.capture.rig import write_rig
from preface.cli.folders import make_folder, require_writable
from preface.cli.output import known_distance, say
from preface.cli.rig_files import new_report_file, new_rig_file


def run(config: argparse.Namespace) -> list[str]:
    """Calibrate, write the report and then the rig; returns the lines to print."""
    options = PhotoOptions(
        cameras=config.cameras,
        take=config.take,
        masks=config.masks,
        known_distance=known_distance(config.known_distance),
        seed=config.seed,
        threads=config.jobs or 0,
    )
    rig_path = new_rig_file(config.output)
    report_path = new_report_file(config.report, rig_path)
    for path in (rig_path, report_path):
        require_writable(path.parent)
    began = time.perf_counter()
    found = calibrate_photos(config.source, options)
    say(f"calibrated in {time.perf_counter() - began:.1f} s")
    history = provenance(_plain(asdict(options)), _inputs(config.source, found), config.seed)
    rig = replace(found.rig, provenance=history)
    for warning in found.warnings:
        say(f"note: {warning}")
    for path in (rig_path, report_path):
        make_folder(path.parent)
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


def _inputs(source: Path, found: PhotoCalibration) -> dict[str, Path]:
    return {
        photograph.path.relative_to(source).as_posix(): photograph.path for photograph in found.photographs
    }


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings as JSON has them; what differs between machines without changing the result is left out."""
    kept = {name: value for name, value in settings.items() if name != "threads"}
    return {name: str(value) if isinstance(value, Path) else value for name, value in kept.items()}
