"""Writing a whole studio: the configuration's marker first, the truth, the images, the manifest last.

A directory belongs to one configuration, one version of the studio and one set of packages, which the marker
records; anything else is refused, so that a resumed capture is byte for byte what an uninterrupted one is.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import provenance, write_bytes
from preface.capture.manifest import Board, CaptureCamera, Manifest, Subject, Take, write_capture
from preface.capture.rig import Rig, RigCamera, write_rig
from synthetic_studio.assets import check_assets
from synthetic_studio.backgrounds import backdrop
from synthetic_studio.boards import seen_corners
from synthetic_studio.config import StudioConfig, StudioError, content, validate
from synthetic_studio.estimate import estimate
from synthetic_studio.layout import Layout, frame_id, identity_id, take_id
from synthetic_studio.patterns import BoardPattern
from synthetic_studio.pool import run_tasks
from synthetic_studio.rig import camera_id
from synthetic_studio.tasks import Studio, missing_tasks, write_json

SUBJECT_MODULE = "synthetic_studio.subject"
BOARD_ID = "board"


def write_studio(config: StudioConfig, subject_module: str = SUBJECT_MODULE) -> Path:
    """Write, or finish, a studio.

    Args:
        config: what to write and where.
        subject_module: name of the importable module whose `Subject` is a person (`tasks.Subject`).

    Returns:
        The capture's directory.

    Raises:
        UsageError: a flag that cannot work.
        StudioError: the directory belongs to another configuration, the disk is too small, or a task failed.
        ArtifactError: the disk refuses, or an asset is broken.
    """
    validate(config)
    if config.assets is not None:
        check_assets(config.assets)
    studio = Studio(config, subject_module)
    claim(studio)
    tasks = missing_tasks(studio)
    _check_disk(config, sum(task.images for task in tasks))
    _write_takes(studio)
    run_tasks(config, subject_module, tasks)
    write_capture(studio.layout.capture, _manifest(studio))
    return studio.layout.capture


def claim(studio: Studio) -> None:
    """Make the output directory this configuration's own, and clear what an interrupted write left there."""
    layout, mine = studio.layout, _identity(studio)
    if layout.marker.is_file():
        _refuse_another(json.loads(layout.marker.read_text()), mine, layout)
    elif layout.root.is_dir() and any(layout.root.iterdir()):
        raise StudioError(
            f"{layout.root} has files but no {layout.marker.relative_to(layout.root)}: it is not a studio's; "
            "name an empty or a new directory with --output"
        )
    else:
        write_json(layout.marker, mine)
    for leftover in layout.root.rglob(".*.tmp"):
        leftover.unlink()


def _identity(studio: Studio) -> dict[str, Any]:
    """All that decides the bytes of the files."""
    config = studio.config
    return {
        "config": content(config),
        "assets": None if config.assets is None else _listing_digest(config.assets),
        "subjects": studio.subject_module,
        "studio": _sources_digest(),
        "versions": provenance({}, {})["versions"],
    }


def _refuse_another(theirs: dict[str, Any], mine: dict[str, Any], layout: Layout) -> None:
    differences = list(_differences(theirs, mine, ""))
    if differences:
        raise StudioError(
            f"{layout.root} holds a studio of another configuration ({'; '.join(differences)}); "
            "repeat the earlier flags to resume it, name another --output, or delete the directory"
        )


def _differences(theirs: Any, mine: Any, name: str) -> Iterator[str]:
    if isinstance(theirs, dict) and isinstance(mine, dict):
        for key in dict.fromkeys((*theirs, *mine)):
            yield from _differences(theirs.get(key), mine.get(key), f"{name}.{key}" if name else key)
    elif theirs != mine:
        yield f"{name.removeprefix('config.')}: {theirs} there, {mine} now"


def _sources_digest() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _listing_digest(folder: Path) -> str:
    """Digest of the names and sizes of all files in a folder; reading them all would take too long."""
    files = (path for path in folder.rglob("*") if path.is_file())
    listing = sorted((path.relative_to(folder).as_posix(), path.stat().st_size) for path in files)
    return hashlib.sha256(repr(listing).encode()).hexdigest()[:16]


def _check_disk(config: StudioConfig, images: int) -> None:
    whole = estimate(config)
    needed = whole.bytes * images // max(whole.images, 1)
    free = shutil.disk_usage(config.output).free
    if needed > free:
        raise StudioError(
            f"{config.output}: {needed / 1e9:.1f} GB are still to be written, {free / 1e9:.1f} GB are free; "
            "free some space or choose another --output, then run the same command again"
        )


def _write_takes(studio: Studio) -> None:
    for take in range(studio.config.takes):
        folder = studio.layout.take(take)
        folder.mkdir(parents=True, exist_ok=True)
        cameras = {one.id: RigCamera.at(one.camera, one.camera_from_rig) for one in studio.rig(take)}
        write_rig(folder / "rig.json", Rig(take_id(take), cameras))
        _write_boards(studio, take)


def _write_boards(studio: Studio, take: int) -> None:
    pattern, frames = studio.pattern, range(studio.config.board.frames)
    poses = [studio.pose(take, frame) for frame in frames]
    truth = {
        "take": take_id(take),
        "units": "metre",
        "board": {
            "type": pattern.kind,
            "squares": list(pattern.squares),
            "square_size": pattern.square,
            "bow": list(pattern.bow),
            "corners": pattern.corners.tolist(),
        },
        "frames": [
            {
                "name": frame_id(frame),
                "rig_from_board": {
                    "quaternion_wxyz": pose.quaternion_wxyz.tolist(),
                    "translation": pose.translation.tolist(),
                },
            }
            for frame, pose in zip(frames, poses, strict=True)
        ],
    }
    write_json(studio.layout.take(take) / "boards.json", truth)
    seen = [[seen_corners(pattern, pose, camera) for camera in studio.rig(take)] for pose in poses]
    archive = io.BytesIO()
    np.savez_compressed(
        archive,
        pixels=np.array([[corners.pixels for corners in row] for row in seen]),
        visible=np.array([[corners.visible for corners in row] for row in seen]),
    )
    write_bytes(studio.layout.take(take) / "corners.npz", archive.getvalue())


def _manifest(studio: Studio) -> Manifest:
    config = studio.config
    width, height = config.size
    return Manifest(
        cameras=tuple(CaptureCamera(camera_id(index), width, height) for index in range(config.views)),
        takes=tuple(_take(config, take) for take in range(config.takes)),
        subjects=tuple(
            Subject(identity_id(identity), take_id(studio.take_of(identity)))
            for identity in range(config.identities)
        ),
        boards=(_board(studio.pattern),),
        provenance=provenance(content(config), {}, config.seed),
    )


def _take(config: StudioConfig, take: int) -> Take:
    plates = f"background/{take_id(take)}" if config.clean_plates else None
    return Take(take_id(take), BOARD_ID, backdrop(config, take), plates=plates)


def _board(pattern: BoardPattern) -> Board:
    if pattern.kind == "chessboard":
        return Board(BOARD_ID, "chessboard", pattern.squares, pattern.square)
    return Board(BOARD_ID, "charuco", pattern.squares, pattern.square, pattern.marker, pattern.dictionary)
