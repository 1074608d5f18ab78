"""How accurate the rig calibration is: against truth, in units of the Cramer-Rao bound, and beside its peers.

    python tools/bench/calibration_accuracy.py [--seeds 20] [--only accuracy bow uncertainty peers]

The problem is the reference rig of `calibration_scene`; errors and their bound are those of `calibration_truth`.

  accuracy     20 seeds for each share of outliers and each noise: RMS error over the RMS of the bound
  bow          the same for a board that bulges by 1 mm, its shape solved for, over the flat board's error
  uncertainty  predicted standard deviations over those of a Monte Carlo simulation
  peers        pycolmap's rig adjustment, aniposelib and mrcal, from the same start (see `calibration_peers`)
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

# At these sizes the threads of the BLAS cost more than they bring, the more so on a busy machine.
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.calibration_peers import peers
from bench.calibration_scene import SceneConfig, exact_pixels, noisy_again
from bench.calibration_truth import (
    FIGURES,
    Problem,
    Start,
    bound_squares,
    problem,
    solve,
    squared_errors,
    start,
    triangulated,
)
from preface.capture.calibration.adjustment import Adjusted, least_squares
from preface.capture.calibration.covariance import Uncertainty, uncertainty
from preface.capture.calibration.state import free_head
from preface.capture.calibration.views import BoardViews, stack_views
from preface.cli.usage import Parser
from preface.geometry import fit_similarity


def main() -> None:
    """Measure and print."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {"accuracy": accuracy, "bow": bow, "uncertainty": monte_carlo, "peers": peers}
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts))
    arguments = parser.parse_args()
    for name in arguments.only:
        parts[name](arguments.seeds)


def accuracy(seeds: int) -> None:
    """Print errors over the bound for every share of outliers and every noise."""
    print(f"\nAccuracy over {seeds} seeds: RMS error / RMS of the Cramer-Rao bound")
    print(
        f"{'outliers':>8} {'noise px':>8} {'views':>6} {'corners':>8} {'centre mm':>10} {'ratio':>6} "
        f"{'focal 1e-5':>10} {'ratio':>6} {'keypts um':>10} {'ratio':>6} {'found':>8} {'lost':>8} {'start s':>8} "
        f"{'joint s':>8} {'worst':>6}"
    )
    for share in (0.0, 0.02, 0.1):
        for noise in (0.1, 0.2, 0.3):
            measure(SceneConfig(outliers=share, noise=noise), seeds, warp=False)


def measure(config: SceneConfig, seeds: int, warp: bool) -> np.ndarray:
    """Print one line of the accuracy table and return the RMS errors [3]."""
    errors, bounds, seconds, before, outcomes, sizes = [], [], [], [], [], []
    for seed in range(seeds):
        given = problem(config, seed, warp)
        begin = start(given)
        found, took = solve(given, begin)
        errors.append(squared_errors(given, found.state))
        bounds.append(bound_squares(given))
        seconds.append(took)
        before.append(begin.seconds)
        outcomes.append(confusion(given, begin, found))
        sizes.append((len(given.views), len(given.scene.observations)))
    rms, limit = np.sqrt(np.mean(errors, axis=0)), np.sqrt(np.mean(bounds, axis=0))
    outliers, missed, good, lost = np.sum(outcomes, axis=0)
    ratio = rms / limit
    views, corners = np.mean(sizes, axis=0)
    share = f"{1 - missed / outliers:.3%}" if outliers else "-"
    print(
        f"{config.outliers:>8.0%} {config.noise:>8} {views:>6.0f} {corners:>8.0f} {rms[0] * 1e3:>10.4f} "
        f"{ratio[0]:>6.3f} {rms[1] * 1e5:>10.3f} {ratio[1]:>6.3f} {rms[2] * 1e6:>10.2f} {ratio[2]:>6.3f} "
        f"{share:>8} {lost / good:>8.3%} {np.median(before):>8.2f} {np.median(seconds):>8.2f} {max(seconds):>6.2f}",
        flush=True,
    )
    return rms


def confusion(given: Problem, begin: Start, found: Adjusted) -> tuple[int, int, int, int]:
    """Return the numbers of outliers, of those kept, of good sightings, and of those left out."""
    good = given.good[_kept_views(given.views, begin.views)]
    seen = begin.views.seen
    dropped = int(given.good.sum() - good.sum())
    outliers = int((given.views.seen & ~given.good).sum())
    return (
        outliers,
        int((found.used & ~good).sum()),
        int(given.good.sum()),
        int((seen & good & ~found.used).sum()) + dropped,
    )


