"""How accurate the rig calibration is: against truth, in units of the Cramer-Rao bound, and beside its peers.

    python tools/bench/calibration_accuracy.py [--seeds 20] [--only accuracy bow uncertainty peers]

The problem is the reference rig of `calibration_scene`. The bound is the covariance of the normal equations
at the truth over the sightings that are no outliers, with the true noise. Rigs have no frame of their own:
the estimate is turned and shifted, but not scaled, so that its camera centres lie nearest to the true ones,
and the bound is taken under the same condition. Keypoints are triangulated from exact images.

  accuracy     20 seeds for each share of outliers and each noise: RMS error over the RMS of the bound
  bow          the same for a board that bulges by 1 mm, its shape solved for, over the flat board's error
  uncertainty  predicted standard deviations over those of a Monte Carlo simulation
  peers        pycolmap's rig adjustment and, where importable, aniposelib and mrcal, from the same start
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

# At these sizes the threads of the BLAS cost more than they bring, the more so on a busy machine.
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.calibration_scene import Scene, SceneConfig, exact_pixels, noisy_again, simulate
from preface.capture.calibration.adjustment import Adjusted, adjust_robustly, least_squares
from preface.capture.calibration.colmap_backend import adjust_with_colmap
from preface.capture.calibration.covariance import Uncertainty, points_by_head, uncertainty
from preface.capture.calibration.initial import calibrate_alone
from preface.capture.calibration.spanning_tree import assemble
from preface.capture.calibration.state import RigState, free_head
from preface.capture.calibration.views import BoardViews, stack_views
from preface.geometry import Camera, Rigid, fit_similarity, lens

FIGURES = ("camera centre", "focal length", "keypoints")


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene, arranged for the solver."""

    scene: Scene
    views: BoardViews
    view_of: np.ndarray
    warp: bool

    @property
    def truth(self) -> RigState:
        """The true state."""
        boards = self.scene.rig_from_board @ Rigid(np.eye(3), self.views.center)
        params = np.stack([camera.params for camera in self.scene.cameras])
        return RigState("OPENCV", params, self.scene.camera_from_rig, boards, np.array(self.scene.config.bow))

    @property
    def good(self) -> np.ndarray:
        """Sightings [V, P] that are no outliers."""
        mask = np.zeros_like(self.views.seen)
        mask[self.view_of, self.scene.observations.point] = ~self.scene.outlier
        return mask


@dataclass(frozen=True, eq=False)
class Start:
    """Where a joint solve starts."""

    views: BoardViews
    state: RigState
    trusted: np.ndarray
    seconds: float


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = {"accuracy": accuracy, "bow": bow, "uncertainty": monte_carlo, "peers": peers}
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts))
    arguments = parser.parse_args()
    for name in arguments.only:
        parts[name](arguments.seeds)


def problem(config: SceneConfig, seed: int, warp: bool = False) -> Problem:
    """Simulate and arrange."""
    scene = simulate(config, seed)
    return Problem(scene, *stack_views(scene.observations), warp)


def start(given: Problem) -> Start:
    """Everything before the joint solve."""
    began = time.perf_counter()
    seen = given.scene.observations
    alone = calibrate_alone(given.views, seen.camera_ids, seen.image_sizes)
    state, trusted = assemble(alone, seen.camera_ids, seen.image_sizes)
    return Start(alone.views, state.as_model("OPENCV"), trusted, time.perf_counter() - began)


def solve(given: Problem, begin: Start) -> tuple[Adjusted, float]:
    """The joint solve, and its wall time."""
    began = time.perf_counter()
    free = free_head(begin.state, warp=given.warp)
    found = adjust_robustly(begin.views, begin.state, begin.trusted, free)
    return found, time.perf_counter() - began


def bound(given: Problem) -> Uncertainty:
    """The Cramer-Rao bound over the good sightings, the camera centres held still."""
    state = given.truth
    free = free_head(state, warp=given.warp)
    ids = given.scene.observations.camera_ids
    return uncertainty(given.views, state, given.good, free, ids, sigma=given.scene.config.noise).under(
        "cameras"
    )


