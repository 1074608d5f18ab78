"""Shows a synthetic studio: ``python tools/show_studio.py DIR`` writes ``DIR/report.html`` and its twin.

The page has contact sheets of people and calibration frames, the truth about one person (coverage, depth,
normals, keypoints) drawn over the photographs, and the cameras. Photographs come from ``DIR/capture``, which
is read as any capture, and the rest from ``DIR/truth`` (see ``tools/synthetic_studio/layout.py``).
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro

from preface.artifacts import ArtifactError, load_json, provenance
from preface.capture.images import read_exr, read_image
from preface.capture.manifest import Capture, Subject, read_capture
from preface.capture.rig import Rig, RigCamera, read_rig
from preface.cli.output import exit_status
from preface.cli.typed_flags import refusing, told_in_a_line
from preface.model.rendering.showing import depth_entry, depth_picture, normals_entry, normals_picture
from preface.reports import (
    KeyFigure,
    Report,
    Section,
    contact_sheet,
    finite_range,
    overlay_mask_edges,
    overlay_points,
    with_legend,
)
from preface.reports.pictures import GREEN, Picture, as_picture

PROGRAM = "show_studio"
SHEET_TILE = (192, 288)
CLOSE_TILE = (360, 540)
CLOSE_LEGEND = (depth_entry("near", "far, in metres below each picture"), normals_entry())
CLOSE_CAMERAS = 4  # rows of the close look; the studio numbers its most useful views first
RED = (255, 90, 80)
YELLOW = (255, 210, 60)
HIDDEN_BEHIND = 0.005  # metres behind the first surface from where on a point counts as hidden


@dataclass(frozen=True)
class ShowStudio:
    """Write a page that shows a synthetic studio."""

    studio: tyro.conf.Positional[Path]
    """Folder with the studio's capture/ and truth/."""

    people: int = 8
    """How many people to show, the first ones of the capture."""

    frames: int = 4
    """How many calibration frames of the first take to show."""

    page: str = "report.html"
    """Name of the page within the folder."""


