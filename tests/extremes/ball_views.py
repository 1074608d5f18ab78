"""Balls photographed from anywhere, as datasets of one head in the box of the tests of training."""

import math
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model" / "training"))

import ball_heads

from preface.artifacts import provenance
from preface.geometry import Camera, Views
from preface.geometry.rays import cast_rays, pixel_centers
from preface.model.rendering.paths import look_at
from preface.shards.building import build_manifest
from preface.shards.writer import Head, ShardWriter

UNSEEN, NUMBER, RADIUS = "id0003", 3, 0.124
FOCAL = 91.5  # of 24x32 pixels a metre away


def place(azimuth: float, elevation: float = 0.0, distance: float = 1.0):
    """canonical_from_camera of a camera that looks at the origin; degrees and metres."""
    a, e = math.radians(azimuth), math.radians(elevation)
    center = distance * np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
    return look_at(center, np.zeros(3))


def photograph(views: Views, width: int, height: int) -> np.ndarray:
    """The ball as each camera sees it, uint8 [V, H, W, 4]."""
    pixels = np.full((len(views.monotonic_radius), height, width, 4), ball_heads.GREY, dtype=np.uint8)
    pixels[..., 3] = 0
    for view, image in enumerate(pixels):
        rays = cast_rays(views[view], pixel_centers(width, height))
        along = -(rays.origins * rays.viewdirs).sum(-1)
        inside = along**2 - (rays.origins**2).sum(-1) + RADIUS**2
        hit = (inside > 0) & (along > 0)
        point = rays.origins + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays.viewdirs
        image[hit, :3] = np.rint(255 * ball_heads.paint(point / RADIUS, NUMBER)[hit]).clip(0, 255)
        image[hit, 3] = 255
    return pixels


def shards_of(folder: Path, poses, size=(24, 32), focal=FOCAL, change=None) -> Path:
    """A dataset of one ball in the prior's box, whose views are called view0, view1 and so on."""
    width, height = size
    camera = Camera("PINHOLE", width, height, np.array([focal, focal, width / 2, height / 2]))
    views = Views.stack([camera] * len(poses), list(poses))
    pixels = photograph(views, width, height)
    if change is not None:
        change(pixels)
    folder.mkdir()
    with ShardWriter(folder, 0, size, "raster", "ball") as shard:
        shard.add(
            Head(
                identity=UNSEEN,
                take="take0",
                cameras=[f"view{view}" for view in range(len(poses))],
                views=views,
                pixels=pixels,
                box=ball_heads.BOX,
                keypoints=np.full((5, 3), np.nan),
                backgrounds=["plate"] * len(poses),
                sources=[None] * len(poses),
            )
        )
    build_manifest(folder, 1, {"holdout": [UNSEEN]}, {}, provenance({}, {}))
    return folder


def names(count: int) -> tuple[str, ...]:
    """Of the first views of a dataset."""
    return tuple(f"view{view}" for view in range(count))


def everywhere(alpha):
    """A change of photographs: the same foreground everywhere."""

    def change(pixels):
        pixels[..., 3] = alpha

    return change


def all_of_one_color(value):
    """A change of photographs: the same colour everywhere."""

    def change(pixels):
        pixels[..., :3] = value

    return change
