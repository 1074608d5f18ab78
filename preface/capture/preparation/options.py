"""What a person chooses about preparing photographs for shards, and the one error of this package."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

Filter = Literal["area", "lanczos", "bilinear"]
Light = Literal["linear", "encoded"]
Undistort = Literal["auto", "keep", "resample"]


class PreparationError(ValueError):
    """A picture, window or choice that cannot be prepared; the message is `field: problem; remedy`.

    Attributes:
        field: what is wrong, such as ``pixels`` or ``window``.
        problem: what about it.
        remedy: what to do; together with the file, which the caller knows, they make an `ArtifactError`.
    """

    def __init__(self, field: str, problem: str, remedy: str):
        super().__init__(f"{field}: {problem}; {remedy}")
        self.field, self.problem, self.remedy = field, problem, remedy

    def __reduce__(self) -> tuple:
        return type(self), (self.field, self.problem, self.remedy)


@dataclass(frozen=True)
class PreparationOptions:
    """How photographs become the small sRGB images of a shard.

    Attributes:
        filter: area (the mean of what a pixel covers), lanczos (sharper, three lobes, rings at edges) or
            bilinear (samples the centre only: fast, aliases).
        light: linear (averages light, as a camera with larger pixels would) or encoded (averages sRGB values,
            which darkens fine detail; faster).
        undistort: keep (the lens stays in the camera, its pixels untouched), resample (to a pinhole image) or
            auto (keep, unless the lens folds inside the image).
        white: the linear light in float images (EXR) that becomes 255; the same for all views, or their
            brightness no longer agrees. Brighter light is cut off, before filtering.
    """

    filter: Filter = "area"
    light: Light = "linear"
    undistort: Undistort = "auto"
    white: float = 1.0

    def __post_init__(self) -> None:
        for field, choices in (("filter", Filter), ("light", Light), ("undistort", Undistort)):
            if getattr(self, field) not in get_args(choices):
                problem = f"{getattr(self, field)!r} is unknown"
                raise PreparationError(field, problem, f"use one of {', '.join(get_args(choices))}")
        if not (isinstance(self.white, (int, float)) and math.isfinite(self.white) and self.white > 0):
            raise PreparationError("white", f"{self.white!r} is no brightness", "give a number above 0")
