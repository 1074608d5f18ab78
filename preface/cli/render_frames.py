"""The work of ``preface-render``: which cameras, which code, and the files of each frame."""

import argparse
import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from preface.align.person_file import Alignment, read_alignment
from preface.artifacts import ArtifactError, load_json, provenance, sha256
from preface.capture.chatter import without_chatter
from preface.capture.folders import DEFAULT_TAKE
from preface.capture.formats import read_rig_from
from preface.capture.images import IMAGE_SUFFIXES, write_exr, write_png
from preface.capture.rig import Rig, RigCamera, read_rig, write_rig
from preface.cli.devices import usable_device
from preface.cli.folders import make_folder, require_own, require_writable
from preface.cli.output import say
from preface.cli.render_flags import chosen_shortcuts
from preface.cli.rig_files import one_rig_file
from preface.cli.usage import UsageError
from preface.geometry import Box, Camera, Rigid
from preface.model.matmul import choose_route, denormals_flushed, keep_freed_memory
from preface.model.model import PriorModel
from preface.model.rendering.accelerated import precision_of
from preface.model.rendering.image import RenderedImage, RenderRays, Space, render_image, space_of
from preface.model.rendering.mesh import MESH_SUFFIXES, extract_mesh, model_field, voxel_side, write_mesh
from preface.model.rendering.paths import framing_camera, on_sphere, orbit
from preface.model.rendering.shortcuts import Shortcuts, accelerate
from preface.model.rendering.showing import depth_entry, depth_picture, normals_entry, normals_picture
from preface.model.training.prior_files import Prior, read_prior
from preface.plain_words import suggestion
from preface.reports.pictures import Picture, as_picture, legend
from preface.shards.writer import box_depths

CAMERAS_FILE, VIDEO_FILE, LEGEND_FILE = "rig.json", "orbit.webm", "legend.png"
LEGEND_WIDTH = 720  # pixels
CANONICAL = "canonical"  # the take of the cameras that were written here
FRAMES_PER_SECOND = 24
ALPHA = ".alpha.png"  # every frame has one
# Settings of where things are written, of how it is computed, and of the mesh, which has a file of its own.
NOT_OF_THE_FRAMES = ("output", "device", "rays_at_a_time", "mesh", "mesh_resolution", "surface")
# WebM names its codecs without four letters, of which OpenCV wants some, and says so whichever they are.
VIDEO_CHATTER = re.compile("OpenCV: FFMPEG: tag 0x30395056/'VP90' is not supported with codec id")
SECONDS_BETWEEN = 10.0  # between two lines about one image


def run(config: argparse.Namespace) -> list[str]:
    """Render every frame and write its files, then the cameras."""
    if config.mesh is not None and config.mesh.suffix not in MESH_SUFFIXES:
        raise UsageError(f"--mesh: {config.mesh.name} does not end in one of {', '.join(MESH_SUFFIXES)}")
    keep_freed_memory()
    with denormals_flushed():
        return _rendered(config)


def _rendered(config: argparse.Namespace) -> list[str]:
    prior = read_prior(config.model)
    device, shortcuts = usable_device(config.device), chosen_shortcuts(config)
    space = space_of(prior)
    box = space.box
    frames = _cameras(config, prior, box)
    depths = _depths(frames, box)
    codes = _codes(config, prior, len(frames))
    model = prior.load_model().to(device)
    settings = {key: str(value) for key, value in vars(config).items() if value is not None}
    _require_place(config.output, frames, settings)
    require_writable(config.output)
    meshed = _mesh(config, model, space, codes[0]) if config.mesh is not None else []
    if shortcuts != Shortcuts():  # exact to rounding, but what is fastest may differ from run to run
        choose_route(precision_of(model, shortcuts), device, model.nerf.width).apply()
    make_folder(config.output)
    video, progress = _Video(config.output / VIDEO_FILE) if config.video else None, _Progress(frames)
    renderers = _renderers(model, space, codes, shortcuts, config.background, not config.no_normals)
    for (name, (camera, pose)), render in zip(frames.items(), renderers, strict=True):
        image = render_image(
            render,
            space,
            camera,
            pose,
            rays_at_a_time=config.rays_at_a_time,
            device=device,
            progress=progress.rows,
        )
        picture = _write(config.output, name, image, depths, exr=not config.no_exr)
        if video is not None:
            video.add(picture)
        progress.finished(camera)
    _write_legend(config.output, depths, normals=not config.no_normals)
    cameras = {name: RigCamera.at(camera, pose.inverse) for name, (camera, pose) in frames.items()}
    history = provenance(settings, {"model.json": prior.path})
    written = write_rig(config.output / CAMERAS_FILE, Rig(CANONICAL, cameras, provenance=history))
    lines = [str(video.finish())] if video is not None else []
    return [*meshed, *lines, str(written)]


