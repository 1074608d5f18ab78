"""How well MediaPipe FaceMesh, which never saw the studio, reads its faces.

    python tools/bench/studio_facemesh.py DIR [--json figures.json]

DIR is a studio made by `tools/synthetic_studio`. Prints in how many views of each identity a face is found,
and per landmark the distance between what FaceMesh sees and the true point's projection, in per cent of the
distance between the outer eye corners in the image, over the frontal views (within 20 degrees of straight
ahead).
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from preface.artifacts import load_json
from preface.capture.images import read_image
from preface.capture.manifest import read_capture
from preface.capture.rig import read_rig
from preface.cli.usage import Parser
from synthetic_studio.facemesh import detect

GROUPS = {
    "nose tip": (1,),
    "right eye, outer corner": (33,),
    "right eye, inner corner": (133,),
    "left eye, inner corner": (362,),
    "left eye, outer corner": (263,),
    "right iris": (468,),
    "left iris": (473,),
    "right mouth corner": (61,),
    "left mouth corner": (291,),
    "upper lip, inner": (13,),
    "lower lip, inner": (14,),
    "chin": (152,),
    "all points of the skin": tuple(range(468)),
}
FRONTAL = np.radians(20.0)
WANTED_VIEWS = 10


def main() -> None:
    """Detect in every view, compare with the truth, print."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studio", type=Path)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    capture = read_capture(arguments.studio / "capture")
    truth = arguments.studio / "truth"
    rigs = {take.id: read_rig(truth / "takes" / take.id / "rig.json") for take in capture.manifest.takes}
    found: dict[str, list[str]] = {}
    errors: list[np.ndarray] = []
    for subject in tqdm(capture.manifest.subjects, desc="identities", disable=None):
        head = load_json(truth / "identities" / subject.id / "head.json")
        points = np.array([head["landmarks"].get(str(k), [np.nan] * 3) for k in range(478)])
        found[subject.id] = []
        for camera_id in (camera.id for camera in capture.manifest.cameras):
            seen = detect(read_image(capture.images[subject.id, camera_id]))
            if seen is None:
                continue
            found[subject.id].append(camera_id)
            rig_camera = rigs[subject.take].cameras[camera_id]
            forward = rig_camera.camera_from_rig.rotation[2]
            if np.arccos(np.clip(-forward[2], -1.0, 1.0)) < FRONTAL:
                true, _ = rig_camera.camera.project(rig_camera.camera_from_rig.apply(points))
                errors.append(np.linalg.norm(seen - true, axis=1) / np.linalg.norm(true[263] - true[33]))
    _report(found, np.array(errors), len(capture.manifest.cameras), arguments.json)


def _report(found: dict[str, list[str]], errors: np.ndarray, views: int, output: Path | None) -> None:
    counts = np.array([len(cameras) for cameras in found.values()])
    enough = float((counts >= WANTED_VIEWS).mean())
    print(
        f"identities: {len(counts)}; views with a face: mean {counts.mean():.2f} of {views}, least {counts.min()}"
    )
    print(f"face found in at least {WANTED_VIEWS} views: {enough:.1%} of identities")
    for camera_id in sorted({name for cameras in found.values() for name in cameras}):
        share = np.mean([camera_id in cameras for cameras in found.values()])
        print(f"  {camera_id}: {share:.0%}")
    print(f"error in % of the outer eye distance, {len(errors)} frontal views: median, 90th percentile")
    figures: dict[str, float] = {}
    for name, indices in GROUPS.items():
        values = 100.0 * errors[:, indices]
        figures[name] = float(np.median(values))
        print(f"  {name:28s} {figures[name]:6.2f} {np.percentile(values, 90):6.2f}")
    if output is not None:
        output.write_text(
            json.dumps({"enough_views": enough, "views": counts.tolist(), "median_error": figures})
        )


if __name__ == "__main__":
    main()
