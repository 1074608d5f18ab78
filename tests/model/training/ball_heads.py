"""Heads made of balls, in closed form: something that a small model learns in seconds.

A head is a ball of skin with two eyes, a nose and a cap of hair, painted by direction; identities differ in size and
colours. Pixels are ray casts of their centres, on grey, with the ball's silhouette as foreground.
"""

from pathlib import Path

import numpy as np

from preface.artifacts import provenance
from preface.geometry import Camera, Rigid, Views
from preface.geometry.rays import cast_rays, pixel_centers
from preface.geometry.transforms import nearest_rotation
from preface.shards.building import build_manifest
from preface.shards.writer import Head, ShardWriter

WIDTH, HEIGHT, VIEWS, HEADS = 24, 32, 6, 4
BOX = np.array([[-0.13, -0.15, -0.13], [0.13, 0.15, 0.13]])
GREY = 90


def poses(views=VIEWS):
    """world_from_camera on an arc around the front, a metre away, looking at the origin."""
    found = []
    for number, angle in enumerate(np.linspace(-0.8, 0.8, views)):
        height = 0.15 * (-1) ** number
        center = np.array([np.sin(angle), height, np.cos(angle)])
        forward = -center / np.linalg.norm(center)
        right = np.cross([0.0, -1.0, 0.0], forward)
        rotation = nearest_rotation(np.stack([right, np.cross(forward, right), forward], axis=1))
        found.append(Rigid(rotation, center))
    return found


def paint(directions, number):
    """Colours [..., 3] of a head's surface by direction from its centre."""
    rng = np.random.default_rng(number)
    skin, hair, eyes = (
        rng.uniform([0.5, 0.35, 0.3], [0.95, 0.7, 0.6]),
        rng.uniform(0, 0.5, 3),
        rng.uniform(0, 1, 3),
    )
    x, y, z = np.moveaxis(directions, -1, 0)
    color = np.broadcast_to(skin, directions.shape) * (0.75 + 0.25 * y[..., None])
    for side in (-1, 1):
        eye = (x - 0.35 * side) ** 2 + (y - 0.2) ** 2 < 0.02
        color = np.where((eye & (z > 0))[..., None], eyes, color)
    mouth = (np.abs(x) < 0.3) & (np.abs(y + 0.45) < 0.08) & (z > 0)
    color = np.where(mouth[..., None], [0.7, 0.1, 0.15], color)
    return np.where((y > 0.55)[..., None], hair, color)


def photograph(views, number):
    """Pixels [V, H, W, 4] of a head."""
    radius = 0.1 + 0.008 * (number % 4)
    pixels = np.full((len(views.monotonic_radius), HEIGHT, WIDTH, 4), GREY, dtype=np.uint8)
    pixels[..., 3] = 0
    for view, image in enumerate(pixels):
        rays = cast_rays(views[view], pixel_centers(WIDTH, HEIGHT))
        along = (rays.origins * rays.viewdirs).sum(-1)
        inside = along**2 - (rays.origins**2).sum(-1) + radius**2
        hit = inside > 0
        point = rays.origins + (-along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays.viewdirs
        color = paint(point / radius, number)
        image[hit, :3] = np.rint(255 * color[hit]).clip(0, 255)
        image[hit, 3] = 255
    return pixels


def head(number, foreground=True):
    camera = Camera(
        "PINHOLE", WIDTH, HEIGHT, np.array([1.1 * HEIGHT * 2.6, 1.1 * HEIGHT * 2.6, WIDTH / 2, HEIGHT / 2])
    )
    views = Views.stack([camera] * VIEWS, poses())
    pixels = photograph(views, number)
    if not foreground:
        pixels[..., 3] = 0
    names = [f"camera{view}" for view in range(VIEWS)]
    return Head(
        identity=f"id{number:04d}",
        take="take0",
        cameras=names,
        views=views,
        pixels=pixels,
        box=BOX,
        keypoints=np.full((5, 3), np.nan),
        backgrounds=["plate"] * VIEWS,
        sources=[{"file": f"{name}.png", "sha256": "0" * 64} for name in names],
        metadata={},
    )


def write_dataset(folder: Path, heads=HEADS, order="raster", without_foreground=()):
    """One shard; the last identity is held out."""
    with ShardWriter(folder, 0, (WIDTH, HEIGHT), order, "balls") as shard:
        for number in range(heads):
            shard.add(head(number, number not in without_foreground))
    names = [f"id{number:04d}" for number in range(heads)]
    return build_manifest(folder, 1, {"train": names[:-1], "holdout": names[-1:]}, {}, provenance({}, {}))
