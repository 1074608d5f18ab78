"""Joint solves of the reference problem by other programs, in the same run and from the same start.

pycolmap is ours already. mrcal and aniposelib are not among our requirements, and want other versions of what
is: they run under interpreters of their own. mrcal comes with Debian (`apt-get install python3-mrcal`) and is
looked for under /usr/bin/python3; for aniposelib a virtual environment is made in a temporary folder, for this
run only. A peer that is not there is reported so, and the others are measured.

Every solver gets the corners, cameras and board poses of our own start; finding the outliers is its own affair.
Wall times are of the solve alone, medians over the seeds, each solver with as many threads as it asks for.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
import venv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.calibration_scene import SceneConfig
from bench.calibration_truth import Problem, Start, bound_squares, problem, solve, squared_errors, start
from preface.capture.calibration.colmap_backend import adjust_with_colmap
from preface.capture.calibration.state import RigState
from preface.geometry import Rigid

ANIPOSELIB = "aniposelib==0.8.0"
PROBE_SECONDS, INSTALL_SECONDS, SOLVE_SECONDS = 120, 900, 1800
MAX_SEEDS = 5  # aniposelib takes most of a minute for one

Row = tuple[float, np.ndarray]  # wall seconds, mean squared errors in the order of FIGURES


class PeerError(Exception):
    """A peer that is not there, or that failed."""


def peers(seeds: int) -> None:
    """Print wall times and errors of the joint solve beside other programs', 10% outliers, same start."""
    given = [problem(SceneConfig(outliers=0.1), seed) for seed in range(min(seeds, MAX_SEEDS))]
    begins = [start(each) for each in given]
    bounds = np.sqrt(np.mean([bound_squares(each) for each in given], axis=0))
    print(
        f"\nJoint solve at 10% outliers from the same start, {len(given)} seeds, reference problem; in brackets "
        f"errors over the Cramer-Rao bound\n{'solver':>10} {'wall s':>8} {'centre mm':>18} {'focal 1e-5':>18} "
        f"{'keypoints um':>18}"
    )
    measured: dict[str, Callable[[], list[Row]]] = {
        "ours": lambda: _timed(_ours, given, begins),
        "pycolmap": lambda: _timed(_colmap, given, begins),
        "mrcal": lambda: _elsewhere(_mrcal, given, begins),
        "aniposelib": lambda: _elsewhere(_aniposelib, given, begins),
    }
    for name, measure in measured.items():
        try:
            rows = measure()
        except PeerError as error:
            print(f"{name:>10} {error}", flush=True)
            continue
        rms = np.sqrt(np.mean([errors for _, errors in rows], axis=0))
        cells = (
            f"{value:>10.4f} ({ratio:5.2f})"
            for value, ratio in zip(rms * (1e3, 1e5, 1e6), rms / bounds, strict=True)
        )
        print(f"{name:>10} {np.median([wall for wall, _ in rows]):>8.2f} {' '.join(cells)}", flush=True)


def _ours(given: Problem, begin: Start) -> RigState:
    return solve(given, begin)[0].state


def _colmap(given: Problem, begin: Start) -> RigState:
    sizes = given.scene.observations.image_sizes
    return adjust_with_colmap(begin.views, begin.state, begin.trusted, sizes).state


def _timed(run: Callable[[Problem, Start], RigState], given: list[Problem], begins: list[Start]) -> list[Row]:
    rows = []
    for each, begin in zip(given, begins, strict=True):
        began = time.perf_counter()
        state = run(each, begin)
        rows.append((time.perf_counter() - began, squared_errors(each, state)))
    return rows


# ------------------------------------------------------------------------- under other interpreters


def _elsewhere(
    run: Callable[[Path, list[Path]], None], given: list[Problem], begins: list[Start]
) -> list[Row]:
    with tempfile.TemporaryDirectory(prefix="preface-peer-") as name:
        folder = Path(name)
        paths = [folder / f"{index}.npz" for index in range(len(given))]
        for path, each, begin in zip(paths, given, begins, strict=True):
            np.savez(path, allow_pickle=False, **_exchanged(each, begin))
        run(folder, paths)
        rows = []
        for path, each, begin in zip(paths, given, begins, strict=True):
            with np.load(path.with_suffix(".solved.npz")) as found:
                poses = Rigid(found["rotation"], found["translation"])
                state = replace(begin.state, params=found["params"], camera_from_rig=poses)
                rows.append((float(found["seconds"]), squared_errors(each, state)))
    return rows


def _exchanged(given: Problem, begin: Start) -> dict[str, np.ndarray]:
    """What a peer is given; its board has its origin at the first corner."""
    views, state, config = begin.views, begin.state, given.scene.config
    boards = state.rig_from_board @ Rigid(np.eye(3), -views.center)
    return {
        "pixels": views.pixels,
        "seen": views.seen,
        "camera": views.camera,
        "frame": views.frame,
        "points": views.points + views.center,
        "shape": np.array([config.rows, config.columns]),
        "spacing": np.array(config.spacing),
        "sizes": np.array(given.scene.observations.image_sizes),
        "params": state.params,
        "camera_rotation": state.camera_from_rig.rotation,
        "camera_translation": state.camera_from_rig.translation,
        "board_rotation": boards.rotation,
        "board_translation": boards.translation,
    }


def _mrcal(folder: Path, paths: list[Path]) -> None:
    interpreter = Path("/usr/bin/python3")
    if not interpreter.exists() or _call([str(interpreter), "-c", "import mrcal"], PROBE_SECONDS).returncode:
        raise PeerError("is not installed: not measured (Debian: apt-get install python3-mrcal)")
    _solve_under(interpreter, "peer_mrcal.py", paths)


def _aniposelib(folder: Path, paths: list[Path]) -> None:
    venv.create(folder / "venv", with_pip=True)
    interpreter = folder / "venv" / "bin" / "python"
    installed = _call([str(interpreter), "-m", "pip", "install", "--quiet", ANIPOSELIB], INSTALL_SECONDS)
    if installed.returncode:
        reason = (installed.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise PeerError(f"is not installed: not measured (pip: {reason})")
    _solve_under(interpreter, "peer_aniposelib.py", paths)


def _solve_under(interpreter: Path, script: str, paths: list[Path]) -> None:
    worker = Path(__file__).with_name(script)
    done = _call([str(interpreter), str(worker), *map(str, paths)], SOLVE_SECONDS)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise PeerError(f"failed: {reason}")


def _call(command: list[str], seconds: int) -> subprocess.CompletedProcess[str]:
    environment = {
        key: value for key, value in os.environ.items() if key not in ("OMP_NUM_THREADS", "PYTHONPATH")
    }
    try:
        return subprocess.run(
            command, env=environment, timeout=seconds, capture_output=True, text=True, check=False
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", f"took longer than {seconds} s")
