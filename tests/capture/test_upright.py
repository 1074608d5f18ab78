"""Photographs of a phone are turned as EXIF says, as Pillow does it; a calibrated studio's stay refused."""

import numpy as np
import pytest
from PIL import Image, ImageOps

from preface.capture.images import ImageError, read_header
from preface.capture.upright import read_upright, read_upright_header

PIXELS = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)


def save(path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(PIXELS).save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", range(9))
def test_pixels_are_turned_as_others_turn_them(tmp_path, orientation):
    path = save(tmp_path / "a.png", orientation)
    with Image.open(path) as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(read_upright(path), expected)
    header = read_upright_header(path)
    assert (header.height, header.width) == expected.shape[:2]


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_jpegs_are_turned_once(tmp_path, orientation):
    path = save(tmp_path / "a.jpg", orientation)
    with Image.open(path) as image:
        expected = np.asarray(ImageOps.exif_transpose(image)).astype(int)
    assert np.abs(read_upright(path).astype(int) - expected).max() <= 3  # two decoders of one file


def test_an_unknown_orientation_is_refused(tmp_path):
    with pytest.raises(ImageError, match=r"a\.png: EXIF orientation: is 9, and EXIF knows 1 to 8"):
        read_upright(save(tmp_path / "a.png", 9))


def test_a_tiff_is_read_upright_or_refused(tmp_path):
    np.testing.assert_array_equal(read_upright(save(tmp_path / "a.tif", 1)), PIXELS)
    with pytest.raises(ImageError, match="EXIF orientation: is 6, which is applied to JPEG and PNG only"):
        read_upright(save(tmp_path / "b.tif", 6))


def test_where_a_calibration_could_disagree_the_remedies_are_named(tmp_path):
    with pytest.raises(ImageError, match=r"mogrify -auto-orient.*exiftool -Orientation=.*alike"):
        read_header(save(tmp_path / "a.jpg", 6))
