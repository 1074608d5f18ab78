"""The cameras stand and see as the lab's do, and wander as told."""

import numpy as np
import pytest

from synthetic_studio.config import DriftConfig
from synthetic_studio.rig import HEAD_CENTRE, nominal_rig, take_rig

SIZES = [(256, 384), (4096, 6144)]
# A person with hair, about HEAD_CENTRE: 26 cm across and deep, 30 cm from the neck to above the hair.
HALF_WIDTH, HALF_HEIGHT = 0.13, 0.15


def centre_of(camera):
    return camera.camera_from_rig.inverse.translation


def ellipsoid():
    longitude, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(-np.pi / 2, np.pi / 2, 25))
    round_, up = np.cos(latitude), np.sin(latitude)
    sphere = np.stack([round_ * np.cos(longitude), up, round_ * np.sin(longitude)], axis=-1)
    return HEAD_CENTRE + sphere * [HALF_WIDTH, HALF_HEIGHT, HALF_WIDTH]


def test_first_camera_is_frontal_and_upright():
    front = nominal_rig(13, (256, 384), 0)[0]
    direction = centre_of(front) - HEAD_CENTRE
    assert np.degrees(np.arccos(direction[2] / np.linalg.norm(direction))) < 5
    left, up, _ = front.camera_from_rig.rotation.T
    assert left[0] > 0.99  # the subject's left is at the right of the image
    assert up[1] < -0.99


def test_all_cameras_are_about_a_metre_away_in_the_frontal_hemisphere():
    places = np.array([centre_of(camera) - HEAD_CENTRE for camera in nominal_rig(13, (256, 384), 3)])
    distances = np.linalg.norm(places, axis=1)
    assert distances.min() > 0.95
    assert distances.max() < 1.05
    assert (places[:, 2] > 0).all()
    azimuths = np.degrees(np.arctan2(places[:, 0], places[:, 2]))
    assert (np.abs(azimuths) <= 56).sum() >= 11
    assert (np.abs(azimuths) > 70).sum() == 2


@pytest.mark.parametrize("size", [*SIZES, (384, 384), (600, 300)])
@pytest.mark.parametrize("seed", range(4))
def test_head_with_hair_is_inside_every_frame(size, seed):
    for camera in nominal_rig(13, size, seed):
        pixels, valid = camera.camera.project(camera.camera_from_rig.apply(ellipsoid()))
        assert valid.all()
        assert (pixels >= 0).all()
        assert (pixels <= size).all()


def test_a_head_takes_about_six_tenths_of_the_height():
    top_and_chin = np.array([[0, 0.155, -0.07], [0, -0.105, -0.02]])  # 26 cm with hair
    for camera in nominal_rig(13, (4096, 6144), 0)[:3]:
        pixels, _ = camera.camera.project(camera.camera_from_rig.apply(top_and_chin))
        assert 0.55 < (pixels[1, 1] - pixels[0, 1]) / 6144 < 0.68


@pytest.mark.parametrize("seed", range(6))
def test_no_lens_folds_inside_its_image_and_all_differ(seed):
    cameras = [camera.camera for camera in nominal_rig(30, (256, 384), seed)]
    assert not any(camera.folds_inside_image() for camera in cameras)
    assert len({tuple(camera.params) for camera in cameras}) == 30


def test_resolutions_are_one_lens_scaled():
    small, large = (nominal_rig(13, size, 1) for size in SIZES)
    for one, other in zip(small, large, strict=True):
        np.testing.assert_allclose(one.camera.params[:4] * 16, other.camera.params[:4], rtol=1e-12)
        np.testing.assert_array_equal(one.camera.params[4:], other.camera.params[4:])
        np.testing.assert_array_equal(one.camera_from_rig.translation, other.camera_from_rig.translation)


def test_a_smaller_rig_is_the_beginning_of_a_larger_one():
    few, many = nominal_rig(3, (256, 384), 0), nominal_rig(20, (256, 384), 0)
    for one, other in zip(few, many, strict=False):
        np.testing.assert_array_equal(one.camera.params, other.camera.params)


def test_square_images_keep_square_pixels():
    camera = nominal_rig(1, (500, 500), 0)[0].camera
    assert camera.params[0] == pytest.approx(camera.params[1], rel=1e-3)


def test_drift_has_the_rms_size_that_was_asked_for():
    nominal = nominal_rig(13, (256, 384), 0)
    shifts, angles = [], []
    for take in range(60):
        for before, after in zip(nominal, take_rig(nominal, DriftConfig(), 0, take), strict=True):
            shifts.append(np.linalg.norm(centre_of(after) - centre_of(before)))
            turn = after.camera_from_rig.rotation @ before.camera_from_rig.rotation.T
            angles.append(np.degrees(np.linalg.norm(turn - turn.T) / np.sqrt(8)))
    # 780 draws of three components each: the RMS is known to 1.5 percent.
    assert np.sqrt(np.mean(np.square(shifts))) * 1000 == pytest.approx(0.2, rel=0.06)
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(0.02, rel=0.06)


def test_without_drift_every_take_has_the_nominal_rig():
    nominal = nominal_rig(5, (256, 384), 0)
    for before, after in zip(nominal, take_rig(nominal, DriftConfig(0, 0), 0, 7), strict=True):
        np.testing.assert_array_equal(after.camera_from_rig.matrix, before.camera_from_rig.matrix)
