"""Where every file of a studio lies: the capture as a lab would deliver it, and the truth beside it.

    DIR/capture/capture.json                                written last: a capture that has it is complete
    DIR/capture/calibration/<take>/<camera>/frame000.png    one name in all cameras is one instant
    DIR/capture/subjects/<identity>/<camera>.png
    DIR/capture/background/<take>/<camera>.png              with --clean-plates
    DIR/truth/studio.json                                   the configuration, written first
    DIR/truth/takes/<take>/rig.json                         true cameras, schema preface/rig
    DIR/truth/takes/<take>/boards.json                      board, its corners, rig_from_board per frame
    DIR/truth/takes/<take>/corners.npz                      pixels [F, C, N, 2], visible [F, C, N]
    DIR/truth/identities/<identity>/head.json               parameters, five keypoints, landmarks
    DIR/truth/identities/<identity>/{mask,depth,normals}/<camera>.{png,exr,exr}

Masks are coverage in 16 bits. Depth is the float32 z in the camera's frame in metres, channel Y; normals are
halves in the rig frame, channels R, G, B = x, y, z; both are NaN where there is no surface. Pixels of corners
are continuous, the top-left pixel's centre at (0.5, 0.5), and NaN where the lens has no image of the corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from synthetic_studio.rig import camera_id


def take_id(take: int) -> str:
    """Name of a take in files."""
    return f"take{take:02d}"


def identity_id(identity: int) -> str:
    """Name of a person in files."""
    return f"id{identity:04d}"


def frame_id(frame: int) -> str:
    """Stem of a calibration frame's file, the same for all cameras of a take."""
    return f"frame{frame:03d}"


@dataclass(frozen=True)
class ViewFiles:
    """The files of one photograph of a person; the image is written last."""

    mask: Path
    depth: Path
    normals: Path
    image: Path

    def complete(self) -> bool:
        """Whether all of them are there."""
        return all(path.is_file() for path in (self.image, self.mask, self.depth, self.normals))


@dataclass(frozen=True)
class Layout:
    """The paths under one output directory."""

    root: Path

    @property
    def capture(self) -> Path:
        """Directory of the capture."""
        return self.root / "capture"

    @property
    def marker(self) -> Path:
        """The file that says which configuration the directory belongs to."""
        return self.root / "truth" / "studio.json"

    def take(self, take: int) -> Path:
        """Directory of the truth about a take."""
        return self.root / "truth" / "takes" / take_id(take)

    def frame(self, take: int, camera: int, frame: int) -> Path:
        """A calibration image."""
        return self.capture / "calibration" / take_id(take) / camera_id(camera) / f"{frame_id(frame)}.png"

    def plate(self, take: int, camera: int) -> Path:
        """A clean plate."""
        return self.capture / "background" / take_id(take) / f"{camera_id(camera)}.png"

    def head(self, identity: int) -> Path:
        """The truth about a person's head."""
        return self.root / "truth" / "identities" / identity_id(identity) / "head.json"

    def view(self, identity: int, camera: int) -> ViewFiles:
        """The photograph of a person by a camera, and the truth about it."""
        truth, name = self.head(identity).parent, camera_id(camera)
        return ViewFiles(
            truth / "mask" / f"{name}.png",
            truth / "depth" / f"{name}.exr",
            truth / "normals" / f"{name}.exr",
            self.capture / "subjects" / identity_id(identity) / f"{name}.png",
        )
