"""What `preface-inspect` says of shards: a dataset with its manifest, or one file by itself. Every byte is verified."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError, read_artifact
from preface.shards.format import BACKGROUND_KINDS
from preface.shards.manifest import MANIFEST_FILE, SCHEMA
from preface.shards.reader import Dataset, verify
from preface.shards.shard import Shard


def summarise_dataset(path: Path, problems: list[ArtifactError]) -> dict[str, Any]:
    """Verify a dataset; returns what it holds.

    Args:
        path: the manifest, or the folder.
        problems: what is wrong is added here.

    Raises:
        ArtifactError: the manifest is missing or malformed, or a shard cannot be opened.
    """
    path = path / MANIFEST_FILE if path.is_dir() else path
    payload = read_artifact(path, SCHEMA)
    problems += verify(path)
    with Dataset(path) as dataset:
        manifest, tables = dataset.manifest, dataset.tables
        valid = tables["view_valid"] == 1
        settings = payload["provenance"]["config"]
        return {
            "name": settings.get("name"),
            "resolution": f"{manifest.width}x{manifest.height}",
            "identities": list(dataset.names),
            "splits": {name: len(names) for name, names in manifest.splits.items()},
            "held_out": list(manifest.splits.get("holdout", ())),
            "views": int(valid.sum()),
            "views_per_identity": manifest.views,
            "missing_views": int((~valid).sum()),
            "backgrounds": _backgrounds(tables["background_kind"][valid]),
            "foreground_share": _share(tables["foreground_count"][valid], manifest.width * manifest.height),
            "near_far_m": [float(n) for n in _extremes(tables["near_far"][valid])],
            "box_m": [corner.tolist() for corner in manifest.box],
            "scene_scale": manifest.scene_scale,
            "pixel_order": manifest.pixel_order,
            "shards": len(manifest.shards),
            "bytes": sum(shard.bytes for shard in manifest.shards),
            "bytes_per_ray": dataset.bytes_per_ray,
            "left_out": [
                f"{entry['identity']}{'/' + entry['camera'] if entry['camera'] else ''}: {entry['reason']}"
                for entry in settings.get("left_out", [])
            ],
        }


def summarise_shard(path: Path, problems: list[ArtifactError]) -> dict[str, Any]:
    """Verify one shard; returns what it holds.

    Raises:
        ArtifactError: it is none, or its tables are damaged.
    """
    with Shard(path) as shard:
        problems += shard.problems()
        valid, layout = shard.tables["view_valid"] == 1, shard.layout
        return {
            "resolution": f"{layout.width}x{layout.height}",
            "identities": [person["identity"] for person in shard.people],
            "views": int(valid.sum()),
            "missing_views": int((~valid).sum()),
            "backgrounds": _backgrounds(shard.tables["background_kind"][valid]),
            "pixel_order": layout.pixel_order,
            "bytes": layout.file_bytes,
            "recipe": shard.recipe,
        }


def _backgrounds(kinds: np.ndarray) -> list[str]:
    counts = Counter(BACKGROUND_KINDS[kind] for kind in kinds)
    return [f"{count} x {kind}" for kind, count in sorted(counts.items())]


def _share(counts: np.ndarray, pixels: int) -> float | None:
    return float(counts.mean() / pixels) if counts.size else None


def _extremes(near_far: np.ndarray) -> tuple[float, float]:
    return (near_far[:, 0].min(), near_far[:, 1].max()) if len(near_far) else (0.0, 0.0)
