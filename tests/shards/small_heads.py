"""Small heads with random pixels: distorting cameras around a box, one view missing for every second head."""

import numpy as np

from preface.artifacts import provenance
from preface.geometry import Camera, Rigid, Similarity, Views
from preface.geometry.transforms import nearest_rotation
from preface.shards.building import build_manifest, claim, is_finished
from preface.shards.writer import Head, ShardWriter

WIDTH, HEIGHT, VIEWS = 24, 20, 4
BOX = np.array([[-0.15, -0.2, -0.14], [0.15, 0.22, 0.16]])
PER_SHARD, HEADS = 3, 5
NAMES = [f"id{number:04d}" for number in range(HEADS)]


def rig_cameras(width=WIDTH, height=HEIGHT):
    """Cameras of several models that look at the origin from a metre away, and their rig_from_camera."""
    models = [
        ("OPENCV", [2.2 * width, 2.21 * width, 0.51 * width, 0.48 * height, -0.1, 0.05, 1e-3, -2e-3]),
        ("PINHOLE", [2.0 * width, 2.1 * width, 0.5 * width, 0.5 * height]),
        (
            "FULL_OPENCV",
            [1.8 * width] * 2 + [0.5 * width, 0.5 * height, 0.1, -0.2, 1e-3, 1e-3, 0.1, 0.2, 0.1, 0.0],
        ),
        ("SIMPLE_RADIAL", [1.5 * width, 0.5 * width, 0.5 * height, -0.2]),
    ]
    cameras = [Camera(model, width, height, np.array(params)) for model, params in models]
    poses = []
    for angle in np.linspace(-0.7, 0.7, len(cameras)):
        forward = np.array([-np.sin(angle), 0.05, -np.cos(angle)])
        right = np.cross([0.0, -1.0, 0.0], forward)
        rotation = nearest_rotation(np.stack([right, np.cross(forward, right), forward], axis=1))
        poses.append(Rigid(rotation, -rotation[:, 2]))
    return cameras, poses


def alignment(number):
    """The similarity canonical_from_rig of a head."""
    angle = 0.1 * number
    rotation = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    return Similarity(1.0 + 0.01 * number, np.array(rotation), np.array([0.01, 0.02, -0.01]) * number)


def head(number, width=WIDTH, height=HEIGHT):
    """The head of a number; the last view of odd ones is missing."""
    rng = np.random.default_rng(number)
    cameras, poses = rig_cameras(width, height)
    canonical = [alignment(number).apply_to_pose(pose) for pose in poses]
    pixels = rng.integers(0, 256, (len(cameras), height, width, 4), dtype=np.uint8)
    pixels[:, :3, :, 3] = pixels[:, -2:, :, 3] = pixels[:, :, :4, 3] = 0
    names = [f"camera{view}" for view in range(len(cameras))]
    if number % 2:
        names[-1] = None
    return Head(
        identity=f"id{number:04d}",
        take="take0",
        cameras=names,
        views=Views.stack(cameras, canonical),
        pixels=pixels,
        box=BOX,
        keypoints=np.where(np.arange(15).reshape(5, 3) == 3 * number, np.nan, 0.01),
        backgrounds=["green"] * len(cameras),
        sources=[{"file": f"{name}.png", "sha256": "0" * 64} if name else None for name in names],
        metadata={"age": 30 + number},
    )


def write_shard(folder, number, order, recipe="recipe"):
    with ShardWriter(folder, number, (WIDTH, HEIGHT), order, recipe) as shard:
        for person in range(number * PER_SHARD, min((number + 1) * PER_SHARD, HEADS)):
            shard.add(head(person))


def write_dataset(folder, order, recipe="recipe"):
    """Build, or finish what was begun."""
    for number in range(2):
        with claim(folder, number) as mine:
            if mine and not is_finished(folder, number, recipe):
                write_shard(folder, number, order, recipe)
    splits = {"train": NAMES[:4], "holdout": NAMES[4:]}
    return build_manifest(folder, 2, splits, {"order": order}, provenance({}, {}))
