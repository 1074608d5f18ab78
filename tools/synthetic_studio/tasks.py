"""The units of work that the worker processes share: which images each one makes, and how.

A task is a pure function of the configuration and of its own few numbers. It leaves out what is already on
disk, so repeating it after an interruption only fills the gaps.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from preface.artifacts import write_bytes
from preface.capture.images import write_exr, write_png
from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid
from synthetic_studio.backgrounds import backdrop, background_radiance, composite
from synthetic_studio.board_render import KEY_DIRECTION, BoardCamera, render_board
from synthetic_studio.boards import board_pose
from synthetic_studio.config import StudioConfig
from synthetic_studio.estimate import HEAD, board_seconds, photograph_seconds, plate_seconds
from synthetic_studio.layout import Layout, frame_id, identity_id, take_id
from synthetic_studio.patterns import BoardPattern
from synthetic_studio.rig import StudioCamera, camera_id, nominal_rig, take_rig
from synthetic_studio.sensor import expose, vignetting, vignetting_strength
from synthetic_studio.streams import Stream, generator


class View(Protocol):
    """A person in one view."""

    @property
    def radiance(self) -> np.ndarray:
        """Linear light [H, W, 3], premultiplied by coverage."""

    @property
    def alpha(self) -> np.ndarray:
        """Coverage [H, W] in 0..1."""

    @property
    def depth(self) -> np.ndarray:
        """Metres along the camera's z [H, W]; NaN where there is no surface."""

    @property
    def normals(self) -> np.ndarray:
        """Unit normals [H, W, 3] in the studio's frame; NaN where there is no surface."""


class Subject(Protocol):
    """A person, a pure function of its arguments."""

    def __init__(self, seed: int, index: int, assets: Path | None) -> None: ...

    @property
    def parameters(self) -> dict[str, Any]:
        """What the person was made from, as JSON values."""

    @property
    def keypoints(self) -> dict[str, np.ndarray]:
        """The five canonical keypoints, [3] metres in the studio's frame."""

    @property
    def landmarks(self) -> dict[str, np.ndarray]:
        """Points on the surface by name, [3] metres in the studio's frame."""

    def render(self, camera: Camera, camera_from_studio: Rigid, antialias: int) -> View:
        """Render one view with antialias x antialias samples per pixel."""


@dataclass(frozen=True)
class Step:
    """A part of a task that is not interrupted: what it makes, how many images that is, in which time, and how."""

    what: str
    images: int
    seconds: float
    work: Callable[[], None]


@dataclass(frozen=True)
class CalibrationTask:
    """Missing calibration frames, and the clean plate if `plate`, of one camera in one take."""

    take: int
    camera: int
    frames: tuple[int, ...]
    plate: bool

    @property
    def images(self) -> int:
        """Number of images that the task writes into the capture."""
        return len(self.frames) + self.plate

    def seconds(self, config: StudioConfig) -> float:
        """By the cost model, on one core."""
        return len(self.frames) * board_seconds(config) + self.plate * plate_seconds(config)

    def steps(self, studio: Studio) -> Iterator[Step]:
        """The work, image by image."""
        where = f"take {take_id(self.take)}, camera {camera_id(self.camera)}"
        if self.plate:
            work = partial(studio.write_plate, self.take, self.camera)
            yield Step(f"clean plate of {where}", 1, plate_seconds(studio.config), work)
        view = BoardCamera(studio.rig(self.take)[self.camera].camera)
        for frame in self.frames:
            work = partial(studio.write_frame, self.take, self.camera, frame, view)
            yield Step(f"calibration {frame_id(frame)} of {where}", 1, board_seconds(studio.config), work)


@dataclass(frozen=True)
class HeadTask:
    """Missing photographs of one person, and the truth about the head if `describe`."""

    identity: int
    views: tuple[int, ...]
    describe: bool

    @property
    def images(self) -> int:
        """Number of images that the task writes into the capture."""
        return len(self.views)

    def seconds(self, config: StudioConfig) -> float:
        """By the cost model, on one core."""
        return HEAD + len(self.views) * photograph_seconds(config)

    def steps(self, studio: Studio) -> Iterator[Step]:
        """The work, image by image."""
        who, seconds = f"identity {identity_id(self.identity)}", photograph_seconds(studio.config)
        modelling = HEAD  # part of whatever comes first
        if self.describe:
            yield Step(f"{who}, the head", 0, modelling, partial(studio.write_head, self.identity))
            modelling = 0.0
        for camera in self.views:
            work = partial(studio.write_view, self.identity, camera)
            yield Step(f"{who}, view {camera_id(camera)}", 1, seconds + modelling, work)
            modelling = 0.0


Task = CalibrationTask | HeadTask


