"""How well `align_photos` recovers cameras and keypoints from a few photographs.

    python tools/bench/photos_alignment.py DIR [--counts 1 2 3 7] [--subsets 6] [--json figures.json]

DIR is a folder with images/ and sparse/0 (a COLMAP model of them), or a studio made by `tools/synthetic_studio`.
The reference is, for the former, the shipped cameras and the keypoints triangulated with them from all images; for
the latter, the truth. Subsets are drawn at random (seed 0) from the views whose face is found and, in a studio,
within 40 degrees of its front. No EXIF is used unless the files have it.

Errors, after a similarity of the keypoints (cameras have no common frame or scale otherwise):
    keypoints    worst and mean of five, in % of the distance of the outer eye corners
    relative     rotation between two cameras, against the reference's; needs no similarity
    rotation     of a camera, as its file states it: a principal point off the centre counts in full
    rays         of the bundle of rays through the face's landmarks: where the camera looks, whatever its lens model
    centre       direction of the camera from the keypoints' mean
    focal, size  relative error of focal length; of the outer eye distance (studio only, in metres)
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))

from preface.align.detection import DetectionOptions, detect_views
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.landmarks import ViewLandmarks
from preface.align.photos import PhotoAlignment, PhotoView, align_photos
from preface.artifacts import load_json
from preface.capture.formats.registry import read_rig_from
from preface.capture.photos.files import find_photographs
from preface.capture.rig import Rig, RigCamera, read_rig
from preface.cli.usage import Parser
from preface.geometry import Similarity, fit_similarity

MAX_ANGLE = np.radians(40)
COLUMNS = ("keypoints worst", "keypoints mean", "relative", "rotation", "rays", "centre", "focal", "size")


@dataclass(frozen=True, eq=False)
class Reference:
    """Photographs of a person, with what is taken for true: cameras by id and keypoints [5, 3]."""

    name: str
    views: list[PhotoView]
    rig: Rig
    keypoints: np.ndarray
    metric: bool


def main() -> None:
    """Detect, draw subsets, align, compare, print."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 3, 7], help="photographs at a time")
    parser.add_argument("--subsets", type=int, default=6, help="choices of photographs per count")
    parser.add_argument("--identities", type=int, default=4, help="people of a studio")
    parser.add_argument("--jobs", type=int, default=0, help="processes of the detector, 0 for all cores")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    options = DetectionOptions(jobs=arguments.jobs)
    studio = (arguments.folder / "truth").is_dir()
    references = (
        list(_studio(arguments.folder, arguments.identities, options))
        if studio
        else [_colmap(arguments.folder, options)]
    )
    figures: dict[int, list[dict[str, float]]] = {}
    for count in arguments.counts:
        figures[count] = [
            _compare(reference, chosen, align_photos(chosen))
            for reference in references
            for chosen in _subsets(reference.views, count, arguments.subsets)
        ]
        _print(count, figures[count])
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1))
        print(arguments.json)


def _colmap(folder: Path, options: DetectionOptions) -> Reference:
    photographs = {photo.id: photo for photo in find_photographs(folder / "images", "one")}
    rig = read_rig_from(folder / "sparse" / "0")
    found = detect_views({("", name): photo.path for name, photo in photographs.items()}, options)
    views = [
        PhotoView(
            name, marks, photographs[name].width, photographs[name].height, photographs[name].exif_focal
        )
        for (_, name), marks in found.items()
        if isinstance(marks, ViewLandmarks) and name in rig.cameras
    ]
    print(f"{folder.name}: a face in {len(views)} of {len(found)} images")
    shipped = align_photos(views, rig)  # its rig has the scale of its keypoints
    return Reference(folder.name, views, shipped.rig, shipped.keypoints, metric=False)


def _studio(folder: Path, count: int, options: DetectionOptions) -> Iterator[Reference]:
    heads = sorted(path.parent for path in (folder / "truth" / "identities").glob("*/head.json"))[:count]
    images = {
        (head.name, path.stem): path
        for head in heads
        for path in sorted((folder / "capture" / "subjects" / head.name).glob("*.png"))
    }
    found = detect_views(images, options)
    for head in heads:
        truth = load_json(head / "head.json")
        rig = read_rig(folder / "truth" / "takes" / truth["take"] / "rig.json")
        views = []
        for (subject, name), marks in found.items():
            centre = rig.cameras[name].camera_from_rig.inverse.translation
            frontal = np.arccos(centre[2] / np.linalg.norm(centre)) < MAX_ANGLE
            if subject == head.name and frontal and isinstance(marks, ViewLandmarks):
                lens = rig.cameras[name].camera
                views.append(PhotoView(name, marks, lens.width, lens.height))
        keypoints = np.array([truth["keypoints"][name] for name in CANONICAL_KEYPOINTS])
        yield Reference(head.name, views, rig, keypoints, metric=True)