@dataclass(frozen=True)
class Studio:
    """A capture with its truth."""

    directory: Path
    capture: Capture

    def rig(self, take: str) -> Rig:
        """The true cameras of a take."""
        return read_rig(self.directory / "truth" / "takes" / take / "rig.json")

    def corners(self, take: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Frame name to the board's corners: pixels [cameras, corners, 2] and visible [cameras, corners]."""
        folder = self.directory / "truth" / "takes" / take
        names = [frame["name"] for frame in load_json(folder / "boards.json")["frames"]]
        try:
            with np.load(folder / "corners.npz") as archive:
                pixels, visible = archive["pixels"], archive["visible"]
        except OSError as error:
            raise ArtifactError.from_os(folder / "corners.npz", "file", error) from error
        return dict(zip(names, zip(pixels, visible, strict=True), strict=True))

    def head(self, subject: str) -> dict[str, Any]:
        """Parameters, keypoints and landmarks of a person."""
        return load_json(self._identity(subject) / "head.json")

    def coverage(self, subject: str, camera: str) -> np.ndarray:
        """Fractional coverage [H, W] in [0, 1]."""
        return read_image(self._identity(subject) / "mask" / f"{camera}.png")[:, :, 0] / 65535.0

    def depth(self, subject: str, camera: str) -> np.ndarray:
        """Depth along the camera's z axis [H, W], metres, NaN where there is no surface."""
        return read_exr(self._identity(subject) / "depth" / f"{camera}.exr")["Y"].astype(np.float64)

    def normals(self, subject: str, camera: str) -> np.ndarray:
        """Unit normals [H, W, 3] in the rig frame, NaN where there is no surface."""
        channels = read_exr(self._identity(subject) / "normals" / f"{camera}.exr")
        return np.stack([channels[name] for name in "RGB"], -1).astype(np.float64)

    def _identity(self, subject: str) -> Path:
        return self.directory / "truth" / "identities" / subject


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 0 when the page is written, 1 when something is wrong with the studio."""
    with told_in_a_line(PROGRAM):
        config = tyro.cli(ShowStudio, prog=PROGRAM, args=arguments)

    def run() -> list[str]:
        studio = Studio(config.studio, read_capture(config.studio / "capture"))
        return [str(build_report(studio, config).write(config.studio / config.page))]

    return exit_status(run, refusing(PROGRAM), config.studio)


def build_report(studio: Studio, config: ShowStudio) -> Report:
    """The whole page."""
    manifest = studio.capture.manifest
    inputs = {
        "capture.json": studio.directory / "capture" / "capture.json",
        "studio.json": studio.directory / "truth" / "studio.json",
    }
    origin = provenance({"people": config.people, "frames": config.frames}, inputs)
    report = Report("Synthetic studio", {**origin, "capture": dict(manifest.provenance or {})})
    _show_overview(report.section("Overview"), studio)
    people = manifest.subjects[: config.people]
    if people:
        _show_people(report.section("People"), studio, people)
        _show_closely(report.section(f"The truth about {people[0].id}"), studio, people[0])
    _show_calibration(report.section("Calibration frames"), studio, config.frames)
    _show_cameras(report.section("Cameras"), studio)
    return report


def _show_overview(section: Section, studio: Studio) -> None:
    capture, manifest = studio.capture, studio.capture.manifest
    calibration = sum(
        len(capture.calibration_files(t, c.id)) for t in manifest.takes for c in manifest.cameras
    )
    sizes = sorted({f"{camera.width} × {camera.height}" for camera in manifest.cameras})
    section.key_figures(
        [
            KeyFigure("people", len(manifest.subjects)),
            KeyFigure("cameras", len(manifest.cameras)),
            KeyFigure("takes", len(manifest.takes)),
            KeyFigure("photographs", len(capture.images)),
            KeyFigure("calibration images", calibration),
            KeyFigure("size", ", ".join(sizes), "px"),
        ]
    )


def _show_people(section: Section, studio: Studio, people: tuple[Subject, ...]) -> None:
    capture = studio.capture
    cameras = [camera.id for camera in capture.manifest.cameras]

    def tile(subject: str, camera: str) -> tuple[Picture | None, str]:
        file = capture.images.get((subject, camera))
        return None if file is None else _fitted(read_image(file), SHEET_TILE)[0], f"{subject} {camera}"

    tiles = [tile(subject.id, camera) for subject in people for camera in cameras]
    shown, total = len(people), len(capture.manifest.subjects)
    section.image(
        contact_sheet(tiles, len(cameras), SHEET_TILE),
        f"{shown} of {total} people, one row each, seen by all cameras. Click to enlarge.",
        f"Contact sheet of {shown} rendered heads in {len(cameras)} views",
        "jpeg",
    )
    rows = [{"person": p.id, "take": p.take, **_plain_parameters(studio.head(p.id))} for p in people]
    section.table(rows, "What they were made from; everything else is in truth/identities")


def _plain_parameters(head: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in head["parameters"].items() if isinstance(v, (int, float, str, bool))}


def _show_closely(section: Section, studio: Studio, subject: Subject) -> None:
    section.text(
        "Photograph with the five keypoints (red where another surface hides them), photograph with the line "
        "of half coverage, coverage, depth along the camera's axis, and normals in the rig frame."
    )
    rig, cameras = studio.rig(subject.take), [camera.id for camera in studio.capture.manifest.cameras]
    tiles = [
        tile for camera in cameras[:CLOSE_CAMERAS] for tile in close_row(studio, subject.id, camera, rig)
    ]
    section.image(
        with_legend(contact_sheet(tiles, columns=5, tile_size=CLOSE_TILE), CLOSE_LEGEND),
        f"{subject.id} from {min(len(cameras), CLOSE_CAMERAS)} cameras, one row each. Click to enlarge.",
        "Rows of photograph with keypoints, mask outline, coverage, depth and normals",
        "jpeg",
    )


def close_row(studio: Studio, subject: str, camera: str, rig: Rig) -> Iterator[tuple[Picture | None, str]]:
    """The tiles of one view: keypoints, outline, coverage, depth, normals; empty without a photograph."""
    file = studio.capture.images.get((subject, camera))
    if file is None:
        yield from [(None, f"{camera} missing")] * 5
        return
    coverage, depth = studio.coverage(subject, camera), studio.depth(subject, camera)
    photograph, scale = _fitted(read_image(file), CLOSE_TILE)
    points = {name: np.array(point) for name, point in studio.head(subject)["keypoints"].items()}
    yield _with_keypoints(photograph, scale, points, depth, rig.cameras[camera]), f"{camera} keypoints"
    outline = cv2.resize(coverage, photograph.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    yield overlay_mask_edges(photograph, outline, 2, GREEN), f"{camera} mask outline"
    yield as_picture(coverage), f"{camera} coverage"
    low, high = finite_range(depth, 0, 100)
    yield depth_picture(depth, low, high), f"{camera} depth {low:.3f} to {high:.3f} m"
    yield normals_picture(studio.normals(subject, camera)), f"{camera} normals"


def _with_keypoints(
    photograph: Picture, scale: float, points: dict[str, np.ndarray], depth: np.ndarray, standing: RigCamera
) -> Picture:
    """The photograph with keypoints (rig frame, metres): green in sight, red behind the first surface."""
    in_camera = standing.camera_from_rig.apply(np.stack(list(points.values())))
    pixels, _ = standing.camera.project(in_camera)
    names = np.array([name.replace("_", " ") for name in points])
    column, row = (
        np.clip(np.nan_to_num(p), 0, n - 1).astype(int)
        for p, n in zip(pixels.T, depth.shape[::-1], strict=True)
    )
    hidden = in_camera[:, 2] > depth[row, column] + HIDDEN_BEHIND
    for chosen, color in ((~hidden, GREEN), (hidden, RED)):
        photograph = overlay_points(photograph, pixels[chosen] * scale, names[chosen].tolist(), 4, color)
    return photograph


def _show_calibration(section: Section, studio: Studio, count: int) -> None:
    manifest = studio.capture.manifest
    take, cameras = manifest.takes[0], [camera.id for camera in manifest.cameras]
    files = [{f.stem: f for f in studio.capture.calibration_files(take, camera)} for camera in cameras]
    tiles: list[tuple[Picture | None, str]] = []
    for frame, (pixels, visible) in list(studio.corners(take.id).items())[:count]:
        for index, camera in enumerate(cameras):
            if frame not in files[index]:
                tiles.append((None, f"{frame} {camera} missing"))
                continue
            photograph, scale = _fitted(read_image(files[index][frame]), SHEET_TILE)
            corners = pixels[index][visible[index]] * scale
            tiles.append((overlay_points(photograph, corners, None, 1, YELLOW), f"{frame} {camera}"))
    if not tiles:
        section.text(f"Take {take.id} has no calibration frames.")
        return
    section.image(
        contact_sheet(tiles, len(cameras), SHEET_TILE),
        f"The board in {take.id}, one row per frame, with the true corners in sight. Click to enlarge.",
        f"Contact sheet of a calibration board in {len(cameras)} cameras",
        "jpeg",
    )


def _show_cameras(section: Section, studio: Studio) -> None:
    rigs = [studio.rig(take.id) for take in studio.capture.manifest.takes]
    rows = [_camera_row(name, rigs) for name in rigs[0].cameras]
    units = {
        "focal x": "px",
        "focal y": "px",
        "azimuth": "°",
        "elevation": "°",
        "distance": "m",
        "drift": "mm",
    }
    section.table(
        rows,
        f"True cameras of {rigs[0].take}. Azimuth runs to the subject's left; drift is the largest "
        "distance of the camera's centre from this one in any other take.",
        units={name: unit for name, unit in units.items() if name in rows[0]},
    )


def _camera_row(name: str, rigs: list[Rig]) -> dict[str, Any]:
    standing = rigs[0].cameras[name]
    centres = np.array([rig.cameras[name].camera_from_rig.inverse.translation for rig in rigs])
    x, y, z = centres[0]
    fx, fy = standing.camera.intrinsics[:2]
    row = {
        "camera": name,
        "model": standing.camera.model,
        "focal x": fx,
        "focal y": fy,
        "azimuth": np.degrees(np.arctan2(x, z)),
        "elevation": np.degrees(np.arctan2(y, np.hypot(x, z))),
        "distance": np.linalg.norm(centres[0]),
    }
    if len(rigs) > 1:
        row["drift"] = 1000 * np.linalg.norm(centres - centres[0], axis=-1).max()
    return row


def _fitted(image: np.ndarray, tile: tuple[int, int]) -> tuple[Picture, float]:
    """The image scaled to fit a tile (width, height), so that drawings keep their size, and the scale."""
    picture = as_picture(image)
    scale = min(tile[0] / picture.shape[1], tile[1] / picture.shape[0])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, size, interpolation=method), np.uint8), scale


if __name__ == "__main__":
    sys.exit(main())
