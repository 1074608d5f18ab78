"""The one way a photograph becomes a shard's image: windowed, undistorted or not, filtered, encoded as sRGB."""

from __future__ import annotations

from typing import Any

import numpy as np

from preface.capture.preparation.filters import axis
from preface.capture.preparation.options import PreparationError, PreparationOptions
from preface.capture.preparation.separable import Separable
from preface.capture.preparation.transfer import (
    DTYPES,
    LARGEST_ALPHA,
    Reader,
    bytes_of_light,
    bytes_of_values,
    premultiplied_reader,
    reader,
)
from preface.capture.preparation.undistortion import Pinhole, Route
from preface.capture.preparation.windows import Window, camera_of_window, checked_size, checked_window
from preface.geometry import Camera

# A pixel that shows less of the photograph than half a byte's step counts as showing nothing.
_SHOWN = np.float32(0.5 / 255)


class Resampler:
    """Prepares the photographs of one camera; planned once, applied to many.

    Attributes:
        camera: of the results: of their size, with the window's exact calibration; its distortion is kept, or
            gone where ``undistorted``.
        undistorted: whether photographs are resampled to a pinhole image.
        window: the part of the photograph that is shown.
        options: as given.
    """

    def __init__(
        self,
        camera: Camera,
        size: tuple[int, int],
        window: Window,
        options: PreparationOptions = PreparationOptions(),  # noqa: B008 (frozen)
        route: Route | None = None,
    ):
        """Plan the resampling.

        Args:
            camera: of the whole photographs.
            size: width and height of the results, pixels; at most the window's.
            window: the part of a photograph that becomes the result, see `framing_window`. A pinhole result
                has the window's calibration, so that lenses that bend outwards make it see a little less,
                and others a little more than the window.
            options: what was chosen.
            route: how finely distortion is resampled, for measurements; by default `Route.usual`.

        Raises:
            PreparationError: the window is outside the image or smaller than the result, or the lens folds
                inside the window and is to be kept.
        """
        self.options, self.source = options, camera
        size = checked_size(size)
        self.window = window = checked_window(camera, size, window)
        self.camera = camera_of_window(camera, size, window)
        self.undistorted = self._is_undistorted()
        if self.undistorted or options.undistort == "resample":
            self.camera = Camera("PINHOLE", *size, self.camera.intrinsics[:4])
        self._route = route or Route.usual(options.filter, window.width / size[0], window.height / size[1])
        self._apply: Separable | Pinhole
        if self.undistorted:
            self._apply = Pinhole(camera, self.camera, options.filter, self._route)
        else:
            self._apply = Separable(
                axis(options.filter, camera.height, window.y, window.height, size[1]),
                axis(options.filter, camera.width, window.x, window.width, size[0]),
            )

    def colors(self, pixels: np.ndarray) -> np.ndarray:
        """The photograph's colours.

        Args:
            pixels: [h, w, 3]; or grey [h, w] or [h, w, 1], which becomes three equal channels; or RGBA
                [h, w, 4], whose colours are taken as they are: alpha is a mask, for `coverage` to take (see
                `split_alpha`). uint8 and uint16 are sRGB-encoded, float16 and float32 linear light.

        Returns:
            uint8 [H, W, 3], sRGB; black where the result shows nothing of the photograph.

        Raises:
            PreparationError: another size or type, or floats that are not finite.
        """
        pixels = self._checked("pixels", pixels, (1, 3, 4))
        read = reader(pixels.dtype, self.options.light, self.options.white)
        values, shares = self._filtered(read, pixels if pixels.shape[2] < 4 else _without_alpha(pixels))
        if shares is not None:
            values /= np.maximum(shares, _SHOWN)
            values *= shares > _SHOWN
        return self._bytes(values)

    def foreground(self, pixels: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The photograph's colours, unmixed at the edges of its foreground, and the foreground's share.

        A result pixel that shows some foreground has the mean colour of that alone, weighted by alpha: the
        colour that over any background, composited by its share, gives what a camera would have seen. Other
        pixels have the photograph's colour.

        Args:
            pixels: as `colors` takes them.
            alpha: as `coverage` takes it.

        Returns:
            uint8 [H, W, 3], sRGB, and uint8 [H, W].

        Raises:
            PreparationError: as `colors` and `coverage`.
        """
        colors, _ = split_alpha(self._checked("pixels", pixels, (1, 3, 4)))
        alpha = self._checked("alpha", alpha, (1,))
        mixed, shares = self.colors(colors), self._shares(alpha)
        coverage = bytes_of_values(shares[..., 0])
        if not coverage.any() or (alpha == alpha.max()).all():
            return mixed, coverage
        read = reader(colors.dtype, self.options.light, self.options.white)
        values, _ = self._filtered(premultiplied_reader(read, _alphas(alpha)), colors, alpha)
        unmixed = self._bytes(values / np.maximum(shares, _SHOWN))
        return np.where(coverage[..., None] > 0, unmixed, mixed), coverage

    def _bytes(self, values: np.ndarray) -> np.ndarray:
        coded = bytes_of_light(values) if self.options.light == "linear" else bytes_of_values(values)
        return coded if coded.shape[2] == 3 else np.repeat(coded, 3, axis=2)

    def coverage(self, alpha: np.ndarray) -> np.ndarray:
        """The foreground's share of every result pixel.

        Args:
            alpha: [h, w] or [h, w, 1]; uint8 and uint16, whose highest value is all, or float16 and float32
                in [0, 1].

        Returns:
            uint8 [H, W]; 0 where the result shows nothing of the photograph.

        Raises:
            PreparationError: another size or type, or values that are not in [0, 1].
        """
        return bytes_of_values(self._shares(self._checked("alpha", alpha, (1,)))[..., 0])

    def _shares(self, alpha: np.ndarray) -> np.ndarray:
        """What `coverage` rounds, float32 [H, W, 1], of an alpha [h, w, 1]."""
        if alpha.dtype.kind == "f" and not ((alpha >= 0) & (alpha <= LARGEST_ALPHA)).all():
            problem = f"has values from {alpha.min()} to {alpha.max()}"
            raise PreparationError("alpha", problem, "give shares from 0 to 1")
        return self._filtered(_alphas(alpha), alpha)[0]

    def describe(self) -> dict[str, Any]:
        """What is done, as plain JSON values, for a manifest."""
        route = self._route
        return {
            "filter": self.options.filter,
            "light": self.options.light,
            "transfer": {
                "integers": "sRGB (IEC 61966-2-1)",
                "floats": f"linear light, {self.options.white:g} is white, cut off to [0, white]",
                "result": "sRGB (IEC 61966-2-1), 8 bits, rounded to nearest",
            },
            "undistort": "resampled" if self.undistorted else "kept",
            "route": f"area/{route.reduction}, {route.kernel} remap, {self.options.filter} from "
            f"{route.across}x{route.down} per pixel"
            if self.undistorted
            else None,
            "size": [self.camera.width, self.camera.height],
            "window": [self.window.x, self.window.y, self.window.width, self.window.height],
            "camera_model": self.camera.model,
        }

    def _is_undistorted(self) -> bool:
        # Readers of the result undistort its rays, hence a lens may stay if it is one-to-one over it.
        folds = self.camera.folds_inside_image()
        if folds and self.options.undistort == "keep":
            radius = self.camera.monotonic_radius
            problem = f"keep: the lens folds inside the window, {radius:.4g} focal lengths from its axis"
            raise PreparationError("undistort", problem, "choose auto or resample, or a smaller window")
        distorts = bool(self.camera.intrinsics[4:].any())
        return distorts and (folds or self.options.undistort == "resample")

    def _filtered(self, read: Reader, *sources: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        if isinstance(self._apply, Pinhole):
            return self._apply(read, *sources)
        return self._apply(read, *sources), None

    def _checked(self, field: str, pixels: np.ndarray, channels: tuple[int, ...]) -> np.ndarray:
        """The picture as [h, w, c], contiguous.

        Raises:
            PreparationError: another size or type.
        """
        picture = pixels[..., None] if pixels.ndim == 2 else pixels
        size = (self.source.height, self.source.width)
        if picture.ndim != 3 or picture.shape[2] not in channels or picture.dtype not in DTYPES:
            kinds = ", ".join(np.dtype(dtype).name for dtype in DTYPES)
            problem = f"shape {list(pixels.shape)} and type {pixels.dtype} are no such image"
            raise PreparationError(field, problem, f"give [h, w, c] with c in {channels}, one of {kinds}")
        if picture.shape[:2] != size:
            problem = f"{picture.shape[1]}x{picture.shape[0]} is not the camera's {size[1]}x{size[0]}"
            raise PreparationError(field, problem, "give the photographs that the rig was calibrated with")
        return np.ascontiguousarray(picture)


def split_alpha(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """An image [h, w, c] as `read_image` returns it, as colours and alpha.

    Returns:
        The image without its alpha; and alpha [h, w] of its type, None unless there are four channels.
    """
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        return _without_alpha(pixels), np.ascontiguousarray(pixels[..., 3])
    return pixels, None


def _alphas(alpha: np.ndarray) -> Reader:
    return reader(alpha.dtype, "alpha", 1.0)


def _without_alpha(pixels: np.ndarray) -> np.ndarray:
    import cv2

    if pixels.dtype == np.float16:  # unknown to cvtColor
        return np.ascontiguousarray(pixels[..., :3])
    return cv2.cvtColor(pixels, cv2.COLOR_RGBA2RGB)
