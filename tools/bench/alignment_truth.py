"""What the synthetic studio knows about its people, and how far measured keypoints are from it."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.triangulation import triangulate
from preface.artifacts import load_json
from preface.capture.manifest import Capture, read_capture
from preface.capture.rig import Rig, read_rig
from preface.geometry import Rigid, Views, fit_similarity


@dataclass(frozen=True)
class Truth:
    """A studio made by `tools/synthetic_studio`."""

    studio: Path

    @cached_property
    def capture(self) -> Capture:
        """The capture."""
        return read_capture(self.studio / "capture")

    @property
    def takes(self) -> dict[str, str]:
        """Identity to its take."""
        return {subject.id: subject.take for subject in self.capture.manifest.subjects}

    @cached_property
    def rigs(self) -> dict[str, Rig]:
        """Take to its true cameras."""
        takes = self.capture.manifest.takes
        return {take.id: read_rig(self.studio / "truth" / "takes" / take.id) for take in takes}

    @cached_property
    def keypoints(self) -> dict[str, np.ndarray]:
        """Identity to its five keypoints [5, 3] on the surface, studio frame, metres."""
        found = {}
        for identity in self.takes:
            head = load_json(self.studio / "truth" / "identities" / identity / "head.json")
            found[identity] = np.array([head["keypoints"][name] for name in CANONICAL_KEYPOINTS])
        return found

    def true_from_rig(self, take: str, rig: Rig) -> Rigid:
        """The studio's frame from that of a calibrated rig of the same cameras.

        Each calibration chooses its own frame. The two are brought together where it matters: the true images
        of the people's keypoints are triangulated with the calibrated cameras, and a rigid motion carries them
        onto the true keypoints. What remains of the calibration's errors is not removed by it.
        """
        true = self.rigs[take]
        names = [name for name in rig.cameras if name in true.cameras]
        points = np.concatenate([self.keypoints[i] for i, of in self.takes.items() if of == take])
        pixels = np.full((len(points), len(names), 2), np.nan)
        for index, name in enumerate(names):
            standing = true.cameras[name]
            found, seen = standing.camera.project(standing.camera_from_rig.apply(points))
            pixels[seen, index] = found[seen]
        cameras = [rig.cameras[name] for name in names]
        views = Views.stack([c.camera for c in cameras], [c.camera_from_rig.inverse for c in cameras])
        found = triangulate(views, pixels, 0.1)
        fit = fit_similarity(found.points[found.ok], points[found.ok], fixed_scale=1.0).target_from_source
        return Rigid(fit.rotation, fit.translation)


def error_rows(errors: np.ndarray) -> list[dict[str, Any]]:
    """One row per keypoint, and one for all, of errors [S, 5, 3] in metres (studio frame); NaN where missing.

    Distances are in mm; bias is the mean error, to the subject's left, up, and out of the face.
    """
    rows = []
    for name, of_keypoint in [
        *zip(CANONICAL_KEYPOINTS, np.swapaxes(errors, 0, 1), strict=True),
        ("all", errors),
    ]:
        known = of_keypoint.reshape(-1, 3)
        known = 1e3 * known[np.isfinite(known).all(axis=-1)]
        distance = np.linalg.norm(known, axis=-1)
        row = {"keypoint": name, "people": len(known)}
        if len(known):
            bias = known.mean(axis=0)
            row |= {
                "median": float(np.median(distance)),
                "RMS": float(np.sqrt((distance**2).mean())),
                "worst": float(distance.max()),
                "bias left": float(bias[0]),
                "bias up": float(bias[1]),
                "bias out": float(bias[2]),
                "RMS without bias": float(np.sqrt(((known - bias) ** 2).sum(axis=-1).mean())),
            }
        rows.append(row)
    return rows


def printed(rows: list[dict[str, Any]]) -> str:
    """The rows as a table in plain text."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names, *([_cell(row.get(name)) for name in names] for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(names))]
    lines = []
    for line in cells:
        first, *rest = (
            text.ljust(width) if index == 0 else text.rjust(width)
            for index, (text, width) in enumerate(zip(line, widths, strict=True))
        )
        lines.append("  ".join([first, *rest]))
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
