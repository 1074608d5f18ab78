"""Images: exact round trips, refusal before decoding, and no truncated file that decodes to other pixels."""

import io
import struct
import zlib

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from preface.artifacts import ArtifactError
from preface.capture.images import (
    MAX_PIXELS,
    ImageError,
    ImageHeader,
    display_tones,
    displayable,
    read_exr,
    read_header,
    read_image,
    write_exr,
    write_jpeg,
    write_png,
)


def pixels(dtype, channels, height=17, width=23):
    random = np.random.default_rng(0)
    noise = random.integers(0, np.iinfo(dtype).max + 1, (height, width, channels)).astype(dtype)
    noise[0, 0] = np.arange(1, channels + 1)  # tells the channels apart
    return noise


# ------------------------------------------------------------------------------------ round trips


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_keeps_every_pixel_and_the_order_of_channels(tmp_path, dtype, channels):
    image = pixels(dtype, channels)
    write_png(tmp_path / "a.png", image)
    again = read_image(tmp_path / "a.png")
    assert again.dtype == dtype
    np.testing.assert_array_equal(again, image)


def test_png_is_rgb_for_other_programs_too(tmp_path):
    image = pixels(np.uint8, 4)
    write_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), image)


def test_a_mask_without_channel_axis_is_written(tmp_path):
    mask = pixels(np.uint8, 1)[..., 0]
    write_png(tmp_path / "a.png", mask)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[..., 0], mask)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tiff_keeps_every_pixel(tmp_path, dtype, channels):
    image = pixels(dtype, channels)
    cv2.imwrite(str(tmp_path / "a.tif"), image[..., [2, 1, 0, 3][:channels]] if channels > 1 else image)
    again = read_image(tmp_path / "a.tif")
    assert again.dtype == dtype
    np.testing.assert_array_equal(again, image)


def test_jpeg_of_a_smooth_image_is_close_to_it(tmp_path):
    y, x = np.mgrid[0:64, 0:96]
    image = np.stack([2 * x, 3 * y, 255 - 2 * x], axis=-1).astype(np.uint8)
    write_jpeg(tmp_path / "a.jpg", image, quality=95)
    again = read_image(tmp_path / "a.jpg").astype(int)
    assert np.abs(again - image).mean() < 1.5


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr_keeps_every_value_with_nan_and_infinity(tmp_path, dtype):
    depth = np.random.default_rng(0).normal(size=(7, 5)).astype(dtype)
    depth[0, :3] = np.nan, np.inf, -0.0
    write_exr(tmp_path / "a.exr", {"Z": depth, "n.x": -depth})
    again = read_exr(tmp_path / "a.exr")
    assert list(again) == ["Z", "n.x"]
    assert again["Z"].dtype == dtype
    assert again["Z"].tobytes() == depth.tobytes()
    assert again["n.x"].tobytes() == (-depth).tobytes()


def test_exr_colours_come_in_the_order_rgba(tmp_path):
    image = pixels(np.uint16, 4).astype(np.float32)
    write_exr(tmp_path / "a.exr", {name: image[..., "RGBA".index(name)] for name in "ABGR"})
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), image)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.exr"])
def test_equal_pixels_give_equal_files(tmp_path, name):
    image = pixels(np.uint8, 3)

    def write(path):
        if path.suffix == ".exr":
            return write_exr(
                path, dict(zip("RGB", np.moveaxis(image.astype(np.float32), -1, 0), strict=True))
            )
        return write_jpeg(path, image, quality=90) if path.suffix == ".jpg" else write_png(path, image)

    (tmp_path / "x").mkdir()
    assert write(tmp_path / name).read_bytes() == write(tmp_path / "x" / name).read_bytes()


def test_exr_files_hold_no_dates_or_owners(tmp_path):
    write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 2), np.float32)})
    with OpenEXR.File(str(tmp_path / "a.exr"), header_only=True) as file:
        assert not {"capDate", "utcOffset", "owner", "comments"} & set(file.header())


