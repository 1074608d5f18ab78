"""What a dataset is to look like, as one frozen object: everything that decides the bytes of its shards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from preface.artifacts import sha256
from preface.capture.preparation import PreparationOptions
from preface.shards.format import PixelOrder

Framing = Literal["whole", "center", "box"]
FRAMINGS: tuple[Framing, ...] = ("whole", "center", "box")

# Corners of the box that holds a head, canonical frame, metres: hair, neck and the roots of the shoulders. Its
# longest half side is 0.25 m, so that `scene_scale` is 4. Of 64 synthetic heads 98% of the visible surface lies
# in it; the rest is shoulders.
HEAD_BOX = (-0.20, -0.25, -0.25, 0.20, 0.25, 0.12)
MAX_PIXELS = 2**28  # as preface.capture.images, ten times 4096x6144


@dataclass(frozen=True)
class BuildConfiguration:
    """What decides the content of shards; the same configuration and sources give the same bytes.

    Attributes:
        width, height: of all views, pixels.
        framing: "whole" image, the largest "center" window of the target's aspect, or around the "box".
        box: two corners of the head's box in a row, canonical frame, metres.
        filter: how images are reduced, see `preface.capture.preparation`.
        light: whether they are reduced in "linear" light or as "encoded".
        undistort: whether distortion is kept in the cameras, resampled away, or decided per camera ("auto").
        white: the linear light of EXR images that becomes 255.
        foreground: a method of `preface.capture.foreground`, or "auto".
        matting_model: an ONNX model for the method "onnx".
        pixel_order: see `preface.shards.format`.
        identities_per_shard: K.
        max_pixels: images of more are refused before they are decoded.
    """

    width: int
    height: int
    framing: Framing = "whole"
    box: tuple[float, ...] = HEAD_BOX
    filter: Literal["area", "lanczos", "bilinear"] = "area"
    light: Literal["linear", "encoded"] = "linear"
    undistort: Literal["auto", "keep", "resample"] = "auto"
    white: float = 1.0
    foreground: str = "auto"
    matting_model: Path | None = None
    pixel_order: PixelOrder = "raster"
    identities_per_shard: int = 1
    max_pixels: int = MAX_PIXELS

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.width, self.height

    @property
    def preparation(self) -> PreparationOptions:
        """How photographs become images."""
        return PreparationOptions(self.filter, self.light, self.undistort, self.white)

    def content(self) -> dict[str, Any]:
        """As JSON has it, the matting model by its SHA-256.

        Raises:
            ArtifactError: the matting model cannot be read.
        """
        chosen: Mapping[str, Any] = asdict(self)
        model = None if self.matting_model is None else sha256(self.matting_model)
        return {**chosen, "box": list(self.box), "matting_model": model}
