"""A person ready to be photographed: a head and its renderer, which is all that the writer knows of heads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid
from synthetic_studio.heads import build_head
from synthetic_studio.render import HeadRender, HeadRenderer


class Subject:
    """One identity of the studio; see `tasks.Subject` for what its members mean."""

    def __init__(self, seed: int, index: int, assets: Path | None) -> None:
        self._head = build_head(seed, index, assets)
        self._renderer = HeadRenderer(self._head)

    @property
    def parameters(self) -> dict[str, Any]:
        """What the identity was made from."""
        return self._head.parameters

    @property
    def keypoints(self) -> dict[str, np.ndarray]:
        """The five canonical keypoints."""
        return self._head.keypoints

    @property
    def landmarks(self) -> dict[str, np.ndarray]:
        """Points on the surface."""
        return self._head.landmarks

    def render(self, camera: Camera, camera_from_studio: Rigid, antialias: int) -> HeadRender:
        """Render one view."""
        return self._renderer.render(camera, camera_from_studio, antialias)