@dataclass
class Studio:
    """The studio as one worker process sees it, with what the images have in common made once."""

    config: StudioConfig
    subject_module: str
    _rigs: dict[int, list[StudioCamera]] = field(default_factory=dict)
    _latest: tuple[int, Subject] | None = None

    @cached_property
    def layout(self) -> Layout:
        """Where the files lie."""
        return Layout(self.config.output)

    @cached_property
    def pattern(self) -> BoardPattern:
        """The calibration board."""
        return BoardPattern.from_config(self.config.board)

    @cached_property
    def _subject_class(self) -> type[Subject]:
        """Imported when the first person is needed, since it brings large libraries."""
        subject_class: type[Subject] = importlib.import_module(self.subject_module).Subject
        return subject_class

    def rig(self, take: int) -> list[StudioCamera]:
        """The cameras as they stand in a take."""
        if take not in self._rigs:
            nominal = nominal_rig(self.config.views, self.config.size, self.config.seed)
            self._rigs[take] = take_rig(nominal, self.config.drift, self.config.seed, take)
        return self._rigs[take]

    def pose(self, take: int, frame: int) -> Rigid:
        """rig_from_board in a frame of a take."""
        return board_pose(self.config.board, self.pattern, self.config.seed, take, frame)

    def take_of(self, identity: int) -> int:
        """The take in which a person is photographed: the people come in order, equally many per take."""
        return identity * self.config.takes // max(self.config.identities, 1)

    def subject(self, identity: int) -> Subject:
        """A person; the latest one is kept, since modelling one takes seconds."""
        if self._latest is None or self._latest[0] != identity:
            self._latest = None  # frees the memory before the next one is made
            self._latest = (identity, self._subject_class(self.config.seed, identity, self.config.assets))
        return self._latest[1]

    def write_frame(self, take: int, camera: int, frame: int, view: BoardCamera) -> None:
        """Photograph the board."""
        rig_from_board = self.pose(take, frame)
        key = rig_from_board.rotation.T @ KEY_DIRECTION
        camera_from_board = self.rig(take)[camera].camera_from_rig @ rig_from_board
        light = render_board(self.pattern, camera_from_board, key, view)
        self._photograph(
            self.layout.frame(take, camera, frame), light, take, camera, Stream.BOARD_NOISE, frame
        )

    def write_plate(self, take: int, camera: int) -> None:
        """Photograph the empty studio."""
        light = self._backdrop(take, camera)
        self._photograph(self.layout.plate(take, camera), light, take, camera, Stream.PLATE_NOISE)

    def write_head(self, identity: int) -> None:
        """Write what is true of a head in all views."""
        person = self.subject(identity)
        truth = {
            "identity": identity_id(identity),
            "take": take_id(self.take_of(identity)),
            "units": "metre",
            "parameters": person.parameters,
            "keypoints": _points(person.keypoints),
            "landmarks": _points(person.landmarks),
        }
        write_json(self.layout.head(identity), truth)

    def write_view(self, identity: int, camera: int) -> None:
        """Photograph a person; the image comes last, so that it stands for all files of the view."""
        take = self.take_of(identity)
        standing = self.rig(take)[camera]
        view = self.subject(identity).render(standing.camera, standing.camera_from_rig, self.config.antialias)
        files = self.layout.view(identity, camera)
        coverage = np.clip(view.alpha, 0, 1)
        write_png(made(files.mask), np.round(coverage * 65535).astype(np.uint16))
        write_exr(made(files.depth), {"Y": view.depth.astype(np.float32)})
        normals = view.normals.astype(np.float16)
        write_exr(made(files.normals), dict(zip("RGB", np.moveaxis(normals, -1, 0), strict=True)))
        light = composite(view.radiance, coverage, self._backdrop(take, camera))
        self._photograph(files.image, light, take, camera, Stream.SUBJECT_NOISE, identity)

    def _backdrop(self, take: int, camera: int) -> np.ndarray:
        kind = backdrop(self.config, take)
        return background_radiance(kind, self.rig(take)[camera].camera, self.config.seed, take, camera)

    def _photograph(
        self, path: Path, light: np.ndarray, take: int, camera: int, stream: Stream, *entities: int
    ) -> None:
        config = self.config
        strength = vignetting_strength(config.sensor, config.seed, camera)
        falloff = vignetting(self.rig(take)[camera].camera, strength)
        again = config.sensor.exposure_seed
        exposure = () if again is None else (again,)
        noise = generator(config.seed, stream, take, camera, *entities, *exposure)
        write_png(made(path), expose(light, falloff, config.sensor, noise))


def missing_tasks(studio: Studio) -> list[Task]:
    """The tasks for all files that are not there yet, heads first because they take longest.

    With fewer people than workers, each person's views are shared out among several tasks.
    """
    config, layout = studio.config, studio.layout
    tasks: list[Task] = []
    cameras = range(config.views)
    for identity in range(config.identities):
        views = [camera for camera in cameras if not layout.view(identity, camera).complete()]
        describe = not layout.head(identity).is_file()
        shares = max(1, min(-(-config.workers // config.identities), len(views)))
        tasks += [
            HeadTask(identity, tuple(views[share::shares]), describe and share == 0)
            for share in range(shares)
            if views or describe
        ]
    for take in range(config.takes):
        for camera in cameras:
            frames = [f for f in range(config.board.frames) if not layout.frame(take, camera, f).is_file()]
            plate = config.clean_plates and not layout.plate(take, camera).is_file()
            if frames or plate:
                tasks.append(CalibrationTask(take, camera, tuple(frames), plate))
    return tasks


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a JSON file of the truth, atomically; refuses NaN."""
    write_bytes(made(path), (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def made(path: Path) -> Path:
    """The path, its folder created if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _points(points: dict[str, np.ndarray]) -> dict[str, list[float]]:
    return {name: [float(value) for value in point] for name, point in points.items()}
