"""A small studio on disk: photographs with masks, the rig of three distorting cameras, and an alignment.

Every person stands elsewhere, is turned and has another size, so that no two similarities are alike. The photographs
are smooth colours, the masks discs about where the head is.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import made_up_studio
import numpy as np

from preface.align.alignment_files import (
    TEMPLATE_FILE,
    AlignedEntry,
    AlignmentIndex,
    ExcludedEntry,
    alignment_file,
    write_index,
    write_template,
)
from preface.align.landmarks import NoFace
from preface.align.person_file import Alignment, write_alignment
from preface.align.placement import Placement
from preface.align.template import Template
from preface.artifacts import provenance, sha256
from preface.capture.images import write_png
from preface.capture.manifest import CaptureCamera, Manifest, Subject, Take, write_capture
from preface.capture.rig import Rig, RigCamera, write_rig
from preface.geometry import Camera, Rigid, Similarity
from preface.geometry.transforms import nearest_rotation
from preface.shards.dataset.people import People, find_candidates, find_people

CAMERAS = made_up_studio.CAMERAS
WIDTH, HEIGHT = 96, 128
TAKE = "take"


@dataclass(frozen=True)
class Places:
    """Where the studio lies."""

    capture: Path
    rig: Path
    alignment: Path

    def arguments(self, output, *more, resolution="24x32"):
        """Of the command."""
        given = ["--rig", self.rig, "--alignment", self.alignment, "--output", output]
        return [str(word) for word in (self.capture, *given, "--resolution", resolution, "--jobs", 1, *more)]


def rig(width=WIDTH, height=HEIGHT):
    """Three cameras at a metre, each with another lens."""
    focal = 2.6 * width
    lenses = [
        Camera(
            "OPENCV", width, height, np.array([focal, focal, width / 2, height / 2, -0.1, 0.05, 1e-3, 2e-3])
        ),
        Camera("PINHOLE", width, height, np.array([focal, 1.01 * focal, 0.49 * width, 0.51 * height])),
        Camera("SIMPLE_RADIAL", width, height, np.array([focal, width / 2, height / 2, -0.15])),
    ]
    poses = made_up_studio.rig().cameras
    cameras = {
        name: RigCamera.at(lens, poses[name].camera_from_rig)
        for name, lens in zip(CAMERAS, lenses, strict=True)
    }
    return Rig(TAKE, cameras)


def similarity(number):
    """canonical_from_rig of a person."""
    turned = nearest_rotation(np.eye(3) + 0.02 * np.random.default_rng(number).standard_normal((3, 3)))
    return Similarity(1 + 0.02 * number, turned, np.array([0.004, -0.003, 0.005]) * number)


def photograph(number, view, width=WIDTH, height=HEIGHT):
    """Smooth colours, uint8 [height, width, 3]."""
    coarse = np.random.default_rng([number, view]).integers(0, 256, (8, 6, 3), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def mask(width=WIDTH, height=HEIGHT):
    """A disc, uint8 [height, width]."""
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    return np.where(np.hypot(x, y) < 0.3 * width, 255, 0).astype(np.uint8)


def write_studio(folder, people=3, excluded=(), width=WIDTH, height=HEIGHT, masks=True):
    """Write the studio; returns where it lies."""
    places = Places(folder / "capture", folder / "rig.json", folder / "alignment")
    names = [f"p{number}" for number in range(people)]
    for number, name in enumerate(names):
        for view, camera in enumerate(CAMERAS):
            for kind in ("subjects", "masks")[: 1 + masks]:
                (places.capture / kind / name).mkdir(parents=True, exist_ok=True)
            file = places.capture / "subjects" / name / f"{camera}.png"
            write_png(file, photograph(number, view, width, height))
            if masks:
                write_png(places.capture / "masks" / name / f"{camera}.png", mask(width, height))
    cameras = tuple(CaptureCamera(camera) for camera in CAMERAS)
    write_capture(places.capture, Manifest(cameras, (Take(TAKE),), tuple(Subject(n, TAKE) for n in names)))
    write_rig(places.rig, rig(width, height))
    align(places, names, excluded, rig(width, height))
    return places


def align(places, names, excluded=(), of_rig=None):
    """Write the alignment of people."""
    places.alignment.mkdir(exist_ok=True)
    of_rig = of_rig or rig()
    template = Template("ibug68", made_up_studio.TEMPLATE, Rigid.identity(), tuple(names), False, np.zeros(5))
    write_template(places.alignment / TEMPLATE_FILE, template)
    entries = []
    for name in names:
        if name in excluded:
            continue
        move = similarity(int(name[1:]))
        keypoints = move.inverse.apply(made_up_studio.TEMPLATE)
        subject = made_up_studio.subject(keypoints, {c: made_up_studio.verdict() for c in CAMERAS})
        place = Placement(move, np.zeros(5), np.full(5, 0.2), ())
        inputs = {
            f"{name}/{c}/{c}.png": sha256(places.capture / "subjects" / name / f"{c}.png") for c in CAMERAS
        }
        history = provenance({}, {f"rigs/{TAKE}.json": places.rig})
        history["inputs"] |= inputs
        found = {c: NoFace("landmarks are of no interest here") for c in CAMERAS}
        file = places.alignment / alignment_file(name)
        write_alignment(file, Alignment(name, TAKE, subject, place, found, history))
        entries.append(AlignedEntry.of(name, TAKE, subject, place))
    out = tuple(ExcludedEntry(name, TAKE, "only one view shows a face") for name in excluded)
    write_index(places.alignment, AlignmentIndex("ibug68", tuple(entries), out))


def found(places, **options) -> People:
    """The people of the studio."""
    chosen = {"only": None, "max_pixels": 10**9, **options}
    candidates = find_candidates(places.capture, places.alignment, chosen["only"])
    return find_people(candidates, {TAKE: (places.rig, rig())}, chosen["max_pixels"])


def contents(folder):
    """Name -> bytes of all files of a dataset."""
    return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}