def test_the_content_decides_not_the_suffix(tmp_path):
    write_png(tmp_path / "a.png", pixels(np.uint8, 3))
    (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    assert read_header(tmp_path / "a.jpg") == ImageHeader("PNG", 23, 17, 3)
    np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), pixels(np.uint8, 3))


# ------------------------------------------------------------------------------------- truncation


def encoded(suffix, tmp_path):
    path = tmp_path / f"whole{suffix}"
    if suffix == ".exr":
        write_exr(
            path, dict(zip("RGB", np.moveaxis(pixels(np.uint16, 3).astype(np.float32), -1, 0), strict=True))
        )
    elif suffix == ".tif":
        cv2.imwrite(str(path), pixels(np.uint16, 3))
    elif suffix == ".jpg":
        write_jpeg(path, pixels(np.uint8, 3), quality=90)
    else:
        write_png(path, pixels(np.uint16, 3))
    return path


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data", "ignore:Truncated File Read")
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
def test_a_file_truncated_anywhere_is_refused_or_still_has_all_pixels(tmp_path, suffix):
    whole = encoded(suffix, tmp_path)
    data, image, path = whole.read_bytes(), read_image(whole), tmp_path / f"cut{suffix}"
    refused, lengths = 0, [*range(0, len(data), 7), len(data) - 1]
    for length in lengths:
        path.write_bytes(data[:length])
        try:
            again = read_image(path)
        except ImageError:
            refused += 1
            continue
        np.testing.assert_array_equal(again, image)
    assert refused > 0.9 * len(lengths)


def test_a_large_jpeg_cut_in_half_is_refused(tmp_path):
    write_jpeg(tmp_path / "a.jpg", pixels(np.uint8, 3, 1200, 1600), quality=90)
    data = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(data[: len(data) // 2])
    with pytest.raises(ImageError, match=r"a\.jpg: pixels: truncated or corrupt\. Copy or export"):
        read_image(tmp_path / "a.jpg")


def test_flipped_bits_in_a_png_are_refused_or_harmless(tmp_path):
    whole = encoded(".png", tmp_path)
    image, data = read_image(whole), bytearray(whole.read_bytes())
    for position in range(8, len(data), 11):
        data[position] ^= 16
        whole.write_bytes(data)
        data[position] ^= 16
        try:
            again = read_image(whole)
        except ImageError:
            continue
        np.testing.assert_array_equal(again, image)


# --------------------------------------------------------------------------- refused by the header


def png_chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_header(width, height):
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + png_chunk(b"IHDR", header)
        + png_chunk(b"IDAT", zlib.compress(b""))
        + png_chunk(b"IEND", b"")
    )


def test_an_image_over_the_limit_is_refused_before_decoding(tmp_path):
    (tmp_path / "bomb.png").write_bytes(png_header(2**15, MAX_PIXELS // 2**15 + 1))
    with pytest.raises(ImageError, match="exceeds the limit of 268435456 pixels"):
        read_image(tmp_path / "bomb.png")


def test_an_image_at_the_limit_passes_the_header_check(tmp_path):
    (tmp_path / "large.png").write_bytes(png_header(2**14, MAX_PIXELS // 2**14))
    assert read_header(tmp_path / "large.png").width == 2**14


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_an_exif_rotation_is_neither_applied_nor_ignored(tmp_path, suffix, orientation):
    image, exif = Image.fromarray(pixels(np.uint8, 3)), Image.Exif()
    exif[0x0112] = orientation
    image.save(tmp_path / f"a.{suffix}", exif=exif)
    with pytest.raises(ImageError, match=f"EXIF orientation: is {orientation}, which asks for a rotation"):
        read_image(tmp_path / f"a.{suffix}")


def test_an_exif_rotation_after_the_pixels_of_a_png_is_noticed(tmp_path):
    write_png(tmp_path / "a.png", pixels(np.uint8, 3))
    data, exif = (tmp_path / "a.png").read_bytes(), Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "a.png").write_bytes(data[:-12] + png_chunk(b"eXIf", exif.tobytes()[6:]) + data[-12:])
    with pytest.raises(ImageError, match="EXIF orientation: is 6"):
        read_image(tmp_path / "a.png")


def test_an_upright_exif_orientation_is_accepted(tmp_path):
    image, exif = Image.fromarray(pixels(np.uint8, 3)), Image.Exif()
    exif[0x0112] = 1
    image.save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels(np.uint8, 3))


@pytest.mark.parametrize("mode", ["P", "1", "LA", "CMYK", "F", "I"])
def test_pixel_types_other_than_grey_rgb_and_rgba_are_refused(tmp_path, mode):
    Image.new(mode, (8, 8)).save(tmp_path / "a.tif")
    with pytest.raises(ImageError, match=r"a\.tif: .*Export (it|the image)"):
        read_image(tmp_path / "a.tif")


def test_exr_with_a_cropped_data_window_is_refused(tmp_path):
    window = (np.array([0, 0], np.int32), np.array([99, 99], np.int32))
    stream = io.BytesIO()
    with OpenEXR.File({"displayWindow": window}, {"Y": np.zeros((4, 4), np.float32)}) as file:
        file.write(stream)
    (tmp_path / "a.exr").write_bytes(stream.getvalue())
    with pytest.raises(ImageError, match="data window"):
        read_image(tmp_path / "a.exr")


# --------------------------------------------------------------------------------------- writing


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4, 3), np.float32),
        np.zeros((4, 4, 2), np.uint8),
        np.zeros((0, 4, 3), np.uint8),
        np.zeros(4, np.uint8),
    ],
)
def test_arrays_that_are_no_image_are_not_written(tmp_path, image):
    with pytest.raises(ImageError, match=r"a\.png: pixels: have the shape .*Give \[height, width\]"):
        write_png(tmp_path / "a.png", image)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "channels",
    [
        {},
        {"R": np.zeros((4, 4), np.float32), "G": np.zeros((4, 5), np.float32)},
        {"Z": np.zeros((4, 4), np.float64)},
        {"Z": np.zeros((4, 4, 1), np.float32)},
    ],
)
def test_arrays_that_are_no_exr_channels_are_not_written(tmp_path, channels):
    with pytest.raises(ImageError, match=r"a\.exr: channel"):
        write_exr(tmp_path / "a.exr", channels)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_named_with_the_remedy(tmp_path):
    with pytest.raises(
        ArtifactError, match=r"gone/a\.png: writing: no such file or directory\. Correct the path"
    ):
        write_png(tmp_path / "gone" / "a.png", pixels(np.uint8, 3))


