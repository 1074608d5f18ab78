"""A head's surface against the synthetic studio's: depth in millimetres, normals in degrees, silhouettes.

    python tools/bench/head_truth.py HEAD [HEAD ...] --shards shards --studio studio [--identity id0060] [--json FILE]
        [--pictures FOLDER]

HEAD is what preface-fit or preface-train wrote; the shards hold whole photographs of the studio, lens kept, at its
resolution or reduced by a whole factor or a simple ratio such as 8/3. Each view that the models have not seen is
rendered once per kind of normals and compared where the studio knows a surface and the head is more than half opaque.
Cameras in shards stand in the canonical frame, the truth in the studio's: the similarity between the two is that of the
cameras' places and directions, so that lengths are true millimetres and normals meet in one frame.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.head_truth_pictures import write_pictures
from preface.artifacts import ArtifactError, provenance, write_bytes
from preface.capture.images import read_exr, read_image
from preface.capture.rig import read_rig
from preface.cli.usage import Parser
from preface.geometry import Rigid, Similarity, nearest_rotation
from preface.model.evaluation.evaluate import head_renderer
from preface.model.evaluation.figures import intersection_over_union
from preface.model.evaluation.options import FOREGROUND
from preface.model.evaluation.views import (
    camera_names,
    choose_views,
    fitted_views,
    identity_of,
    number_of,
    require_same_space,
    standing_camera,
)
from preface.model.matmul import denormals_flushed, keep_freed_memory
from preface.model.rendering.image import RenderedImage, render_image, space_of
from preface.model.rendering.shortcuts import Shortcuts
from preface.model.training.prior_files import Prior, read_prior
from preface.plain_words import json_text
from preface.shards import Dataset
from synthetic_studio.layout import Layout

LARGEST_DENOMINATOR = 8  # of the ratio of sizes: the truth is enlarged by it before it is reduced
FIGURES = (
    ("depth_median_mm", "depth, median", "mm"),
    ("depth_mean_mm", "depth, mean", "mm"),
    ("depth_bias_mm", "depth, median with its sign", "mm"),
    ("density_normals_median_deg", "density normals, median", "°"),
    ("density_normals_mean_deg", "density normals, mean", "°"),
    ("predicted_normals_median_deg", "predicted normals, median", "°"),
    ("predicted_normals_mean_deg", "predicted normals, mean", "°"),
    ("silhouette_iou", "silhouette, IoU", ""),
    ("compared", "of the foreground compared", ""),
)


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """What the studio knows of a view, at the resolution of the render.

    Attributes:
        depth: float64 [H, W], metres along the camera's axis, NaN where there is no surface.
        normals: float64 [H, W, 3], studio frame, of length one, NaN there.
        mask: float64 [H, W], coverage.
    """

    depth: np.ndarray
    normals: np.ndarray
    mask: np.ndarray


def main() -> None:
    """Measure, print a table, and write JSON if asked."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("heads", type=Path, nargs="+", metavar="HEAD")
    parser.add_argument("--shards", type=Path, required=True)
    parser.add_argument("--studio", type=Path, required=True, help="folder with capture/ and truth/")
    parser.add_argument("--identity")
    parser.add_argument("--views", nargs="+", metavar="CAMERA")
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--pictures", type=Path, metavar="FOLDER", help="depth, normals and errors of each view, PNG"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rays-at-a-time", type=int, default=4096)
    config = parser.parse_args()
    keep_freed_memory()
    try:
        with denormals_flushed():
            result = _measured(config)
    except ArtifactError as error:
        sys.exit(str(error))
    print(table(result["heads"]))
    if config.json is not None:
        print(write_bytes(config.json, f"{json_text(result)}\n".encode()))


def _measured(config: argparse.Namespace) -> dict[str, Any]:
    heads = []
    with Dataset(config.shards) as dataset:
        priors = [read_prior(path) for path in config.heads]
        for prior, path in zip(priors, config.heads, strict=True):
            identity = identity_of(prior, config.identity)
            require_same_space(prior, dataset)
            views = choose_views([prior], dataset, identity, config.views)
            found = head_errors(prior, dataset, identity, views, config)
            seen = [name for name in fitted_views(prior, dataset, identity) if name in found]
            mean = mean_errors(list(found.values()))
            head = {"head": str(path), "identity": identity, "fitted": seen, "views": found, "mean": mean}
            heads.append(head)
        inputs = {"manifest.json": dataset.manifest.path} | {
            f"{number}/model.json": prior.path for number, prior in enumerate(priors)
        }
    return {"heads": heads, "provenance": provenance({"studio": str(config.studio)}, inputs)}


