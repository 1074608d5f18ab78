"""Reading and writing image files: PNG, JPEG and TIFF with 8 or 16 bits, EXR with half or float channels.

A header is read and judged before any pixel is decoded: a PNG of 255 KB can decode to 768 MiB. Pillow
reads headers, OpenCV decodes (it keeps 16 bits, and its in-memory decoders refuse truncated files), and
OpenEXR does EXR.

EXIF orientation: never applied here and never ignored. A file whose tag asks for a rotation is refused,
because a calibration and a photograph that disagree about it give wrong geometry without any sign. Where no
calibration can disagree, as with photographs of one phone, `preface.capture.upright` reads them turned.

Colours are returned as they are encoded in the file: sRGB for PNG, JPEG and TIFF, linear for EXR.
"""

import io
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from preface.artifacts import ArtifactError, write_bytes

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr")
DISPLAY_WHITE = 99.5  # percentile of linear light that is shown as white; lamps and glints may be brighter
DISPLAY_GAMMA = 2.2  # linear light is shown to this power's inverse: an even spread of tones
MAX_PIXELS = 2**28  # 268 megapixels: ten times 4096x6144, more than any camera on the market
EXR_MAGIC = b"\x76\x2f\x31\x01"
_EXIF_ORIENTATION = 0x0112
# What Pillow is seen to raise for broken headers.
_PILLOW_ERRORS = (OSError, SyntaxError, ValueError, KeyError, TypeError, EOFError, IndexError, OverflowError)
_MODE_CHANNELS = {"L": 1, "I;16": 1, "I;16B": 1, "I;16L": 1, "I": 1, "RGB": 3, "RGBA": 4}


class ImageError(ArtifactError):
    """An image file that cannot be read, or an array that cannot be written as one."""


@dataclass(frozen=True)
class ImageHeader:
    """What an image file says about itself before its pixels are decoded.

    Attributes:
        format: ``PNG``, ``JPEG``, ``TIFF`` or ``EXR``.
        width: in pixels.
        height: in pixels.
        channels: 1 (grey), 3 (RGB) or 4 (RGBA); for EXR the number of named channels.
        orientation: EXIF's, 1 to 8; 1 is upright, and what a file without it is.
    """

    format: str
    width: int
    height: int
    channels: int
    orientation: int = 1


def read_header(path: str | os.PathLike[str]) -> ImageHeader:
    """Read an image's header without decoding its pixels.

    Raises:
        ImageError: not a supported image, too large, or to be rotated according to EXIF.
    """
    header = stored_header(path)
    _check_upright(path, header.orientation)
    return header


def stored_header(path: str | os.PathLike[str]) -> ImageHeader:
    """Read an image's header, whatever EXIF says of its orientation; width and height are those of the file.

    Raises:
        ImageError: not a supported image, or too large.
    """
    try:
        with Path(path).open("rb") as file:
            magic = file.read(8)
            file.seek(0)
            if magic.startswith(EXR_MAGIC):
                return _exr_header(path, file)
            return _pillow_header(path, magic, file)
    except OSError as error:
        raise ImageError.from_os(path, "file", error) from error


def read_image(path: str | os.PathLike[str]) -> np.ndarray:
    """Decode an image.

    Args:
        path: a PNG, JPEG, TIFF or EXR file; the content counts, not the suffix.

    Returns:
        Array [height, width, channels] with channels in the order grey, RGB or RGBA; uint8 or uint16,
        for EXR float16 or float32 (channels Y, or R G B and perhaps A).

    Raises:
        ImageError: as `read_header`; or truncated, corrupt, or EXR channels other than those.
    """
    return decode(path, read_header(path))


