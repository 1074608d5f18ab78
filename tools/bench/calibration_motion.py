"""What letting the board move within frames gains, where cameras are not triggered together.

    python tools/bench/calibration_motion.py [--seeds 20]

Four cameras of 1280x720 pixels see a board that is waved about at up to 0.15 m/s and 0.5 rad/s, each a random
time before or after the frame. RMS errors against the truth, over cameras and seeds, of two solutions from the
same start: rigid (the board stands still in each frame; moving views are outliers) and moving (each view has a
pose of its own near its frame's, see `preface.capture.calibration.motion`). With no lag both are the same problem.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.calibration_scene import Scene, SceneConfig, simulate
from preface.capture.calibration.adjustment import Adjusted, adjust_robustly
from preface.capture.calibration.initial import FLEXIBLE_MODEL, calibrate_alone, sigma_alone
from preface.capture.calibration.spanning_tree import assemble
from preface.capture.calibration.state import free_head
from preface.capture.calibration.unsynchronised import adjust_moving, unsynchronised
from preface.capture.calibration.views import stack_views
from preface.cli.usage import Parser
from preface.geometry import fit_similarity

SCENE = SceneConfig(
    cameras=4,
    frames=50,
    width=1280,
    height=720,
    focal=750,
    columns=3,
    rows=4,
    spacing=0.054,
    distance=0.9,
    noise=0.05,
    outliers=0.02,
)
LAGS = (0.0, 0.005, 0.02, 0.05)  # seconds, standard deviation


def main() -> None:
    """Print a table: lag, how often it was noticed, and the errors of both solutions."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    print("lag ms   noticed   centre mm: rigid  moving   focal %: rigid  moving")
    for lag in LAGS:
        noticed, errors = zip(
            *(_compare(replace(SCENE, lag=lag), seed) for seed in range(seeds)), strict=True
        )
        (centre, focal), (centre_moving, focal_moving) = np.sqrt((np.array(errors) ** 2).mean(axis=0))
        print(
            f"{1e3 * lag:6.0f}   {sum(noticed):3d}/{seeds:<3d}   {1e3 * centre:16.3f} {1e3 * centre_moving:7.3f}"
            f"   {100 * focal:14.3f} {100 * focal_moving:7.3f}"
        )


def _compare(config: SceneConfig, seed: int) -> tuple[bool, list[tuple[float, float]]]:
    scene = simulate(config, seed)
    seen = scene.observations
    views, _ = stack_views(seen)
    alone = calibrate_alone(views, seen.camera_ids, seen.image_sizes, {})
    rough, trusted = assemble(alone, seen.camera_ids, seen.image_sizes)
    start = rough.as_model(FLEXIBLE_MODEL)
    free = free_head(start)
    rigid = adjust_robustly(alone.views, start, trusted, free)
    moving = adjust_moving(alone, start, trusted, free)
    return unsynchronised(rigid, trusted, sigma_alone(alone)), [_errors(rigid, scene), _errors(moving, scene)]


def _errors(found: Adjusted, scene: Scene) -> tuple[float, float]:
    """RMS error of the camera centres after a rigid fit, metres, and of the focal lengths, relative."""
    centers = found.state.camera_from_rig.inverse.translation
    fit = fit_similarity(centers, scene.camera_from_rig.inverse.translation, fixed_scale=1.0)
    true = np.stack([camera.params[:2] for camera in scene.cameras])
    return fit.rms, float(np.sqrt(((found.state.params[:, :2] / true - 1) ** 2).mean()))


if __name__ == "__main__":
    main()