def head_errors(
    prior: Prior, dataset: Dataset, identity: str, views: Sequence[str], config: argparse.Namespace
) -> dict[str, dict[str, float]]:
    """Figures of a head by view; see `view_errors`."""
    layout, place = Layout(config.studio), canonical_from_studio(dataset, identity, config.studio)
    model = prior.load_model().to(config.device)
    space = space_of(prior)
    row = prior.identities.index(identity)
    kinds = {"density": head_renderer(model, row, space, Shortcuts())}
    if model.config.predicted_normals:
        kinds["predicted"] = head_renderer(model, row, space, Shortcuts(predicted_normals=True))
    found = {}
    for name in views:
        standing = standing_camera(dataset, identity, name)
        surface = read_surface(layout, identity, name, (standing.camera.width, standing.camera.height))
        figures: dict[str, float] = {}
        for kind, renders in kinds.items():
            image = render_image(
                renders,
                space,
                standing.camera,
                standing.canonical_from_camera,
                rays_at_a_time=config.rays_at_a_time,
                device=torch.device(config.device),
            )
            figures |= view_errors(image, surface, place, kind)
            if kind == "density" and config.pictures is not None:
                show(image, surface, place, config.pictures / prior.path.parent.name, name)
        found[name] = figures
        print(f"{prior.path.parent.name}, {identity}/{name}: {figures}", file=sys.stderr, flush=True)
    return found


def canonical_from_studio(dataset: Dataset, identity: str, studio: Path) -> Similarity:
    """The similarity that carries the studio's frame to the canonical one, from all cameras of a person.

    Its rotation is the mean of what each camera's direction says, its scale and translation bring the cameras' places
    together; what calibration got wrong of single cameras stays where it is, in their errors.

    Raises:
        ArtifactError: the studio has no true cameras of the person's take, or fewer than two are in the shards.
    """
    take = dataset.manifest.identities[number_of(dataset, identity)].take
    rig = read_rig(studio / "truth" / "takes" / take)
    names = [name for name in camera_names(dataset, identity) if name in rig.cameras]
    if len(names) < 2:
        problem = f"has {len(names)} of the cameras of '{identity}', and a scale needs two"
        raise ArtifactError(studio, "cameras", problem, "Name the studio that the shards were made from")
    poses = [standing_camera(dataset, identity, name).canonical_from_camera for name in names]
    return similarity_of_cameras(poses, [rig.cameras[name].camera_from_rig.inverse for name in names])


def similarity_of_cameras(target: Sequence[Rigid], source: Sequence[Rigid]) -> Similarity:
    """target_from_source of two or more cameras with poses in both frames, their own frames being the same."""
    turns = [t.rotation @ s.rotation.T for t, s in zip(target, source, strict=True)]
    rotation = nearest_rotation(np.mean(turns, axis=0))
    places = [np.array([pose.translation for pose in poses]) for poses in (target, source)]
    middles = [where.mean(axis=0) for where in places]
    spreads = [np.linalg.norm(where - middle) for where, middle in zip(places, middles, strict=True)]
    scale = float(spreads[0] / spreads[1])
    return Similarity(np.array(scale), rotation, middles[0] - scale * rotation @ middles[1])


def read_surface(layout: Layout, identity: str, camera: str, size: tuple[int, int]) -> Surface:
    """The studio's surface in a view, reduced to a size (width, height) that its own is a simple multiple of.

    A pixel has a depth, the median, and a normal, the mean, where most of what it covers has.

    Raises:
        ArtifactError: a file is missing, or its size is smaller, of another aspect, or no simple multiple.
    """
    files = layout.view(int(identity.removeprefix("id")), int(camera.removeprefix("cam")))
    depth = read_exr(files.depth)["Y"].astype(np.float64)
    channels = read_exr(files.normals)
    normals = np.stack([channels[name] for name in "RGB"], axis=-1).astype(np.float64)
    mask = read_image(files.mask)[..., 0] / 65535.0
    factor, other = (Fraction(had, wanted) for had, wanted in zip(depth.shape[::-1], size, strict=True))
    if factor < 1 or factor != other or factor.denominator > LARGEST_DENOMINATOR:
        problem = f"is {depth.shape[1]}x{depth.shape[0]}, no simple multiple of {size[0]}x{size[1]}"
        remedy = "Build shards of whole photographs at the studio's resolution divided by a whole number"
        raise ArtifactError(files.depth, "size", problem, remedy)
    return reduced(Surface(depth, normals, mask), factor)