def decode(path: str | os.PathLike[str], header: ImageHeader) -> np.ndarray:
    """Decode an image as it is stored; ``header`` is its own.

    Raises:
        ImageError: as `read_image`, but for the orientation in the header.
    """
    if header.format == "EXR":
        return _colour_channels(path, read_exr(path))
    import cv2

    # Neither reduced to 8 bits nor rotated; in RGB where the decoder is right about it (TIFF's is not).
    in_order = header.channels == 3 and header.format in ("JPEG", "PNG")
    kept = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        encoded = Path(path).read_bytes()
    except OSError as error:
        raise ImageError.from_os(path, "file", error) from error
    try:
        if header.format == "PNG":
            late = _orientation(_late_png_exif(encoded))
            if late != header.orientation:
                _check_upright(path, late)
        flags = kept if in_order else cv2.IMREAD_UNCHANGED
        pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), flags)
    except (cv2.error, *_PILLOW_ERRORS) as error:
        raise _corrupt(path, str(error)) from error
    expected = (header.height, header.width, header.channels)
    if pixels is None:
        raise _corrupt(path, "truncated or corrupt")
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    if pixels.shape != expected or pixels.dtype not in (np.uint8, np.uint16):
        problem = f"decodes to {pixels.shape} {pixels.dtype}, but the header says {expected}"
        raise ImageError(path, "pixels", problem, "Export the image again with 8 or 16 bits per channel")
    if header.channels == 1 or in_order:
        return pixels
    to_rgb = cv2.COLOR_BGR2RGB if header.channels == 3 else cv2.COLOR_BGRA2RGBA
    return cv2.cvtColor(pixels, to_rgb, dst=pixels)