def _subsets(views: list[PhotoView], count: int, wanted: int) -> list[list[PhotoView]]:
    if len(views) < count:
        return []
    random = np.random.default_rng(0)
    drawn = {tuple(sorted(random.choice(len(views), count, replace=False))) for _ in range(wanted)}
    return [[views[index] for index in chosen] for chosen in sorted(drawn)]


def _compare(reference: Reference, chosen: list[PhotoView], found: PhotoAlignment) -> dict[str, float]:
    """Figures of one alignment; angles in degrees, shares in per cent; means over cameras."""
    fit = fit_similarity(reference.keypoints, found.keypoints)
    mine_from_true = fit.target_from_source
    eyes, true_eyes = (
        float(np.linalg.norm(points[0] - points[1])) for points in (found.keypoints, reference.keypoints)
    )
    pairs = [(found.rig.cameras[name], reference.rig.cameras[name]) for name in found.views]
    marks = {view.id: view.landmarks.pixels for view in chosen}
    middle = found.keypoints.mean(axis=0)

    def each(measure: Callable[[RigCamera, RigCamera, np.ndarray], float]) -> float:
        values = [measure(*pair, marks[name]) for pair, name in zip(pairs, found.views, strict=True)]
        return float(np.mean(values))

    def rotation(mine: RigCamera, true: RigCamera, _: np.ndarray) -> float:
        expected = true.camera_from_rig.rotation @ mine_from_true.rotation.T
        return _angle(expected.T @ mine.camera_from_rig.rotation)

    def rays(mine: RigCamera, true: RigCamera, pixels: np.ndarray) -> float:
        aligned = _rays(true, pixels) @ mine_from_true.rotation.T
        return float(np.degrees(Rotation.align_vectors(_rays(mine, pixels), aligned)[0].magnitude()))

    def centre(mine: RigCamera, true: RigCamera, _: np.ndarray) -> float:
        return _between(_centre(mine) - middle, _centre(true, mine_from_true) - middle)

    relative = [_angle(_relative(a[0], b[0]).T @ _relative(a[1], b[1])) for a, b in combinations(pairs, 2)]
    return {
        "keypoints worst": 100 * float(fit.residuals.max()) / eyes,
        "keypoints mean": 100 * float(fit.residuals.mean()) / eyes,
        "relative": float(np.mean(relative)) if relative else np.nan,
        "rotation": each(rotation),
        "rays": each(rays),
        "centre": each(centre),
        "focal": 100 * each(lambda mine, true, _: mine.camera.intrinsics[0] / true.camera.intrinsics[0] - 1),
        "size": 100 * (eyes / true_eyes - 1) if reference.metric else np.nan,
        "excluded": float(len(found.excluded)),
    }


def _angle(rotation: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))


def _between(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def _relative(a: RigCamera, b: RigCamera) -> np.ndarray:
    return a.camera_from_rig.rotation @ b.camera_from_rig.rotation.T


def _rays(camera: RigCamera, pixels: np.ndarray) -> np.ndarray:
    xy, _ = camera.camera.unproject(pixels[np.isfinite(pixels).all(-1)])
    rays = np.c_[xy, np.ones(len(xy))] @ camera.camera_from_rig.rotation
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _centre(camera: RigCamera, target_from_rig: Similarity | None = None) -> np.ndarray:
    centre = camera.camera_from_rig.inverse.translation
    return centre if target_from_rig is None else target_from_rig.apply(centre)


def _print(count: int, rows: list[dict[str, float]]) -> None:
    if not rows:
        print(f"{count} photographs: no subject has as many")
        return
    excluded = sum(row["excluded"] for row in rows)
    print(f"\n{count} photographs, {len(rows)} subsets, {excluded:.0f} photographs excluded; median (worst)")
    for name in COLUMNS:
        values = np.array([row[name] for row in rows])
        if np.isfinite(values).any():
            unit = "%" if name in ("keypoints worst", "keypoints mean", "focal", "size") else "degrees"
            worst = values[np.argmax(np.abs(values))]
            print(f"  {name:16} {np.median(values):7.2f} ({worst:.2f}) {unit}")


if __name__ == "__main__":
    main()