def bound_squares(given: Problem) -> np.ndarray:
    """Mean squared errors [3] that the bound allows, in the order of `FIGURES`."""
    known = bound(given)
    points = given.scene.keypoints
    visible = np.ones((len(points), len(given.scene.cameras)), bool)
    by_head, _ = points_by_head(known.state, points, visible)
    keypoints = by_head @ known.head @ np.swapaxes(by_head, -1, -2)
    focal = known.standard_deviations[0][:, :2] / known.state.params[:, :2]
    return np.array([_mean_trace(known.centers()), (focal**2).mean(), _mean_trace(keypoints)])


def squared_errors(given: Problem, state: RigState) -> np.ndarray:
    """Mean squared errors [3] against truth, metres² or relative, in the order of `FIGURES`."""
    truth = given.truth
    centers, true_centers = (s.camera_from_rig.inverse.translation for s in (state, truth))
    align = fit_similarity(centers, true_centers, fixed_scale=1.0).target_from_source
    focal = state.params[:, :2] / truth.params[:, :2] - 1
    found = triangulated(truth, state, given.scene.keypoints)
    return np.array(
        [
            ((align.apply(centers) - true_centers) ** 2).sum(-1).mean(),
            (focal**2).mean(),
            ((align.apply(found) - given.scene.keypoints) ** 2).sum(-1).mean(),
        ]
    )


def triangulated(truth: RigState, state: RigState, points: np.ndarray) -> np.ndarray:
    """Where a rig sees points [N, 3] whose images are exact: Gauss-Newton from the true places."""
    exact = []
    for params, pose in zip(truth.params, _each(truth.camera_from_rig), strict=True):
        exact.append(Camera("OPENCV", 1, 1, params).project(pose.apply(points))[0])
    found = points.copy()
    for _ in range(10):
        normal, gradient = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for params, pose, pixels in zip(state.params, _each(state.camera_from_rig), exact, strict=True):
            camera = Camera("OPENCV", 1, 1, params)
            radius = np.asarray(camera.monotonic_radius)
            by_point, _ = lens.projection_jacobians(camera.intrinsics, radius, pose.apply(found))
            by_point = by_point @ pose.rotation
            residual = camera.project(pose.apply(found))[0] - pixels
            normal += np.swapaxes(by_point, -1, -2) @ by_point
            gradient += (np.swapaxes(by_point, -1, -2) @ residual[..., None])[..., 0]
        found = found - np.linalg.solve(normal, gradient[..., None])[..., 0]
    return found


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


def peers(seeds: int) -> None:
    """Print wall times and errors of the joint solve beside other programs', 10% outliers, same start."""
    solvers: dict[str, Callable[[Problem, Start], RigState]] = {
        "ours": lambda given, begin: solve(given, begin)[0].state,
        "pycolmap": lambda given, begin: (
            adjust_with_colmap(
                begin.views, begin.state, begin.trusted, given.scene.observations.image_sizes
            ).state
        ),
    }
    runs = min(seeds, 5)
    print(f"\nJoint solve at 10% outliers from the same start, {runs} seeds, reference problem")
    for absent in ("aniposelib", "mrcal"):
        if importlib.util.find_spec(absent) is None:
            print(f"  {absent} is not installed: not measured")
    print(f"{'solver':>10} {'wall s':>8} {'centre mm':>10} {'keypts um':>10}")
    rows: dict[str, list[tuple[float, np.ndarray]]] = {name: [] for name in solvers}
    for seed in range(runs):
        given = problem(SceneConfig(outliers=0.1), seed)
        begin = start(given)
        for name, run in solvers.items():
            began = time.perf_counter()
            state = run(given, begin)
            rows[name].append((time.perf_counter() - began, squared_errors(given, state)))
    for name, measured in rows.items():
        rms = np.sqrt(np.mean([errors for _, errors in measured], axis=0))
        wall = np.median([seconds for seconds, _ in measured])
        print(f"{name:>10} {wall:>8.2f} {rms[0] * 1e3:>10.4f} {rms[2] * 1e6:>10.2f}")


def _each(poses: Rigid) -> list[Rigid]:
    return [Rigid(r, t) for r, t in zip(poses.rotation, poses.translation, strict=True)]


def _mean_trace(covariances: np.ndarray) -> float:
    return float(np.trace(covariances, axis1=-2, axis2=-1).mean())


def _kept_views(views: BoardViews, kept: BoardViews) -> np.ndarray:
    """Index among all views of those kept."""
    key = views.camera * views.frames + views.frame
    return np.searchsorted(key, kept.camera * kept.frames + kept.frame)


if __name__ == "__main__":
    main()
