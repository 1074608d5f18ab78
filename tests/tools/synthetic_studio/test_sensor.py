"""Light becomes pixels by the rules of optics and sRGB."""

import numpy as np
import pytest

from preface.geometry.cameras import Camera
from preface.srgb import encode as encode_srgb
from synthetic_studio.config import SensorConfig
from synthetic_studio.sensor import expose, vignetting

IDEAL = SensorConfig(blur=0, full_well=0, vignetting=0)


def photograph(light, config=IDEAL, seed=0):
    light = np.asarray(light, np.float32)
    return expose(light, np.ones(light.shape[:2], np.float32), config, np.random.default_rng(seed))


def decode_srgb(encoded):
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def test_srgb_has_the_standards_values_and_is_undone_by_its_inverse():
    assert encode_srgb(np.array(0.2140411)) == pytest.approx(0.5, abs=1e-6)
    assert encode_srgb(np.array([0.0, 1.0])).tolist() == pytest.approx([0, 1])
    linear = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(decode_srgb(encode_srgb(linear)), linear, atol=1e-7)


def test_an_ideal_sensor_rounds_and_clips():
    light = decode_srgb(np.array([0, 100, 254, 255]) / 255).reshape(1, 4, 1).repeat(3, axis=2)
    assert photograph(light)[0, :, 0].tolist() == [0, 100, 254, 255]
    assert photograph([[[-1, 2, 0.5]]])[0, 0].tolist() == [0, 255, 188]


def test_exposure_multiplies_the_light():
    light = np.full((4, 4, 3), 0.1)
    np.testing.assert_array_equal(
        photograph(light, SensorConfig(blur=0, full_well=0, exposure=2)), photograph(2 * light)
    )


def test_vignetting_is_the_fourth_power_of_the_cosine():
    camera = Camera("PINHOLE", 200, 300, np.array([400.0, 400.0, 100.0, 150.0]))
    falloff = vignetting(camera, 1.0)
    tangent = np.hypot(99.5, 149.5) / 400
    assert falloff[0, 0] == pytest.approx(np.cos(np.arctan(tangent)) ** 4, rel=1e-6)
    assert falloff[150, 100] == pytest.approx(1, abs=1e-5)
    assert (vignetting(camera, 0.0) == 1).all()


def test_blur_keeps_the_light_and_spreads_it_by_its_sigma():
    light = np.zeros((31, 31, 3))
    light[15, 15] = 0.9
    blurred = decode_srgb(photograph(light, SensorConfig(blur=1.5, full_well=0))[..., 0] / 255.0)
    offsets = np.arange(31) - 15
    assert blurred.sum() == pytest.approx(0.9, rel=0.05)
    assert np.sqrt((blurred.sum(0) * offsets**2).sum() / blurred.sum()) == pytest.approx(1.5, rel=0.1)


@pytest.mark.parametrize("level", [0.05, 0.2, 0.6])
def test_noise_has_the_variance_of_its_electrons(level):
    config = SensorConfig(blur=0, full_well=1000, read_noise=5)
    measured = decode_srgb(photograph(np.full((300, 300, 3), level), config) / 255.0)
    assert measured.mean() == pytest.approx(level, rel=0.01)
    assert measured.std() == pytest.approx(np.sqrt(1000 * level + 25) / 1000, rel=0.03)


def test_noise_is_a_function_of_its_generator():
    light = np.full((50, 40, 3), 0.3)
    config = SensorConfig()
    np.testing.assert_array_equal(photograph(light, config, 1), photograph(light, config, 1))
    assert (photograph(light, config, 1) != photograph(light, config, 2)).any()


def test_default_noise_is_light():
    grey = photograph(np.full((200, 200, 3), 0.2), SensorConfig())
    assert 0.3 < grey.std() < 2.5
