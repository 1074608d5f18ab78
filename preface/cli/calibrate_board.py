"""``preface-calibrate board``: from pictures of a board to a rig per take, with corners and report beside it."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError, provenance
from preface.capture.board_images import image_loader
from preface.capture.boards import BoardError, board_points, describe_board, parse_squares
from preface.capture.calibration import Calibration, CalibrationOptions
from preface.capture.calibration_files import CalibrationTake, find_calibration
from preface.capture.calibration_report import TakeDrift, calibration_report
from preface.capture.corners import Corners, read_corners, write_corners
from preface.capture.detection import DetectionOptions, detect_corners
from preface.capture.manifest import Board
from preface.capture.rig import write_rig
from preface.capture.takes import calibrate_takes, drift, require_distance, without_cameras
from preface.cli.folders import make_folder, require_writable
from preface.cli.output import known_distance, say
from preface.cli.rig_files import RIG_FILE, new_report_file, new_rig_file
from preface.cli.usage import UsageError
from preface.plain_words import suggestion


@dataclass(frozen=True)
class _Job:
    """One take: where its corners come from, and where its results go."""

    take: CalibrationTake
    corners: Corners
    rig_path: Path
    report_path: Path


def run(config: argparse.Namespace) -> list[str]:
    """Detect, solve, write the reports and then the rigs; returns the lines to print."""
    options = CalibrationOptions(config.camera_model, config.board_warp, config.held_out, config.backend)
    board, distance = _described(config), known_distance(config.known_distance)
    takes = _takes(config)
    paths = _paths(config, takes)
    jobs = [_job(config, take, board, *of_take) for take, of_take in zip(takes, paths, strict=True)]
    began = time.perf_counter()
    found = calibrate_takes({job.take.id: job.corners.observations for job in jobs}, options)
    say(f"calibrated in {time.perf_counter() - began:.1f} s")
    if distance:
        for calibration in found.values():
            require_distance(calibration, *distance)
    began = time.perf_counter()
    lines = []
    for index, job in enumerate(jobs):
        for warning in found[job.take.id].warnings:
            say(f"note: take '{job.take.id}': {warning}")
        before = jobs[index - 1] if index else None
        lines += _write(config, job, found[job.take.id], _drifts(before, job, found))
    say(f"reported in {time.perf_counter() - began:.1f} s")
    return lines


# ------------------------------------------------------------------------------------ what is asked


def _described(config: argparse.Namespace) -> Board | None:
    """The board that the flags describe, if they do."""
    given = [
        name for name in ("squares", "square_size", "marker_size", "dictionary") if getattr(config, name)
    ]
    given += [name for name in ("legacy", "inverted") if getattr(config, name)]
    if config.board is None:
        if given:
            raise UsageError(
                f"--{given[0].replace('_', '-')} describes a board, but --board does not say which"
            )
        return None
    for name in ("squares", "square_size"):
        if not getattr(config, name):
            raise UsageError(f"--board {config.board} needs --{name.replace('_', '-')}")
    try:
        return describe_board(
            config.board,
            parse_squares(config.squares),
            config.square_size,
            config.marker_size,
            config.dictionary,
            config.legacy,
            config.inverted,
        )
    except BoardError as error:
        raise UsageError(str(error)) from error


def _takes(config: argparse.Namespace) -> list[CalibrationTake]:
    """The takes to calibrate, without the cameras that are to be left out."""
    takes = find_calibration(config.source)
    names = [take.id for take in takes]
    for name in config.take or ():
        if name not in names:
            raise ArtifactError(config.source, "takes", f"there is no take '{name}'", suggestion(name, names))
    takes = [take for take in takes if not config.take or take.id in config.take]
    if config.corners and len(takes) > 1:
        raise UsageError(f"--corners holds one take: say which with --take ({', '.join(names)})")
    cameras = dict.fromkeys(camera for take in takes for camera in take.cameras)
    for name in (*(config.leave_out or ()), *(config.known_distance or ())[:2]):
        if name not in cameras:
            raise ArtifactError(
                config.source, "cameras", f"there is no camera '{name}'", suggestion(name, cameras)
            )
    left = set(config.leave_out or ())
    return [
        replace(take, cameras={name: files for name, files in take.cameras.items() if name not in left})
        for take in takes
    ]


def _paths(config: argparse.Namespace, takes: Sequence[CalibrationTake]) -> list[tuple[Path, Path]]:
    """Where each take's rig and report go, which can be written there."""
    many = len(takes) > 1
    output = config.output or Path("." if many else RIG_FILE)
    if many and (output.suffix == ".json" or config.report):
        flag = "--report" if config.report else "--output"
        raise UsageError(
            f"{flag} names one file, but there are {len(takes)} takes: give a folder as --output, or one --take"
        )
    rigs = [output / "rigs" / f"{take.id}.json" for take in takes] if many else [new_rig_file(output)]
    paths = [(rig, new_report_file(config.report, rig)) for rig in rigs]
    for folder in dict.fromkeys(path.parent for both in paths for path in both):
        require_writable(folder)
    return paths