def _require_place(folder: Path, frames: Iterable[str], settings: Mapping[str, str]) -> None:
    """Refuse a folder with others' pictures, which these would join or replace, or with the rig of a capture.

    Pictures of the same command are replaced; those of another one would be half replaced.

    Args:
        folder: to write to; need not exist.
        frames: names of what is rendered.
        settings: of the command, as its rig says them.

    Raises:
        ArtifactError: naming what is there.
    """
    cameras = folder / CAMERAS_FILE
    remedy = "Choose another --output, or empty this folder"
    earlier = load_json(cameras) if cameras.is_file() else {}
    if earlier.get("take") == CANONICAL:
        now = _of_the_frames(settings)
        before = _of_the_frames((earlier.get("provenance") or {}).get("config", {}))
        different = [name for name in sorted(now.keys() | before.keys()) if now.get(name) != before.get(name)]
        if different:
            said = (f"{n} is {_said(before.get(n))} there and {_said(now.get(n))} now" for n in different)
            raise ArtifactError(folder, "folder", f"holds another render: {'; '.join(said)}", remedy)
    else:
        require_own(
            folder,
            "renders",
            (f"*{ALPHA}",),
            lambda entry: entry.name == CAMERAS_FILE or entry.suffix.lower() in IMAGE_SUFFIXES,
        )
    others = sorted({file.name.removesuffix(ALPHA) for file in folder.glob(f"*{ALPHA}")} - set(frames))
    if others:
        some = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
        raise ArtifactError(folder, "folder", f"holds frames of another render ({some})", remedy)


def _said(setting: str | None) -> str:
    return {None: "not given", "True": "on", "False": "off"}.get(setting, str(setting))


def _of_the_frames(settings: Mapping[str, str]) -> dict[str, str]:
    """The settings that frames depend on, beyond rounding."""
    return {name: value for name, value in settings.items() if name not in NOT_OF_THE_FRAMES}


def _renderers(
    model: PriorModel,
    space: Space,
    codes: np.ndarray,
    shortcuts: Shortcuts,
    background: float,
    normals: bool,
) -> Iterator[RenderRays]:
    """A renderer per frame; what is prepared for a code serves all frames in a row that have it."""
    for number, weights in enumerate(codes):
        if number == 0 or not np.array_equal(weights, codes[number - 1]):
            code = _code(model, weights)
            render = accelerate(model, code, space, shortcuts, background=background, normals=normals)
        yield render


class _Progress:
    """Says how many images are done and how long the rest may take, also within an image that takes long."""

    def __init__(self, frames: Mapping[str, tuple[Camera, Rigid]]):
        self._total = sum(camera.width * camera.height for camera, _ in frames.values())
        self._frames, self._images, self._pixels = list(frames.values()), 0, 0
        self._began = self._said = time.perf_counter()

    def rows(self, rows: int) -> None:
        """Rows of the present image are done."""
        if time.perf_counter() - self._said > SECONDS_BETWEEN:
            camera = self._frames[self._images][0]
            share = f"row {rows} of {camera.height}, "
            self._say(share, self._pixels + rows * camera.width)

    def finished(self, camera: Camera) -> None:
        """An image is done, and its files are written."""
        self._images += 1
        self._pixels += camera.width * camera.height
        self._say("", self._pixels)

    def _say(self, within: str, pixels: int) -> None:
        self._said = time.perf_counter()
        passed = self._said - self._began
        left = passed / max(pixels, 1) * (self._total - pixels)
        done = f"{self._images} of {len(self._frames)} images, {within}"
        say(f"{done}{passed:.0f} s, about {left:.0f} s left")


