"""``preface-build-shards export``: shards for trainers that do not read shards.

The heavy imports wait until there is something to do, so that ``--help`` does not.
"""

import argparse
from pathlib import Path

from preface.cli.output import say

FORMATS = ("rays", "transforms")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of ``preface-build-shards export``."""
    parser.add_argument(
        "source", metavar="SHARDS", type=Path, help="folder of the shards, or its manifest.json"
    )
    parser.add_argument(
        "--format",
        choices=FORMATS,
        required=True,
        help="rays: every pixel's ray as float32 in a safetensors file per identity; transforms: a nerfstudio "
        "folder (transforms.json and images) per identity",
    )
    parser.add_argument(
        "--identities", nargs="+", metavar="NAME", help="only these identities (default: all of the shards)"
    )
    parser.add_argument(
        "--views", nargs="+", metavar="CAMERA", help="only these cameras' views (default: all of them)"
    )
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="folder to write; new, or empty"
    )
    parser.add_argument(
        "--units",
        choices=("metre", "scene"),
        default="metre",
        help="of lengths: metres, or the model's units, metres times the dataset's scene_scale (default: metre)",
    )
    parser.add_argument(
        "--images",
        choices=("rgba", "rgb"),
        default="rgba",
        help="transforms only: RGBA images, or RGB images and masks beside them (default: rgba)",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="say how many bytes it takes, and write nothing"
    )


def run(config: argparse.Namespace) -> list[str]:
    """Export; returns the lines to print, the path last.

    Raises:
        ArtifactError: see `preface.shards.export`.
    """
    from preface.shards.export.free_space import human, require_space
    from preface.shards.export.rays import export_rays, rays_bytes
    from preface.shards.export.selection import select
    from preface.shards.export.transforms import export_transforms, images_bytes
    from preface.shards.reader import Dataset

    with Dataset(config.source) as dataset:
        chosen = select(dataset, config.identities, config.views)
        scale = dataset.manifest.scene_scale if config.units == "scene" else 1.0
        size = rays_bytes(chosen) if config.format == "rays" else images_bytes(chosen)
        most = "" if config.format == "rays" else "at most "
        say(
            f"{chosen.view_count} views of {len(chosen.people)} identities, {chosen.rays:,} rays: "
            f"{most}{human(size)} ({size / chosen.rays:.1f} bytes per ray) as {config.format}; "
            f"the shards hold them in {human(4 * chosen.rays)}"
        )
        for note in chosen.notes:
            say(f"note: {note}")
        require_space(config.output, size)
        if config.dry_run:
            return [f"nothing written: {config.output} would take {most}{size} bytes", str(config.output)]
        if config.format == "rays":
            written = export_rays(dataset, chosen, config.output, config.units, scale)
        else:
            written = export_transforms(dataset, chosen, config.output, scale, config.images)
    return [str(path) for path in written] + [str(config.output)]
