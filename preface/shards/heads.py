"""Heads and cameras out of a dataset, as they were written: to look through them, or to write them again otherwise.

    camera, canonical_from_camera = standing(dataset, 3, 0)
    head = head_of(dataset, 3, [0, 4])                       # dataclasses.replace, and ShardWriter takes it

Apart from the reader, which does without `preface.geometry`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from preface.geometry import Camera, Rigid, Views
from preface.shards.format import BACKGROUND_KINDS
from preface.shards.reader import Dataset
from preface.shards.writer import Head


def standing(dataset: Dataset, identity: int, view: int) -> tuple[Camera, Rigid]:
    """The lens of a view that there is, and its pose canonical_from_camera, metres."""
    manifest, tables = dataset.manifest, dataset.tables
    camera = Camera("FULL_OPENCV", manifest.width, manifest.height, tables["intrinsics"][identity, view])
    pose = tables["canonical_from_camera"][identity, view]
    return camera, Rigid(pose[:, :3], pose[:, 3])


def head_of(dataset: Dataset, identity: int, views: Sequence[int]) -> Head:
    """Some views of an identity, in the order given; one that is missing stays missing.

    Raises:
        ArtifactError: pixels are not what was written, or cannot be read.
    """
    tables, entry = dataset.tables, dataset.manifest.identities[identity]
    valid = tables["view_valid"][identity] == 1
    # A missing view gets the camera and the pixels of one that there is, and is written as missing.
    some = int(np.flatnonzero(valid)[0])
    there = [view if valid[view] else some for view in views]
    cameras, poses = zip(*(standing(dataset, identity, view) for view in there), strict=True)
    return Head(
        identity=entry.identity,
        take=entry.take,
        cameras=[entry.cameras[view] for view in views],
        views=Views.stack(cameras, poses),
        pixels=np.stack([dataset.pixels(identity, view) for view in there]),
        box=tables["box"][identity],
        keypoints=tables["keypoints"][identity],
        backgrounds=[BACKGROUND_KINDS[kind] for kind in tables["background_kind"][identity, there]],
        sources=[entry.sources[view] for view in views],
        metadata=entry.metadata,
    )