def read_exr(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Decode all channels of an EXR file.

    Returns:
        Channel name to array [height, width], float16 or float32.

    Raises:
        ImageError: not a single-part flat EXR, truncated, corrupt, or with integer channels.
    """
    import OpenEXR

    header = read_header(path)
    if header.format != "EXR":
        raise ImageError(path, "header", f"is a {header.format} file", "Give an EXR file")
    try:
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError) as error:  # OpenEXR raises any of them for broken files
        raise _corrupt(path, str(error)) from error
    for name, pixels in channels.items():
        if pixels.dtype not in (np.float16, np.float32):
            raise ImageError(path, f"channel {name}", f"holds {pixels.dtype}", "Export it as half or float")
    if len(channels) != header.channels or {p.shape for p in channels.values()} != {
        (header.height, header.width)
    }:
        raise _corrupt(path, "channels are missing or of another size")
    return channels


def write_png(path: str | os.PathLike[str], pixels: np.ndarray) -> Path:
    """Write an array [height, width], or with 1, 3 (RGB) or 4 (RGBA) channels, uint8 or uint16, as PNG.

    The write is atomic, and equal arrays give equal files.

    Raises:
        ArtifactError: not such an array, or the disk refuses.
    """
    _check_writable(path, pixels, (np.uint8, np.uint16), (1, 3, 4))
    return write_bytes(path, _encode(".png", pixels, []))


def write_jpeg(path: str | os.PathLike[str], pixels: np.ndarray, quality: int) -> Path:
    """Write an array [height, width], or with 1 or 3 (RGB) channels, uint8, as JPEG.

    ``quality`` is libjpeg's, 1 to 100; chroma is not subsampled. The write is atomic, and equal arrays give
    equal files.

    Raises:
        ArtifactError: not such an array, or the disk refuses.
    """
    import cv2

    _check_writable(path, pixels, (np.uint8,), (1, 3))
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return write_bytes(path, _encode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling]))


def write_exr(path: str | os.PathLike[str], channels: Mapping[str, np.ndarray]) -> Path:
    """Write named channels, arrays [height, width] of float16 or float32, as a ZIP-compressed EXR.

    The write is atomic, and equal arrays give equal files. NaN and infinity are kept.

    Raises:
        ArtifactError: not such arrays, or the disk refuses.
    """
    import OpenEXR

    sizes = {pixels.shape for pixels in channels.values()}
    if len(sizes) != 1 or len(next(iter(sizes))) != 2 or 0 in next(iter(sizes)):
        raise ImageError(
            path, "channels", f"have the shapes {sorted(sizes)}", "Give arrays of one size [height, width]"
        )
    for name, pixels in channels.items():
        if pixels.dtype not in (np.float16, np.float32):
            raise ImageError(path, f"channel {name}", f"holds {pixels.dtype}", "Give float16 or float32")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    with OpenEXR.File(header, {n: np.ascontiguousarray(p) for n, p in channels.items()}) as file:
        file.write(stream)
    return write_bytes(path, stream.getvalue())


# ------------------------------------------------------------------------------------------ tones


def displayable(pixels: np.ndarray) -> np.ndarray:
    """What a person or a detector looks at: an image of any kind as 8-bit RGB.

    Args:
        pixels: [height, width] or [height, width, 1, 3 or 4], as `read_image` returns it; alpha is left out.

    Returns:
        [height, width, 3] uint8, toned by `display_tones`.
    """
    colour = pixels[..., None] if pixels.ndim == 2 else pixels[..., :3]
    tones = display_tones(colour)
    return np.repeat(tones, 3, axis=2) if tones.shape[2] == 1 else np.ascontiguousarray(tones)


def display_tones(pixels: np.ndarray) -> np.ndarray:
    """The same array in 8 bits, as shown: integers keep their encoding, floats are linear light.

    Light is scaled to the image's own brightness. Values that are no number, such as a renderer's empty
    pixels, show as black, and infinite ones as the white or black that they overflowed.

    Args:
        pixels: uint8, uint16 or floats, of any shape.

    Returns:
        uint8 of that shape.
    """
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.uint16:
        return (pixels >> 8).astype(np.uint8)  # right for 8 bits widened by 256 and by 257 alike
    light = pixels.astype(np.float32)
    finite = np.isfinite(light)
    white = float(np.percentile(light[finite], DISPLAY_WHITE)) if finite.any() else 1.0
    share = np.where(np.isnan(light), np.float32(0), light) / np.float32(max(white, 1e-9))
    return np.rint(255 * np.clip(share, 0, 1) ** (1 / DISPLAY_GAMMA)).astype(np.uint8)


# ---------------------------------------------------------------------------------------- headers


def _pillow_header(path: str | os.PathLike[str], magic: bytes, file: io.BufferedReader) -> ImageHeader:
    # The classes are called directly: Image.open would try every decoder that Pillow has, and apply a
    # process-wide pixel limit of its own.
    from PIL import Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

    readers: dict[bytes, type[ImageFile]] = {
        b"\x89PNG\r\n\x1a\n": PngImagePlugin.PngImageFile,
        b"\xff\xd8\xff": JpegImagePlugin.JpegImageFile,
        b"II*\x00": TiffImagePlugin.TiffImageFile,
        b"MM\x00*": TiffImagePlugin.TiffImageFile,
    }
    reader = next((cls for start, cls in readers.items() if magic.startswith(start)), None)
    if reader is None:
        remedy = "Export the image as PNG, JPEG, TIFF or EXR"
        raise ImageError(path, "header", "is empty or not a PNG, JPEG, TIFF or EXR file", remedy)
    try:
        image = reader(file)
        exif = Image.Image.getexif(image)  # PngImageFile's own would decode the image
        frames = getattr(image, "n_frames", 1)
    except _PILLOW_ERRORS as error:
        raise _corrupt(path, f"the header is truncated or corrupt ({error})", "header") from error
    channels = _MODE_CHANNELS.get(image.mode)
    if channels is None or "transparency" in image.info:
        problem = f"has the pixel type {image.mode}{' with a transparent colour' if channels else ''}"
        raise ImageError(
            path, "header", problem, "Export it as grey, RGB or RGBA with 8 or 16 bits per channel"
        )
    if frames > 1:
        raise ImageError(
            path, "header", f"holds {frames} images", "Export the one that is meant as a file of its own"
        )
    return _checked(path, ImageHeader(str(image.format), *image.size, channels, _orientation(exif)))


def _exr_header(path: str | os.PathLike[str], file: io.BufferedReader) -> ImageHeader:
    import OpenEXR

    try:
        with OpenEXR.File(file, header_only=True) as exr:
            parts = [dict(part.header) for part in exr.parts]  # emptied when the file closes
    except (RuntimeError, ValueError, TypeError) as error:
        raise _corrupt(path, f"the header is truncated or corrupt ({error})", "header") from error
    if len(parts) != 1 or parts[0]["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        problem = f"has {len(parts)} parts or deep pixels"
        raise ImageError(path, "header", problem, "Export it as a flat EXR with one part")
    (left, top), (right, bottom) = (corner.tolist() for corner in parts[0]["dataWindow"])
    shown = [corner.tolist() for corner in parts[0]["displayWindow"]]
    if shown != [[left, top], [right, bottom]]:
        problem = "has a data window that differs from its display window"
        raise ImageError(path, "header", problem, "Export the whole image without cropping or overscan")
    return _checked(path, ImageHeader("EXR", right - left + 1, bottom - top + 1, len(parts[0]["channels"])))


def _orientation(exif: Mapping[int, Any]) -> int:
    orientation = exif.get(_EXIF_ORIENTATION, 1)
    return 1 if orientation == 0 else orientation  # 0 is what cameras write that do not know


def _check_upright(path: str | os.PathLike[str], orientation: int) -> None:
    if orientation != 1:
        problem = f"is {orientation}, which asks for a rotation or mirroring"
        remedy = (
            "Turn the pixels (mogrify -auto-orient FILE) or remove the tag (exiftool -Orientation= FILE), in the "
            "calibration's images and the photographs alike"
        )
        raise ImageError(path, "EXIF orientation", problem, remedy)


def _late_png_exif(encoded: bytes) -> Mapping[int, Any]:
    """The EXIF block of a whole PNG file, which may stand after the pixels, unseen by `read_header`."""
    from PIL import Image

    exif, position = Image.Exif(), 8
    while position + 8 <= len(encoded):
        length, kind = struct.unpack_from(">I4s", encoded, position)
        if kind == b"eXIf":
            exif.load(encoded[position + 8 : position + 8 + length])
        position += 12 + length  # length, kind, data, checksum
    return exif


def _checked(path: str | os.PathLike[str], header: ImageHeader) -> ImageHeader:
    if header.width < 1 or header.height < 1:
        raise _corrupt(path, f"the size is {header.width}x{header.height}", "header")
    if header.width * header.height > MAX_PIXELS:
        problem = f"{header.width}x{header.height} exceeds the limit of {MAX_PIXELS} pixels"
        raise ImageError(path, "header", problem, "Reduce the image, or check that it is not damaged")
    return header


def _corrupt(path: str | os.PathLike[str], problem: str, field: str = "pixels") -> ImageError:
    return ImageError(path, field, " ".join(problem.split())[:200], "Copy or export the image again")


# ----------------------------------------------------------------------------------------- arrays


def _colour_channels(path: str | os.PathLike[str], channels: dict[str, np.ndarray]) -> np.ndarray:
    for names in (["Y"], ["R", "G", "B"], ["R", "G", "B", "A"]):
        if sorted(names) == sorted(channels) and len({pixels.dtype for pixels in channels.values()}) == 1:
            return np.stack([channels[name] for name in names], axis=-1)
    found = ", ".join(f"{name} {pixels.dtype}" for name, pixels in channels.items())
    remedy = "Export the channels Y, or R G B, or R G B A, all half or all float"
    raise ImageError(path, "channels", f"are {found}, which is no colour image", remedy)


def _check_writable(
    path: str | os.PathLike[str], pixels: np.ndarray, dtypes: tuple[Any, ...], channels: tuple[int, ...]
) -> None:
    size_is_right = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in channels)
    if not size_is_right or pixels.size == 0 or pixels.dtype not in dtypes:
        kinds = " or ".join(np.dtype(dtype).name for dtype in dtypes)
        remedy = f"Give [height, width] or [height, width, channels] with channels in {channels}, {kinds}"
        raise ImageError(path, "pixels", f"have the shape {pixels.shape} and type {pixels.dtype}", remedy)


def _encode(suffix: str, pixels: np.ndarray, options: list[int]) -> bytes:
    import cv2

    if pixels.ndim == 3 and pixels.shape[2] > 1:
        pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]  # OpenCV's order is BGR
    ok, encoded = cv2.imencode(suffix, np.ascontiguousarray(pixels), options)
    if not ok:
        raise RuntimeError(f"OpenCV failed to encode {suffix}")
    return encoded.tobytes()
