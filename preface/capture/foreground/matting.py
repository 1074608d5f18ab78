"""A matting model of the user's own, an ONNX file, run by onnxruntime.

The model takes one image, float32 or float16 [1, 3, H, W], RGB, sRGB-encoded, in [0, 1], and gives the coverage
[1, 1, H, W], [1, H, W] or [H, W] in [0, 1]; the first output of such a shape counts, so that models which also give
colours work. H and W are those that its input declares, or, where it leaves them open, the photograph reduced to at
most 1024 pixels with both sides rounded to multiples of 32. A model that expects another normalisation gets it inside
its graph.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from preface.capture.foreground.guided import refine
from preface.capture.foreground.light import Light
from preface.capture.foreground.result import Foreground, ForegroundError, Hints, checked_image

MULTIPLE = 32  # of pixels, what encoders with five halvings need
TOLERANCE = 0.02  # by which a model's coverage may leave [0, 1]
RADIUS = 0.003  # of the reduced image's longer side; a matting model knows edges, the filter only carries them over
REGULARISATION = 1e-4
INSTALL = "pip install onnxruntime"


class Session(Protocol):
    """What is used of `onnxruntime.InferenceSession`."""

    def get_inputs(self) -> Sequence[Any]:
        """Inputs, each with ``name``, ``shape`` and ``type``."""

    def run(self, output_names: None, feed: dict[str, np.ndarray]) -> Sequence[Any]:
        """All outputs."""


class OnnxMatting:
    """A matting model behind the interface of the other methods."""

    name = "onnx"

    def __init__(self, session: Session, path: str | os.PathLike[str]):
        """Wrap a session.

        Args:
            session: an `onnxruntime.InferenceSession`, or what behaves like one.
            path: the model's file, to be named in errors.

        Raises:
            ForegroundError: the model does not take one image.
        """
        self._session, self._path = session, Path(path)
        inputs = session.get_inputs()
        shape = list(inputs[0].shape) if inputs else []
        if len(inputs) != 1 or len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3):
            found = ", ".join(f"{entry.name} {list(entry.shape)}" for entry in inputs) or "nothing"
            remedy = "Export a model with one input [1, 3, H, W]: RGB in [0, 1]"
            raise ForegroundError(path, "inputs", f"are {found}", remedy)
        self._input, self._half = inputs[0].name, "float16" in str(inputs[0].type)
        self._size = tuple(side if isinstance(side, int) and side > 0 else None for side in shape[2:])

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> OnnxMatting:
        """Load a model.

        Raises:
            ForegroundError: onnxruntime is not installed, or the file is not a model that it can run.
        """
        try:
            import onnxruntime
        except ImportError as error:
            problem = f"needs onnxruntime, which cannot be imported ({error})"
            raise ForegroundError(path, "matting model", problem, f"Install it: {INSTALL}") from error
        if not Path(path).is_file():
            raise ForegroundError(path, "matting model", "there is no such file", "Correct the path")
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = options.inter_op_num_threads = (
            1  # processes share the machine, not threads
        )
        try:
            session = onnxruntime.InferenceSession(
                os.fspath(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime has no base class for what it raises
            words = " ".join(str(error).split())[:200]
            raise ForegroundError(path, "matting model", words, "Export the model again as ONNX") from error
        return cls(session, path)

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """See `Segmenter`."""
        image = checked_image(pixels, hints)
        light = Light(image)
        low = light.reduced()
        shown = light.encode_display(low)
        height, width = (
            side or max(MULTIPLE, round(length / MULTIPLE) * MULTIPLE)
            for side, length in zip(self._size, low.shape[:2], strict=True)
        )
        seen = cv2.resize(shown, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        matte = self._matte(np.ascontiguousarray(seen.transpose(2, 0, 1)[None]), (height, width))
        coarse = cv2.resize(matte, low.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        if light.factor == 1 and (height, width) == low.shape[:2]:
            return Foreground(coarse, image, self.name)
        radius = max(1, round(RADIUS * max(coarse.shape)))
        return Foreground(refine(light, coarse, radius, REGULARISATION), image, self.name)

    def _matte(self, batch: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """The model's coverage for one image, float32 [H, W] in [0, 1]."""
        try:
            outputs = self._session.run(
                None, {self._input: batch.astype(np.float16 if self._half else np.float32)}
            )
        except Exception as error:  # onnxruntime has no base class for what it raises
            words = f"fails on an image of {size[1]}x{size[0]}: {' '.join(str(error).split())[:160]}"
            remedy = "Export it for a fixed input size, or for any multiple of 32"
            raise ForegroundError(self._path, "matting model", words, remedy) from error
        for output in map(np.asarray, outputs):
            shape = output.shape
            if shape[-2:] == size and output.size == size[0] * size[1]:
                matte = output.reshape(size).astype(np.float32)
                if np.isfinite(matte).all() and matte.min() >= -TOLERANCE and matte.max() <= 1 + TOLERANCE:
                    return np.clip(matte, 0, 1)
                problem = f"has values from {matte.min():.3g} to {matte.max():.3g}"
                remedy = "Export a model that gives coverage in [0, 1], with its sigmoid"
                raise ForegroundError(self._path, "output", problem, remedy)
        found = ", ".join(str(list(np.shape(output))) for output in outputs) or "nothing"
        remedy = f"Export a model that gives coverage [1, 1, {size[0]}, {size[1]}]"
        raise ForegroundError(self._path, "outputs", f"are {found}", remedy)