# ------------------------------------------------------------------------------------------ tones


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float16, np.float32])
@pytest.mark.parametrize("channels", [None, 1, 3, 4])
def test_any_kind_of_image_is_shown_as_8_bit_rgb(dtype, channels):
    image = np.ones((5, 7) if channels is None else (5, 7, channels), dtype)
    shown = displayable(image)
    assert (shown.shape, shown.dtype) == ((5, 7, 3), np.uint8)
    assert shown.flags.c_contiguous


def test_eight_bits_are_shown_as_they_are_and_as_they_were_before_widening():
    image = pixels(np.uint8, 3)
    np.testing.assert_array_equal(displayable(image), image)
    for factor in (256, 257):
        np.testing.assert_array_equal(displayable(image.astype(np.uint16) * factor), image)


def test_linear_light_is_shown_the_same_whatever_its_unit():
    light = np.random.default_rng(0).uniform(0, 1, (40, 50, 3)).astype(np.float32)
    shown = displayable(light)
    assert shown.max() == 255
    np.testing.assert_allclose(displayable(light * 1024).astype(int), shown, atol=1)
    # Half the light of white is 186 at a gamma of 2.2.
    assert abs(int(display_tones(np.array([1.0] * 9 + [0.5]))[-1]) - 186) <= 1


def test_what_is_no_number_shows_black_and_dims_nothing():
    light = np.full((20, 20), 0.5, np.float32)
    light[0, :4] = np.nan, np.inf, -np.inf, -1
    shown = displayable(light)[..., 0]
    assert shown[0, :4].tolist() == [0, 255, 0, 0]
    assert (shown[1:] == 255).all()
    assert (displayable(np.full((3, 3), np.nan, np.float32)) == 0).all()
