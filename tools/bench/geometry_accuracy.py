"""How exact the geometry layer is: distortion round trips, and float32 rays against float64 ones.

    python tools/bench/geometry_accuracy.py [--device cuda]

Prints a table each; takes a minute or two on one core.
"""

import argparse
from collections.abc import Iterator

import numpy as np
import torch

from preface.cli.usage import Parser
from preface.geometry import CAMERA_MODELS, Camera, Rigid, Views, cast_rays, lens, stack_intrinsics
from preface.geometry.transforms import nearest_rotation

WIDTH, HEIGHT = 4096, 6144
FRACTIONS = (0.5, 0.9, 0.99, 0.9999, 0.999999)


def main() -> None:
    """Measure and print."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=300, help="random cameras per model and strength")
    parser.add_argument("--points", type=int, default=200, help="random points per camera")
    parser.add_argument("--stride", type=int, default=8, help="grid spacing of the ray comparison, pixels")
    parser.add_argument("--device", default="cpu", help="torch device of the ray comparison")
    arguments = parser.parse_args()
    print_round_trips(arguments.cameras, arguments.points)
    print_ray_precision(arguments.stride, arguments.device)


def random_camera(model: str, strength: float, rng: np.random.Generator) -> Camera:
    """Draw a camera whose distortion is a few times `strength` at the image's corner, folding or not."""
    focal = HEIGHT * 10 ** rng.uniform(-0.2, 1.0)
    corner = np.hypot(WIDTH, HEIGHT) / 2 / focal
    center = {"cx": rng.uniform(0.4, 0.6) * WIDTH, "cy": rng.uniform(0.4, 0.6) * HEIGHT}
    degree = {"k": 2, "k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6, "p1": 1, "p2": 1}
    params = []
    for name in CAMERA_MODELS[model]:
        if name in center:
            params.append(center[name])
        elif name in degree:
            size = strength / 30 if name in ("p1", "p2") else strength
            params.append(rng.normal() * size / corner ** degree[name])
        else:
            params.append(focal * rng.uniform(0.98, 1.02))
    return Camera(model, WIDTH, HEIGHT, np.array(params))


def print_round_trips(cameras: int, points: int) -> None:
    """Worst errors of project and unproject composed either way, by distance to the end of the lens."""
    rng = np.random.default_rng(0)
    print(f"Round trips in float64, {WIDTH}x{HEIGHT}, focal lengths 0.6 to 10 image heights")
    print("radius: share of the monotonic radius; of three times the image's half diagonal if that is less")
    print(
        "pixel: |project(unproject(p)) - p|, px    point: f |unproject(project(x)) - x|, px    lost: masked"
    )
    print(f"{'model':>14} {'distortion':>10} {'radius':>9} {'pixel':>9} {'point':>9} {'lost':>6}")
    for model in CAMERA_MODELS:
        for strength in (0.0,) if model == "PINHOLE" else (0.01, 0.1, 1.0):
            batch = [random_camera(model, strength, rng) for _ in range(cameras)]
            for fraction in FRACTIONS:
                pixel, point, lost = round_trip(batch, fraction, points, rng)
                print(f"{model:>14} {strength:>10} {fraction:>9} {pixel:>9.1e} {point:>9.1e} {lost:>6}")


def round_trip(
    batch: list[Camera], fraction: float, points: int, rng: np.random.Generator
) -> tuple[float, float, int]:
    """Return both worst errors and the number of points lost, at radii up to `fraction` of the usable one."""
    intrinsics, radius = (array[:, None] for array in stack_intrinsics(batch))
    half_diagonal = np.hypot(WIDTH, HEIGHT) / 2 / intrinsics[..., 0]
    shape = (len(batch), points)
    share = np.where(rng.random(shape) < 0.5, 1, np.sqrt(rng.random(shape)))
    r, angle = fraction * np.minimum(radius, 3 * half_diagonal) * share, rng.uniform(0, 2 * np.pi, shape)
    x = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)
    pixels, _ = lens.project(intrinsics, radius, np.concatenate([x, np.ones_like(x[..., :1])], axis=-1))
    # Next to a pole pixels are anywhere up to 1e12; those on and around the image are of interest.
    near_image = (np.abs(pixels - (WIDTH / 2, HEIGHT / 2)) < 2 * HEIGHT).all(-1)
    back, _, valid = lens.unproject(intrinsics, radius, pixels)
    again, _ = lens.project(intrinsics, radius, np.concatenate([back, np.ones_like(x[..., :1])], axis=-1))
    keep = near_image & valid
    return (
        np.linalg.norm(again - pixels, axis=-1)[keep].max(),
        (np.linalg.norm(back - x, axis=-1) * intrinsics[..., 0])[keep].max(),
        int((near_image & ~valid).sum()),
    )


def ray_cameras() -> Iterator[tuple[str, Camera]]:
    """Yield cameras that do not fold inside the image, from wide to very long lenses."""
    for focal in (4000.0, 13500.0, 40000.0, 100000.0):
        corner = np.hypot(WIDTH, HEIGHT) / 2 / focal
        for bend in (-0.15, 0.0, 0.15):
            k1, k2, p = bend / corner**2, -bend / 5 / corner**4, 1e-3 / corner
            params = [focal, 1.01 * focal, 2051.37, 3068.91, k1, k2, p, -p]
            yield (
                f"f {focal:.0f} px, {bend:+.0%} at the corner",
                Camera("OPENCV", WIDTH, HEIGHT, np.array(params)),
            )


def print_ray_precision(stride: int, device: str) -> None:
    """Worst error of float32 directions: where they hit the float64 camera's image, against the pixel."""
    rng = np.random.default_rng(1)
    x = np.append(np.arange(0.5, WIDTH, stride), WIDTH - 0.5)
    y = np.append(np.arange(0.5, HEIGHT, stride), HEIGHT - 0.5)
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    print(
        f"\nRay directions, torch float32 on {device} against numpy float64, {WIDTH}x{HEIGHT}: "
        f"{pixels.size // 2} pixels, corners included"
    )
    print(f"{'camera':>34} {'worst px':>9} {'mean px':>9} {'radii':>9} {'masked':>6}")
    for name, camera in ray_cameras():
        pose = Rigid(nearest_rotation(rng.normal(size=(3, 3))), rng.normal(size=3))
        views = Views.stack([camera], [pose])
        exact = cast_rays(views[0], pixels)
        single = views.map(lambda array: torch.tensor(array, dtype=torch.float32, device=device))
        rays = cast_rays(single[0], torch.tensor(pixels, dtype=torch.float32, device=device))
        directions = rays.directions.cpu().double().numpy() @ pose.rotation
        hit, _ = camera.project(directions)
        aimed, _ = camera.project(exact.directions @ pose.rotation)
        error = np.linalg.norm(hit - aimed, axis=-1)
        radii = np.abs(rays.radii.cpu().double().numpy() / exact.radii - 1).max()
        masked = int((~exact.valid).sum() + (~rays.valid).sum())
        print(f"{name:>34} {error.max():>9.5f} {error.mean():>9.5f} {radii:>9.1e} {masked:>6}")


if __name__ == "__main__":
    main()
