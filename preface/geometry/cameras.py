"""Camera: a COLMAP camera model with its size in pixels, checked when it is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral

import numpy as np

from preface.geometry import lens
from preface.geometry.arrays import Array, floating, matching
from preface.geometry.errors import GeometryError
from preface.geometry.lens import INTRINSICS

# Parameter names in COLMAP's order (colmap/sensor/models.h).
CAMERA_MODELS: dict[str, tuple[str, ...]] = {
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": INTRINSICS,
}
# Parameters that go by another name among the twelve intrinsics, or stand for two of them.
_STANDS_FOR = {"f": ("fx", "fy"), "k": ("k1",)}


def _expansion(model: str) -> np.ndarray:
    """Return the matrix [12, n] that turns a model's parameters into the twelve intrinsics."""
    matrix = np.zeros((len(INTRINSICS), len(CAMERA_MODELS[model])))
    for column, name in enumerate(CAMERA_MODELS[model]):
        for intrinsic in _STANDS_FOR.get(name, (name,)):
            matrix[INTRINSICS.index(intrinsic), column] = 1
    return matrix


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera without its pose. Methods take and return numpy float64, or torch tensors of any device.

    Pixels are continuous with the top-left pixel's centre at (0.5, 0.5); the image spans [0, width] x
    [0, height]. Whether the lens folds inside the image is asked with `require_unfolded`, not at
    construction, because a calibration may pass through such cameras on its way.

    Attributes:
        model: a key of `CAMERA_MODELS`.
        width, height: pixels.
        params: float64 [n] in the order of `CAMERA_MODELS[model]`; read-only.

    Raises:
        GeometryError: unknown model, wrong number of parameters, not finite, focal length or size <= 0.
    """

    model: str
    width: int
    height: int
    params: np.ndarray

    def __post_init__(self) -> None:
        for field in ("width", "height"):
            size = getattr(self, field)
            if not isinstance(size, Integral) or isinstance(size, bool) or size <= 0:
                raise GeometryError(f"{field}: {size!r} is not a positive whole number of pixels")
            object.__setattr__(self, field, int(size))
        object.__setattr__(self, "params", _checked_params(self.model, self.params))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Camera):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple:
        return (self.model, self.width, self.height, self.params.tobytes())

    @cached_property
    def intrinsics(self) -> np.ndarray:
        """The twelve numbers of `preface.geometry.lens`, [12]."""
        return _expansion(self.model) @ self.params

    @property
    def K(self) -> np.ndarray:  # noqa: N802
        """The calibration matrix [3, 3], pixels."""
        fx, fy, cx, cy = self.intrinsics[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    @cached_property
    def monotonic_radius(self) -> float:
        """Normalised radius up to which the lens is one-to-one, inf if it never folds (see `lens`)."""
        return float(lens.monotonic_radius(self.intrinsics))

    def project(self, points_camera: Array) -> tuple[Array, Array]:
        """Project points [..., 3] of the camera frame to pixels [..., 2] and valid [...].

        Points behind the camera or beyond the monotonic radius are not valid, and NaN.
        """
        return lens.project(*self._like(points_camera), floating(points_camera))

    def unproject(self, pixels: Array) -> tuple[Array, Array]:
        """Undistort pixels [..., 2] to normalised points [..., 2] (camera frame, depth 1) and valid [...].

        Pixels that no point inside the monotonic radius projects to are not valid, and NaN.
        """
        normalised, _, valid = lens.unproject(*self._like(pixels), floating(pixels))
        return normalised, valid

    def projection_jacobians(self, points_camera: Array) -> tuple[Array, Array]:
        """Differentiate `project` at points [..., 3]; NaN where it is not valid.

        Returns:
            d_pixels/d_point [..., 2, 3] and d_pixels/d_params [..., 2, n] in the order of `params`.
        """
        by_point, by_intrinsics = lens.projection_jacobians(
            *self._like(points_camera), floating(points_camera)
        )
        return by_point, by_intrinsics @ matching(_expansion(self.model), by_intrinsics)

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the image resampled to width x height pixels.

        Exact, because pixel coordinates are continuous: each axis is scaled by its own factor. SIMPLE_RADIAL
        and RADIAL have a single focal length and become OPENCV when the two factors differ.
        """
        isotropic = width * self.height == height * self.width
        camera = self if isotropic or "f" not in CAMERA_MODELS[self.model] else self.as_model("OPENCV")
        x, y = width / self.width, height / self.height
        scale = camera._per_parameter({"f": x, "fx": x, "cx": x, "fy": y, "cy": y}, 1)
        return Camera(camera.model, width, height, camera.params * scale)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Return the camera of the window of width x height pixels whose corner is at pixel edge (left, top).

        The window may reach outside the image, as padding does.
        """
        corner = self._per_parameter({"cx": left, "cy": top}, 0)
        return Camera(self.model, width, height, self.params - corner)

    def as_model(self, model: str) -> Camera:
        """Return the same camera under another model.

        Raises:
            GeometryError: the model is unknown or cannot express this camera.
        """
        expansion = _expansion(_known(model))
        names = [_STANDS_FOR.get(name, (name,))[0] for name in CAMERA_MODELS[model]]
        params = self.intrinsics[[INTRINSICS.index(name) for name in names]]
        if not np.array_equal(expansion @ params, self.intrinsics):
            lost = [
                name
                for name, value, kept in zip(INTRINSICS, self.intrinsics, expansion @ params, strict=True)
                if value != kept
            ]
            raise GeometryError(
                f"model: {model} cannot express {', '.join(lost)} of this {self.model} camera"
            )
        return Camera(model, self.width, self.height, params)

    def folds_inside_image(self) -> bool:
        """Whether the distortion stops being one-to-one somewhere inside the image.

        The image of the monotonic disc has no holes, so that it contains the whole image if it contains
        its outline, which is checked at every pixel edge.
        """
        across, down = np.arange(self.width + 1.0), np.arange(self.height + 1.0)
        outline = np.concatenate(
            [np.stack([across, np.full_like(across, y)], axis=-1) for y in (0, self.height)]
            + [np.stack([np.full_like(down, x), down], axis=-1) for x in (0, self.width)]
        )
        return not bool(self.unproject(outline)[1].all())

    def require_unfolded(self) -> None:
        """Refuse a camera whose distortion folds inside its image.

        Raises:
            GeometryError: with the radius at which the lens folds.
        """
        if self.folds_inside_image():
            raise GeometryError(
                f"params: the distortion of this {self.model} camera folds inside its {self.width}x"
                f"{self.height} image, at {self.monotonic_radius:.4g} focal lengths from the axis: beyond, "
                "two directions share a pixel; calibrate again with fewer coefficients or with boards closer "
                "to the corners"
            )

    def _per_parameter(self, by_name: dict[str, float], otherwise: float) -> np.ndarray:
        return np.array([by_name.get(name, otherwise) for name in CAMERA_MODELS[self.model]])

    def _like(self, points: Array) -> tuple[Array, Array]:
        """Return intrinsics and monotonic radius in the library, dtype and device of the points."""
        points = floating(points)
        return matching(self.intrinsics, points), matching(np.asarray(self.monotonic_radius), points)


def _known(model: str) -> str:
    if model not in CAMERA_MODELS:
        raise GeometryError(f"model: {model!r} is unknown; use one of {', '.join(CAMERA_MODELS)}")
    return model


def _checked_params(model: str, params: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the parameters as a read-only float64 copy, or raise GeometryError."""
    names = CAMERA_MODELS[_known(model)]
    try:
        checked = np.array(params, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GeometryError(
            f"params: {params!r} are not numbers; {model} takes {', '.join(names)}"
        ) from error
    if checked.shape != (len(names),):
        raise GeometryError(
            f"params: {model} takes {len(names)} numbers ({', '.join(names)}), "
            f"not an array of shape {checked.shape}"
        )
    for name, value in zip(names, checked, strict=True):
        if not np.isfinite(value):
            raise GeometryError(f"params: {name} of this {model} camera is {value}; it must be finite")
        if name in ("f", "fx", "fy") and value <= 0:
            raise GeometryError(
                f"params: {name} of this {model} camera is {value}; a focal length is positive (pixels). "
                "Mirrored images must be flipped before calibration"
            )
    checked.setflags(write=False)
    return checked


def stack_intrinsics(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Stack cameras of any models for `preface.geometry.lens`: intrinsics [n, 12], monotonic radii [n]."""
    return (
        np.stack([camera.intrinsics for camera in cameras]),
        np.array([camera.monotonic_radius for camera in cameras]),
    )
