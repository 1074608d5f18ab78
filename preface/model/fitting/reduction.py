"""Views at the prior's resolution, for inversion: a dataset of one identity, made by the shards' own writer.

Pixels are means over areas, in light and weighted by the mask, as the shards themselves are made of photographs; the
mask is the mean of masks. Cameras are scaled exactly: pixel coordinates are continuous.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from preface.artifacts import ArtifactError, provenance
from preface.geometry import Camera
from preface.geometry.cameras import stack_intrinsics
from preface.model.training.data import TrainingData
from preface.shards import Dataset
from preface.shards.building import build_manifest, claim, is_finished
from preface.shards.heads import head_of
from preface.shards.manifest import MANIFEST_FILE
from preface.shards.writer import Head, ShardWriter
from preface.srgb import encode, light_of_levels

FOLDER = "inversion_views"


def reduced_size(size: tuple[int, int], prior: tuple[int, int]) -> tuple[int, int]:
    """The width and height of views that are reduced to as many pixels as a prior's images have.

    The aspect is kept, to whole pixels; views that are not larger stay as they are.
    """
    width, height = size
    factor = math.sqrt(prior[0] * prior[1] / (width * height))
    if factor >= 1:
        return size
    return max(1, round(width * factor)), max(1, round(height * factor))


def reduce_views(data: TrainingData, size: tuple[int, int], folder: Path) -> Path:
    """Write the views fitted to at a smaller size, unless they are there already.

    Args:
        data: of one identity.
        size: width and height, pixels, none larger than the views'.
        folder: for the dataset, made if absent.

    Returns:
        The path of its manifest.

    Raises:
        ArtifactError: pixels cannot be read, or the folder not be written.
    """
    history = {
        "views": data.dataset.manifest.path.name,
        "identity": data.names[0],
        "numbers": data.train.pairs[:, 1].tolist(),
        "size": list(size),
    }
    made = provenance(history, {"manifest.json": data.dataset.manifest.path})
    recipe = hashlib.sha256(json.dumps([history, made["inputs"]]).encode()).hexdigest()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArtifactError.from_os(folder, "writing", error) from error
    with claim(folder, 0):
        if is_finished(folder, 0, recipe) and (folder / MANIFEST_FILE).exists():
            return folder / MANIFEST_FILE
        with ShardWriter(folder, 0, size, "raster", recipe) as shard:
            person, views = int(data.train.identities[0]), data.train.pairs[:, 1].tolist()
            shard.add(replace(reduced_head(data.dataset, person, views, size), metadata={}))
    return build_manifest(folder, 1, {"fit": [data.names[0]]}, history, made)


def reduced_head(dataset: Dataset, person: int, views: Sequence[int], size: tuple[int, int]) -> Head:
    """Some views of an identity at a smaller size, none larger than the dataset's.

    Raises:
        ArtifactError: pixels cannot be read.
    """
    head, manifest = head_of(dataset, person, views), dataset.manifest
    lenses = [Camera("FULL_OPENCV", manifest.width, manifest.height, i) for i in head.views.intrinsics]
    intrinsics, radius = stack_intrinsics([lens.resized(*size) for lens in lenses])
    return replace(
        head,
        views=replace(head.views, intrinsics=intrinsics, monotonic_radius=radius),
        pixels=np.stack([reduce_pixels(pixels, size) for pixels in head.pixels]),
    )


def reduce_pixels(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Reduce an image with its mask.

    Args:
        pixels: uint8 [H, W, 4], sRGB-encoded colours, not premultiplied, and foreground share.
        size: width and height, none larger than the image's.

    Returns:
        uint8 [h, w, 4]. Where nothing is foreground, colours are plain means.
    """
    alpha = pixels[..., 3:].astype(np.float32) / 255
    light = light_of_levels(pixels.dtype)[pixels[..., :3]]
    mask = _area_means(alpha, size)
    weighted, plain = _area_means(light * alpha, size), _area_means(light, size)
    known = mask > 0
    colors = np.where(known, np.divide(weighted, mask, out=np.zeros_like(weighted), where=known), plain)
    return (
        np.rint(np.concatenate([encode(np.clip(colors, 0, 1)), mask], axis=-1) * 255)
        .clip(0, 255)
        .astype(np.uint8)
    )


def _area_means(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Means of [H, W, c] over the areas of [h, w, c], exact for any ratio."""
    found = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    return found[..., None] if found.ndim == 2 else found