# ------------------------------------------------------------------------------------------ corners


def _job(
    config: argparse.Namespace, take: CalibrationTake, board: Board | None, rig_path: Path, report_path: Path
) -> _Job:
    """A take with its corners, which are kept where they were found now."""
    if config.corners:
        corners = _read(config, board)
    else:
        corners = _detected(config, take, board or take.board)
        make_folder(rig_path.parent)
        path = write_corners(rig_path.with_suffix(".corners.json"), corners)
        say(f"corners: {path}")
    for warning in corners.warnings:
        say(f"note: {warning}")
    return _Job(take, corners, rig_path, report_path)


def _read(config: argparse.Namespace, board: Board | None) -> Corners:
    corners = read_corners(config.corners)
    if board is not None:
        described, found = board_points(board), corners.observations.board_points
        if described.shape != found.shape or not np.allclose(described, found, rtol=0, atol=1e-9):
            raise UsageError(
                f"{config.corners} was found on another board than the flags describe; leave them out"
            )
    if config.leave_out:
        corners = replace(corners, observations=without_cameras(corners.observations, config.leave_out))
    return corners


def _detected(config: argparse.Namespace, take: CalibrationTake, board: Board | None) -> Corners:
    if board is None:
        raise UsageError(
            "the board: describe it with --board, --squares and --square-size, or in capture.json"
        )
    began = time.perf_counter()
    options = DetectionOptions(config.search_side, config.every, config.jobs or 0)
    corners = detect_corners(take, board, options)
    seen = int((corners.observations.counts > 0).sum())
    images = seen + len(corners.unseen)
    took = time.perf_counter() - began
    say(
        f"take '{take.id}': the board is seen in {seen} of {images} images, {len(corners.observations):,} corners; "
        f"{took:.1f} s, {1e3 * took / max(images, 1):.0f} ms per image"
    )
    settings = {
        "board": _described_in_json(board),
        "search_side": options.search_side,
        "every": options.every,
    }
    return replace(corners, provenance=provenance(settings, _inputs(take)))


def _described_in_json(board: Board) -> dict[str, Any]:
    return {name: value for name, value in asdict(board).items() if value is not None}


def _inputs(take: CalibrationTake) -> dict[str, Path]:
    files = [file for of_camera in take.cameras.values() for file in of_camera]
    if take.timestamps is not None:
        files.append(take.timestamps)
    return {file.relative_to(take.folder).as_posix(): file for file in files}


# ------------------------------------------------------------------------------------------ results


def _drifts(before: _Job | None, job: _Job, found: dict[str, Calibration]) -> list[TakeDrift]:
    if before is None:
        return []
    return [TakeDrift(before.take.id, drift(found[before.take.id], found[job.take.id]))]


def _write(
    config: argparse.Namespace, job: _Job, calibration: Calibration, drifts: Sequence[TakeDrift]
) -> list[str]:
    settings = {
        "board": _described_in_json(job.corners.board) if job.corners.board else None,
        "camera_model": config.camera_model,
        "board_warp": config.board_warp,
        "backend": config.backend,
        "held_out": config.held_out,
        "leave_out": config.leave_out or [],
    }
    corners_path = config.corners or job.rig_path.with_suffix(".corners.json")
    of_pictures = (job.corners.provenance or {}).get("inputs", {})
    history = provenance(settings, {corners_path.name: corners_path})
    history["inputs"] |= of_pictures
    for path in (job.rig_path, job.report_path):
        make_folder(path.parent)
    load = image_loader(job.take, job.corners)
    report = calibration_report(job.take.id, calibration, history, load, drifts).write(job.report_path)
    rig = replace(calibration.rig(job.take.id), provenance=history)
    held_out = "too few frames" if calibration.held_out is None else f"{calibration.held_out.rms:.4f} px"
    bow = 1e3 * float(np.abs(calibration.board_warp).max())
    return [
        f"take '{job.take.id}': {len(calibration.cameras)} cameras, {len(calibration.rig_from_board)} frames, "
        f"{calibration.inliers.sum():,} corners, {1 - calibration.inliers.mean():.2%} left out",
        f"reprojection RMS {calibration.reprojection_rms:.4f} px, held out {held_out}; "
        f"{calibration.cameras[0].model}, board {f'bowed by {bow:.2f} mm' if bow else 'flat'}",
        *(f"since take '{since.since}' {_largest(since)}" for since in drifts if since.cameras),
        f"report: {report}",
        str(write_rig(job.rig_path, rig)),
    ]


def _largest(since: TakeDrift) -> str:
    worst = max(since.cameras, key=lambda camera: camera.center)
    return (
        f"'{worst.camera}' moved most: {1e3 * worst.center:.2f} mm "
        f"(± {1e3 * worst.center_deviation:.2f} mm), {worst.pixels:.2f} px in its image"
    )