def bow(seeds: int) -> None:
    """Print the errors with a bowed board over those with a flat one."""
    print(
        f"\nBoard bowed by 1 mm along x and half along y, its shape solved for; {seeds} seeds, columns as above"
    )
    flat = measure(SceneConfig(), seeds, warp=False)
    bowed = measure(SceneConfig(bow=(1e-3, 5e-4)), seeds, warp=True)
    ratios = ", ".join(f"{name} {r:.3f}" for name, r in zip(FIGURES, bowed / flat, strict=True))
    print(f"bowed over flat: {ratios}")


def monte_carlo(seeds: int) -> None:
    """Print predicted over simulated standard deviations, one rig with ten times as many noises as seeds."""
    runs = 10 * seeds
    config = SceneConfig(cameras=5, frames=20, azimuth=50, partial=0.3)
    given = problem(config, 0)
    exact = replace(
        given.scene, observations=replace(given.scene.observations, pixels=exact_pixels(given.scene))
    )
    true_centers = given.truth.camera_from_rig.inverse.translation
    deviations: dict[str, list[np.ndarray]] = {
        name: [] for name in ("params", "centre", "keypoints", "first")
    }
    predicted = []
    for run in range(runs):
        scene = noisy_again(exact, run)
        again = Problem(scene, *stack_views(scene.observations), warp=False)
        found = least_squares(again.views, given.truth, again.views.seen, free_head(given.truth))
        state = found.state
        centers = state.camera_from_rig.inverse.translation
        align = fit_similarity(centers, true_centers, fixed_scale=1.0).target_from_source
        deviations["params"].append(state.params - given.truth.params)
        deviations["centre"].append(align.apply(centers) - true_centers)
        points = triangulated(given.truth, state, given.scene.keypoints)
        deviations["keypoints"].append(align.apply(points) - given.scene.keypoints)
        deviations["first"].append(
            state.camera_from_rig.translation[1:] - given.truth.camera_from_rig.translation[1:]
        )
        if run < seeds:
            free = free_head(state)
            predicted.append(uncertainty(again.views, state, found.used, free, scene.observations.camera_ids))
    print(
        f"\nPredicted over simulated standard deviations: {config.cameras} cameras, {config.frames} frames, {runs} runs"
    )
    simulated = {name: np.sqrt(np.mean(np.square(values), axis=0)) for name, values in deviations.items()}
    stated = _predicted_deviations(given, predicted)
    for name, label in (
        ("params", "intrinsics"),
        ("first", "translations (datum: first camera)"),
        ("centre", "camera centres (datum: cameras)"),
        ("keypoints", "keypoints (datum: cameras)"),
    ):
        ratio = stated[name] / simulated[name]
        print(
            f"{label:>36}: median {np.median(ratio):.3f}, all within [{ratio.min():.3f}, {ratio.max():.3f}]"
        )


def _predicted_deviations(given: Problem, predicted: list[Uncertainty]) -> dict[str, np.ndarray]:
    """Mean predicted standard deviations, of what `monte_carlo` simulates."""
    points = given.scene.keypoints
    visible = np.ones((len(points), len(given.scene.cameras)), bool)
    collected: dict[str, list[np.ndarray]] = {"params": [], "centre": [], "keypoints": [], "first": []}
    for known in predicted:
        params, _, translations = known.standard_deviations
        still = known.under("cameras")
        collected["params"].append(params)
        collected["first"].append(translations[1:])
        collected["centre"].append(np.sqrt(np.diagonal(still.centers(), axis1=1, axis2=2)))
        calibration, _ = still.points(points, visible, 0.0)
        collected["keypoints"].append(np.sqrt(np.diagonal(calibration, axis1=1, axis2=2)))
    return {name: np.mean(values, axis=0) for name, values in collected.items()}


def _kept_views(views: BoardViews, kept: BoardViews) -> np.ndarray:
    """Index among all views of those kept."""
    key = views.camera * views.frames + views.frame
    return np.searchsorted(key, kept.camera * kept.frames + kept.frame)


if __name__ == "__main__":
    main()
