"""Speed for accuracy in alignment: keypoint error against the truth, and seconds per person, over what can be chosen.

    python tools/bench/alignment_tradeoff.py STUDIO [--people 8] [--json figures.json]
        [--scales 256 512 1024] [--crops 1 2 4 8 16] [--views 13 7 5 3 2] [--sample FOLDER]

STUDIO is made by `tools/synthetic_studio`; its true cameras are used, so that what is seen is the detector's and
the triangulation's error. One process, one thread: set OMP_NUM_THREADS=1 and let nothing else run. One thing is
varied at a time, the rest is as by default:

- the longer side of the image in which faces are searched (`--search-side`), and the number of crops (`--crops`);
- the number of views, the first ones of the capture, whose order runs from the most to the least useful;
- the triangulation of the keypoints: ours, two views by DLT (the two with the smallest angle to the front that
  are 20 degrees apart or more), and `pycolmap.estimate_triangulation` in a loop, all on the same views. Ours
  also judges the views and triangulates all landmarks, with covariances; the peers do five points.

Errors are those of the five keypoints, mm: median, root mean square, and the latter without the mean error of each
keypoint, which shifts all people alike. With --sample, a folder of photographs of the real size (4096x6144), the
hours of 1450 people in 13 views on two cores are extrapolated from reading and searching each of them once.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.alignment_truth import Truth, printed
from preface.align.detection import DetectionOptions
from preface.align.face_search import find_landmarks
from preface.align.facemesh import FaceModels
from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.landmark_bias import shipped_bias
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.align.options import AlignmentOptions
from preface.align.subject import SubjectAlignment, align_subject
from preface.capture.images import IMAGE_SUFFIXES, displayable, read_image
from preface.capture.rig import Rig
from preface.cli.usage import Parser

FULL_STUDIO = 1450, 13  # the paper's people and views
LEAST_ANGLE = np.radians(20.0)  # between the two views of the DLT
Views = dict[str, ViewLandmarks | NoFace]  # by camera


@dataclass(frozen=True)
class Measured:
    """Landmarks of people with some options, and what they took.

    Attributes:
        views: identity to its views.
        reading, finding: CPU seconds per person.
    """

    views: Mapping[str, Views]
    reading: float
    finding: float


class Detector:
    """The landmark model with options, in this process."""

    def __init__(self) -> None:
        self.models = FaceModels(None)

    def read(self, path: Path) -> tuple[np.ndarray, float]:
        """The photograph, and CPU seconds."""
        began = time.process_time()
        image = displayable(read_image(path))
        return image, time.process_time() - began

    def find(self, image: np.ndarray, options: DetectionOptions) -> tuple[ViewLandmarks | NoFace, float]:
        """Landmarks, and CPU seconds."""
        began = time.process_time()
        found = find_landmarks(image, self.models, options.scale, options.rotations, options.jitters)
        return found, time.process_time() - began

    def measure(self, truth: Truth, people: Sequence[str], options: DetectionOptions) -> Measured:
        """Landmarks of all views of some people."""
        views: dict[str, Views] = {}
        reading = finding = 0.0
        for identity in people:
            views[identity] = {}
            for camera in truth.capture.manifest.cameras:
                image, read = self.read(truth.capture.images[identity, camera.id])
                views[identity][camera.id], took = self.find(image, options)
                reading, finding = reading + read, finding + took
        return Measured(views, reading / len(people), finding / len(people))


def main() -> None:
    """Measure, print, write."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studio", type=Path)
    parser.add_argument("--people", type=int, default=8)
    parser.add_argument("--scales", type=int, nargs="+", default=[256, 512, 1024])
    parser.add_argument("--crops", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument("--views", type=int, nargs="+", default=[13, 7, 5, 3, 2])
    parser.add_argument("--sample", type=Path, help="folder of photographs of the real size")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    truth, detector, default = Truth(arguments.studio), Detector(), DetectionOptions()
    people = list(truth.takes)[: arguments.people]
    usual = detector.measure(truth, people, default)
    tables: dict[str, list[dict[str, Any]]] = {"scale": [], "crops": [], "views": [], "triangulation": []}
    for scale in arguments.scales:
        options = DetectionOptions(scale=scale)
        measured = usual if options == default else detector.measure(truth, people, options)
        tables["scale"].append({"search side": scale, **_aligned(truth, measured)})
    for crops in arguments.crops:
        options = DetectionOptions(jitters=crops)
        measured = usual if options == default else detector.measure(truth, people, options)
        tables["crops"].append({"crops": crops, **_aligned(truth, measured)})
    cameras = [camera.id for camera in truth.capture.manifest.cameras]
    for count in (count for count in arguments.views if count <= len(cameras)):
        tables["views"].append({"views": count, **_aligned(truth, _only(usual, cameras[:count]))})
    tables["triangulation"] = _methods(truth, usual)
    for name, rows in tables.items():
        print(f"\nvarying: {name}")
        print(printed(rows))
    figures: dict[str, Any] = {"people": len(people), "tables": tables}
    if arguments.sample is not None:
        per_person = tables["triangulation"][0]["align s"]
        figures["extrapolated"] = _extrapolated(detector, arguments.sample, default, per_person)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


# ------------------------------------------------------------------------------------------- people


def _only(measured: Measured, cameras: Sequence[str]) -> Measured:
    """The same with some of the views; the time is theirs in proportion."""
    views = {identity: {c: found[c] for c in cameras} for identity, found in measured.views.items()}
    share = len(cameras) / len(next(iter(measured.views.values())))
    return Measured(views, measured.reading * share, measured.finding * share)


def _aligned(truth: Truth, measured: Measured) -> dict[str, Any]:
    """Errors and seconds of aligning people with what was found."""
    faces, seconds = _faces(truth, measured)
    keypoints = {identity: face.keypoints.positions for identity, face in faces.items()}
    row = _errors(truth, keypoints)
    row["views used"] = float(np.mean([len(face.cameras) for face in faces.values()]))
    row["excluded"] = sum(face.excluded is not None for face in faces.values())
    return row | {"read s": measured.reading, "find s": measured.finding, "align s": seconds}


def _faces(truth: Truth, measured: Measured) -> tuple[dict[str, SubjectAlignment], float]:
    """Faces by identity, and CPU seconds per person."""
    began, options = time.process_time(), AlignmentOptions()
    faces = {
        identity: align_subject(views, truth.rigs[truth.takes[identity]], options, shipped_bias())
        for identity, views in measured.views.items()
    }
    return faces, (time.process_time() - began) / len(faces)


def _errors(truth: Truth, keypoints: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Distances of keypoints [5, 3] from the truth, mm."""
    errors = 1e3 * np.array([points - truth.keypoints[name] for name, points in keypoints.items()])
    known = np.asarray(np.isfinite(errors).all(axis=-1))
    if not known.any():
        return {"keypoints": 0}
    distances = np.linalg.norm(errors[known], axis=-1)
    count = np.maximum(known.sum(axis=0), 1)[:, None]
    bias = np.where(known[..., None], errors, 0).sum(axis=0) / count
    varying = np.linalg.norm((errors - bias)[known], axis=-1)
    return {
        "keypoints": int(known.sum()),
        "median mm": float(np.median(distances)),
        "RMS mm": float(np.sqrt((distances**2).mean())),
        "without bias mm": float(np.sqrt((varying**2).mean())),
    }


# ------------------------------------------------------------------------------------ triangulation


def _methods(truth: Truth, measured: Measured) -> list[dict[str, Any]]:
    """Ours against the two peers, on the views that ours uses."""
    faces, seconds = _faces(truth, measured)
    ours = {identity: face.keypoints.positions for identity, face in faces.items()}
    rows = [{"method": "ours", **_errors(truth, ours), "align s": seconds}]
    peers: dict[str, Callable[[Rig, dict[str, np.ndarray]], np.ndarray]] = {
        "DLT, two views": _two_views,
        "pycolmap.estimate_triangulation": _pycolmap,
    }
    for name, method in peers.items():
        began, found = time.process_time(), {}
        for identity, face in faces.items():
            views = measured.views[identity]
            pixels = {c: v.keypoints for c in face.cameras if isinstance(v := views[c], ViewLandmarks)}
            found[identity] = method(truth.rigs[truth.takes[identity]], pixels)
        took = (time.process_time() - began) / len(faces)
        rows.append({"method": name, **_errors(truth, found), "align s": took})
    return rows


def _two_views(rig: Rig, pixels: dict[str, np.ndarray]) -> np.ndarray:
    """The five keypoints [5, 3] from two views near the front, by cv2.triangulatePoints; NaN where impossible."""
    forward = {camera: rig.cameras[camera].camera_from_rig.rotation[2] for camera in pixels}
    middle = sum(forward.values(), np.zeros(3))
    nearest = sorted(forward, key=lambda camera: -float(forward[camera] @ middle))
    pairs = [
        (a, b)
        for index, b in enumerate(nearest)
        for a in nearest[:index]
        if np.arccos(np.clip(forward[a] @ forward[b], -1, 1)) > LEAST_ANGLE
    ]
    if not pairs:
        return np.full((len(CANONICAL_KEYPOINTS), 3), np.nan)
    matrices, images = [], []
    for camera in pairs[0]:
        entry = rig.cameras[camera]
        matrices.append(entry.camera_from_rig.matrix[:3])
        images.append(entry.camera.unproject(pixels[camera])[0].T)
    points = cv2.triangulatePoints(*matrices, *images).T
    return np.asarray(points[:, :3] / points[:, 3:], np.float64)


def _pycolmap(rig: Rig, pixels: dict[str, np.ndarray]) -> np.ndarray:
    """The five keypoints [5, 3] by pycolmap's robust estimator, one after the other; NaN where it fails."""
    cameras, poses = [], []
    for name in pixels:
        entry = rig.cameras[name]
        lens = entry.camera
        cameras.append(
            pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=lens.params)
        )
        poses.append(pycolmap.Rigid3d(entry.camera_from_rig.matrix[:3]))
    found = np.full((len(CANONICAL_KEYPOINTS), 3), np.nan)
    for index in range(len(found)):
        points = np.array([of_view[index] for of_view in pixels.values()])
        seen = np.flatnonzero(np.isfinite(points).all(axis=-1))
        if len(seen) < 2:
            continue
        result = pycolmap.estimate_triangulation(
            points[seen], [poses[i] for i in seen], [cameras[i] for i in seen]
        )
        if result is not None:
            found[index] = result["xyz"]
    return found


# ------------------------------------------------------------------------------------ extrapolation


def _extrapolated(
    detector: Detector, sample: Path, options: DetectionOptions, align: float
) -> dict[str, Any]:
    """Hours of a whole studio on two cores, from a sample of its photographs, and what they are spent on."""
    files = sorted(file for file in sample.rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES)
    reading = finding = 0.0
    faces = 0
    sizes = set()
    for file in files:
        image, read = detector.read(file)
        found, took = detector.find(image, options)
        reading, finding, faces = reading + read, finding + took, faces + isinstance(found, ViewLandmarks)
        sizes.add(f"{image.shape[1]}x{image.shape[0]}")
    people, views = FULL_STUDIO
    hours = {
        "reading": reading / len(files) * people * views / 3600 / 2,
        "finding landmarks": finding / len(files) * people * views / 3600 / 2,
        "aligning": align * people / 3600,  # one process
    }
    print(f"\nsample: {len(files)} photographs of {', '.join(sorted(sizes))}, {faces} with a face")
    print(f"CPU s per photograph: reading {reading / len(files):.3f}, landmarks {finding / len(files):.3f}")
    print(f"{people} people x {views} views on 2 cores, hours:")
    for name, value in (*hours.items(), ("all", sum(hours.values()))):
        print(f"  {name}: {value:.2f}")
    return {"photographs": len(files), "sizes": sorted(sizes), "with a face": faces, "hours": hours}


if __name__ == "__main__":
    main()