def reduced(surface: Surface, factor: Fraction) -> Surface:
    """The same with what lies in a larger pixel in place of pixels; those on its border count by their parts in it."""
    depth, mask = (_blocks(values, factor) for values in (surface.depth, surface.mask))
    normals = np.stack([_blocks(surface.normals[..., axis], factor) for axis in range(3)], axis=-1)
    most = np.isfinite(depth).mean(axis=2) > 0.5
    medians, means = np.full(most.shape, np.nan), np.full((*most.shape, 3), np.nan)
    medians[most] = np.nanmedian(depth[most], axis=-1)
    summed = np.nansum(normals[most], axis=1)
    means[most] = summed / np.linalg.norm(summed, axis=-1, keepdims=True)
    return Surface(medians, means, mask.mean(axis=2))


def _blocks(values: np.ndarray, factor: Fraction) -> np.ndarray:
    """Values [H, W] as [H / factor, W / factor, numerator²], each value as often as its part of a pixel has parts."""
    parts = values.repeat(factor.denominator, 0).repeat(factor.denominator, 1)
    side = factor.numerator
    height, width = parts.shape[0] // side, parts.shape[1] // side
    return parts.reshape(height, side, width, side).swapaxes(1, 2).reshape(height, width, side * side)


def view_errors(image: RenderedImage, surface: Surface, place: Similarity, kind: str) -> dict[str, float]:
    """Errors of a render against the studio's surface.

    Args:
        image: of the head; depths in canonical metres, normals in the canonical frame.
        surface: of the same pixels.
        place: canonical_from_studio.
        kind: of the render's normals, `density` or `predicted`.

    Returns:
        Absolute errors of depth, their median and mean, and the median of the error with its sign (positive where the
        head is too far), mm of the studio; angles between normals, degrees; the IoU of silhouettes; and the share of
        the studio's surface that was compared. Figures of which no pixel has both are left out.
    """
    found = {"silhouette_iou": intersection_over_union(image.alpha > FOREGROUND, surface.mask > FOREGROUND)}
    error = depth_error(image, surface, place)
    both = np.isfinite(error)
    found["compared"] = float(both.sum() / max(np.isfinite(surface.depth).sum(), 1))
    if both.any():
        found |= {
            "depth_median_mm": float(np.median(np.abs(error[both]))),
            "depth_mean_mm": float(np.abs(error[both]).mean()),
            "depth_bias_mm": float(np.median(error[both])),
        }
    if image.normals is not None:
        angles = normals_error(image.normals, surface, place)[both]
        angles = angles[np.isfinite(angles)]
        if angles.size:
            found |= {
                f"{kind}_normals_median_deg": float(np.median(angles)),
                f"{kind}_normals_mean_deg": float(angles.mean()),
            }
    return found


def depth_error(image: RenderedImage, surface: Surface, place: Similarity) -> np.ndarray:
    """How much too far the head is, [H, W], mm of the studio; NaN where one of both has no depth."""
    return 1e3 * (image.depth / place.scale - surface.depth)


def normals_error(normals: np.ndarray, surface: Surface, place: Similarity) -> np.ndarray:
    """The angle to the studio's normals, [H, W], degrees, of normals [H, W, 3] of the canonical frame; NaN likewise."""
    ours, true = normals.astype(np.float64) @ place.rotation, surface.normals
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(ours, true), axis=-1), (ours * true).sum(-1)))


def show(image: RenderedImage, surface: Surface, place: Similarity, folder: Path, camera: str) -> None:
    """Write the pictures of a view, in the studio's frame and metres; see `write_pictures`.

    Raises:
        ValueError: the image was rendered without normals.
        ArtifactError: the disk refuses.
    """
    if image.normals is None:
        raise ValueError("these pictures need normals")
    folder.mkdir(parents=True, exist_ok=True)
    depths = (surface.depth, image.depth / float(place.scale), depth_error(image, surface, place))
    ours = image.normals.astype(np.float64) @ place.rotation
    write_pictures(
        folder, camera, depths, (surface.normals, ours, normals_error(image.normals, surface, place))
    )


def mean_errors(views: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each figure over the views that have it."""
    known = {name: [view[name] for view in views if name in view] for name, _, _ in FIGURES}
    return {name: float(np.mean(values)) for name, values in known.items() if values}


def table(heads: Sequence[Mapping[str, Any]]) -> str:
    """Means over views as Markdown, a column per head."""
    lines = [["mean over views", *(f"{head['head']}, {head['identity']}" for head in heads)]]
    lines.append(["---"] + ["---:"] * len(heads))
    for name, words, unit in FIGURES:
        if any(name in head["mean"] for head in heads):
            values = [f"{head['mean'][name]:.3f} {unit}" if name in head["mean"] else "–" for head in heads]
            lines.append([words, *(value.strip() for value in values)])
    lines.append(["views", *(str(len(head["views"])) for head in heads)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    main()