def _code(model: PriorModel, weights: np.ndarray) -> Tensor | None:
    """The mixture of codes [latent]; None for a model without codes."""
    mixed = torch.from_numpy(weights).to(model.codes.device) @ model.codes.detach()
    return mixed if model.config.latent else None


def _mesh(config: argparse.Namespace, model: PriorModel, space: Space, weights: np.ndarray) -> list[str]:
    """Write the surface of the first frame's code."""
    require_writable(config.mesh.parent)
    field = model_field(model, _code(model, weights), voxel_side(space, config.mesh_resolution))
    try:
        mesh = extract_mesh(field, space, config.mesh_resolution, config.surface, model.codes.device)
    except ValueError as error:
        field_name, _, problem = str(error).partition(": ")
        raise ArtifactError(
            config.model, field_name, problem, "Train or fit further, or lower --surface"
        ) from error
    say(f"mesh: {len(mesh.triangles)} triangles")
    make_folder(config.mesh.parent)
    return [str(write_mesh(config.mesh, mesh))]


# ------------------------------------------------------------------------------------- from where


def _cameras(config: argparse.Namespace, prior: Prior, box: Box) -> dict[str, tuple[Camera, Rigid]]:
    """Cameras with their poses canonical_from_camera, by the name of their images."""
    if config.cameras is not None:
        return _given_cameras(config)
    if config.alignment is not None:
        raise UsageError("--alignment speaks of the cameras that --cameras gives, and there are none")
    width, height = config.size or prior.scene.resolution
    camera = framing_camera(box.half_sides, config.distance, width, height)
    azimuth, elevation = math.radians(config.azimuth), math.radians(config.elevation)
    if config.orbit is None:
        return {"front": (camera, on_sphere(box.center, 0.0, 0.0, config.distance))}
    poses = orbit(box.center, config.orbit, config.distance, azimuth, elevation)
    return {f"{number:04d}": (camera, pose) for number, pose in enumerate(poses)}


def _given_cameras(config: argparse.Namespace) -> dict[str, tuple[Camera, Rigid]]:
    if config.size is not None:
        raise UsageError("--size is that of an orbit; the cameras of --cameras have sizes of their own")
    rig, file = _rig(config.cameras)
    poses = {name: camera.camera_from_rig.inverse for name, camera in rig.cameras.items()}
    if config.alignment is not None:
        person = read_alignment(config.alignment)
        if file is not None:
            _require_its_take(file, rig, config.alignment, person)
        carry = person.placement.canonical_from_rig.apply_to_pose
        poses = {name: carry(pose) for name, pose in poses.items()}
    if (taken := Path(LEGEND_FILE).stem) in poses:
        problem = f"'{taken}' is the name of another file of the renders"
        raise ArtifactError(config.cameras, "cameras", problem, "Rename this camera")
    return {name: (rig.cameras[name].camera, pose) for name, pose in poses.items()}


def _require_its_take(file: Path, rig: Rig, alignment: Path, person: Alignment) -> None:
    """Refuse a rig of another take than the one that a person was aligned in: each has a frame of its own.

    A take that has no name of its own says nothing, and a rig that the person was aligned with is right by any name.

    Raises:
        ArtifactError: naming both takes, and the rig to use.
    """
    if rig.take == person.take or DEFAULT_TAKE in (rig.take, person.take):
        return
    if (person.provenance or {}).get("inputs", {}).get(f"rigs/{person.take}.json") == sha256(file):
        return
    problem = f"is '{rig.take}', and {alignment} was made in take '{person.take}'"
    if rig.take == CANONICAL:
        remedy = "These cameras are in the canonical frame: leave --alignment away"
    else:
        its = file.with_name(f"{person.take}.json")  # as preface-calibrate names them
        remedy = f"Give the rig of take '{person.take}'{f', {its}' if its.is_file() else ''}"
    raise ArtifactError(file, "take", problem, remedy)


def _rig(path: Path) -> tuple[Rig, Path | None]:
    """A rig of ours and its file, or one of a format that preface-calibrate imports, which knows no takes."""
    try:
        file = one_rig_file(path)
        return read_rig(file), file
    except ArtifactError as error:
        if path.match("rig*.json") or any(path.glob("rigs/*.json")):
            raise
        try:
            return read_rig_from(path), None
        except ArtifactError as other:
            raise other from error


# -------------------------------------------------------------------------------------------- who


def _codes(config: argparse.Namespace, prior: Prior, frames: int) -> np.ndarray:
    """What each identity's code contributes to each frame, float32 [frames, identities]."""
    names = prior.identities
    if config.identity is None and len(names) > 1:
        shown = ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")
        raise UsageError(f"--identity is needed: the model knows {len(names)} ({shown})")
    first = _index(prior, config.identity) if config.identity is not None else 0
    last = _index(prior, config.towards) if config.towards is not None else first
    weights = np.zeros((frames, len(names)), np.float32)
    for number, share in enumerate(np.linspace(0, 1, frames) if frames > 1 else [0.0]):
        weights[number, first] += 1 - share
        weights[number, last] += share
    return weights


def _index(prior: Prior, name: str) -> int:
    if name not in prior.identities:
        problem = f"there is no '{name}'"
        raise ArtifactError(prior.path, "identities", problem, suggestion(name, prior.identities))
    return prior.identities.index(name)


# ------------------------------------------------------------------------------------- the files


def _depths(frames: Mapping[str, tuple[Camera, Rigid]], box: Box) -> tuple[float, float]:
    """Metres between which the box lies before all the cameras: a colour is then the same depth in every picture."""
    corners = np.stack([box.minimum, box.maximum])
    ends = np.array([box_depths(corners, pose.matrix[:3]) for _, pose in frames.values()])
    return float(ends[:, 0].min()), float(ends[:, 1].max())


def _write_legend(folder: Path, depths: tuple[float, float], *, normals: bool) -> None:
    """Write what the colours of the pictures of depth and normals mean."""
    near, far = (f"{depth:.2f} m" for depth in depths)
    entries = [depth_entry(f"{near} in front of the camera", far), *([normals_entry()] if normals else [])]
    write_png(folder / LEGEND_FILE, legend(entries, LEGEND_WIDTH))


def _write(
    folder: Path, name: str, image: RenderedImage, depths: tuple[float, float], *, exr: bool
) -> Picture:
    """Write a frame's files; returns the colours as shown."""
    picture = as_picture(image.rgb)
    write_png(folder / f"{name}.png", picture)
    write_png(folder / f"{name}{ALPHA}", np.rint(image.alpha * 255).astype(np.uint8))
    write_png(folder / f"{name}.depth.png", depth_picture(image.depth, *depths))
    channels: dict[str, Any] = {"Z": image.depth}
    if image.normals is not None:
        write_png(folder / f"{name}.normals.png", normals_picture(image.normals))
        channels |= {f"N.{axis}": np.ascontiguousarray(image.normals[..., i]) for i, axis in enumerate("XYZ")}
    if exr:
        colors = {c: np.ascontiguousarray(image.rgb[..., i]) for i, c in enumerate("RGB")}
        write_exr(folder / f"{name}.exr", {**colors, "A": image.alpha, **channels})
    return picture


class _Video:
    """A WebM file (VP9), written under another name until it is finished."""

    def __init__(self, path: Path):
        self._path, self._partial = path, path.with_name(f".{path.name}")
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)

    def add(self, picture: Picture) -> None:
        """Append a picture; all have the size of the first."""
        size = picture.shape[1], picture.shape[0]
        if self._writer is None:
            self._size = size
            codec = cv2.VideoWriter.fourcc(*"VP90")
            partial = self._partial.with_name(f"{self._partial.name}.partial.webm")
            self._partial = partial
            with without_chatter(VIDEO_CHATTER):
                self._writer = cv2.VideoWriter(str(partial), codec, FRAMES_PER_SECOND, size)
            if not self._writer.isOpened():
                raise ArtifactError(
                    self._path, "video", "cannot be written", "Check the folder, or omit --video"
                )
        if size != self._size:
            raise ArtifactError(self._path, "video", "its frames differ in size", "Omit --video")
        self._writer.write(np.ascontiguousarray(picture[:, :, ::-1]))

    def finish(self) -> Path:
        """Close the file and give it its name."""
        assert self._writer is not None
        self._writer.release()
        return self._partial.replace(self._path)
