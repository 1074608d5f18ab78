"""Boards are held where the truth says, and their photographs show it to OpenCV's detectors."""

import cv2
import numpy as np
import pytest

from preface.geometry.transforms import Rigid
from synthetic_studio.board_render import KEY_DIRECTION, BoardCamera, render_board
from synthetic_studio.boards import board_pose, seen_corners
from synthetic_studio.config import BoardConfig, DriftConfig, SensorConfig
from synthetic_studio.patterns import INK, BoardPattern
from synthetic_studio.rig import HEAD_CENTRE, nominal_rig, take_rig
from synthetic_studio.sensor import expose, vignetting

# Refinement window of cv2.cornerSubPix, half side in pixels: inside a square even when it is tilted.
WINDOW = (3, 3)
SUBPIX = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
HALF_PIXEL = 0.5  # OpenCV's pixel centres are whole numbers


def studio(config, size, cameras=13):
    rig = take_rig(nominal_rig(cameras, size, 0), DriftConfig(), 0, 0)
    return BoardPattern.from_config(config), rig


def photograph(pattern, rig_from_board, camera, seed=0):
    sensor = SensorConfig()
    key = rig_from_board.rotation.T @ KEY_DIRECTION
    light = render_board(pattern, camera.camera_from_rig @ rig_from_board, key, BoardCamera(camera.camera))
    falloff = vignetting(camera.camera, sensor.vignetting)
    return expose(light, falloff, sensor, np.random.default_rng(seed))


def charuco_detector(pattern):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, pattern.dictionary))
    return cv2.aruco.CharucoDetector(
        cv2.aruco.CharucoBoard(pattern.squares, pattern.square, pattern.marker, dictionary)
    )


def detect_charuco(pattern, image):
    """Ids and continuous pixels of the corners found.

    They are refined again because CharucoDetector's own corners carry half a pixel up to OpenCV 4.12 and
    none later (opencv pull request 28380).
    """
    found, identities, _, _ = charuco_detector(pattern).detectBoard(image)
    if identities is None:
        return np.empty(0, int), np.empty((0, 2))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    refined = cv2.cornerSubPix(grey, found.copy(), WINDOW, (-1, -1), SUBPIX)
    return identities.ravel(), refined.reshape(-1, 2) + HALF_PIXEL


def charuco_errors(config, size, cameras, frames):
    pattern, rig = studio(config, size)
    errors, visible = [], 0
    for index in cameras:
        for frame in frames:
            pose = board_pose(config, pattern, 0, 0, frame)
            truth = seen_corners(pattern, pose, rig[index])
            identities, pixels = detect_charuco(pattern, photograph(pattern, pose, rig[index]))
            inside = truth.visible[identities]
            errors.append((pixels - truth.pixels[identities])[inside])
            visible += truth.visible.sum()
    return np.concatenate(errors), visible


def robust_rms(errors):
    """RMS without gross detector mistakes, which are not the renderer's."""
    return np.sqrt(np.mean(errors[(np.abs(errors) < 1).all(axis=1)] ** 2))


@pytest.mark.parametrize("bow", [(0.0, 0.0), (2.0, -1.0)])
def test_charuco_corners_are_detected_where_the_truth_has_them(bow):
    errors, visible = charuco_errors(BoardConfig(bow_mm=bow), (512, 768), (0, 2, 3), range(4))
    assert len(errors) > 0.7 * visible
    # Half a pixel would be a mistaken convention, whichever way.
    np.testing.assert_allclose(errors[(np.abs(errors) < 1).all(axis=1)].mean(axis=0), 0, atol=0.02)
    assert np.median(np.abs(errors)) < 0.06
    assert robust_rms(errors) < 0.12
    # On steep boards the refinement now and then walks to the corner of a marker.
    assert (np.abs(errors) > 1).any(axis=1).mean() < 0.04


def test_a_bow_that_is_not_in_the_truth_shows_in_the_corners():
    bowed, flat = (BoardPattern.from_config(BoardConfig(bow_mm=bow)) for bow in ((2.0, -1.0), (0.0, 0.0)))
    _, rig = studio(BoardConfig(), (512, 768))
    pose = board_pose(BoardConfig(), bowed, 0, 0, 1)
    identities, pixels = detect_charuco(bowed, photograph(bowed, pose, rig[1]))
    error = pixels - seen_corners(flat, pose, rig[1]).pixels[identities]
    assert np.median(np.linalg.norm(error, axis=1)) > 0.5


def test_chessboard_corners_are_detected_where_the_truth_has_them():
    config = BoardConfig(kind="chessboard", tilt=25)
    pattern, rig = studio(config, (512, 768))
    inner = (pattern.squares[0] - 1, pattern.squares[1] - 1)
    errors = []
    for frame in range(5):
        pose = board_pose(config, pattern, 0, 0, frame)
        truth = seen_corners(pattern, pose, rig[0])
        grey = cv2.cvtColor(photograph(pattern, pose, rig[0]), cv2.COLOR_RGB2GRAY)
        found, pixels = cv2.findChessboardCornersSB(grey, inner, flags=cv2.CALIB_CB_ACCURACY)
        if found:
            assert truth.visible.all()
            errors.append(in_order(pixels.reshape(-1, 2) + HALF_PIXEL, truth.pixels) - truth.pixels)
    errors = np.concatenate(errors)
    assert len(errors) >= 2 * inner[0] * inner[1]
    np.testing.assert_allclose(errors.mean(axis=0), 0, atol=0.03)
    assert np.sqrt((errors**2).mean()) < 0.12


def in_order(pixels, truth):
    """The detector may count from either end."""
    return min(pixels, pixels[::-1], key=lambda points: np.abs(points - truth).sum())


def test_a_pixel_is_the_mean_light_of_its_area():
    """Held against brute force: a board seen straight on, 64 x 64 exact samples per pixel."""
    pattern = BoardPattern.from_config(BoardConfig())
    camera = nominal_rig(1, (256, 384), 0)[0].camera
    away = Rigid(np.eye(3), np.array([-0.09, -0.13, 1.1]))
    image = render_board(pattern, away, np.array([0.0, 0, -1]), BoardCamera(camera))
    fine, top, left, side = 64, 160, 110, 20
    steps = (np.arange(side * fine) + 0.5) / fine
    rays, _ = camera.unproject(np.stack(np.meshgrid(left + steps, top + steps), axis=-1))
    xy = rays * 1.1 - away.translation[:2]
    cells = pattern.cells[
        np.searchsorted(pattern.edges[1], xy[..., 1]), np.searchsorted(pattern.edges[0], xy[..., 0])
    ]
    ink = (cells == INK).reshape(side, fine, side, fine).mean(axis=(1, 3))
    # Light is smooth over this window: fit it with black and white, which leaves each pixel's share of ink.
    seen = image[top : top + side, left : left + side, 1]
    black, white = np.linalg.lstsq(np.stack([ink.ravel(), 1 - ink.ravel()], axis=1), seen.ravel())[0]
    error = (white - seen) / (white - black) - ink
    assert np.sqrt((error**2).mean()) < 0.02
    assert np.abs(error).max() < 0.12  # 16 samples, corners of markers included


def test_back_of_the_board_is_dark_and_plain_and_its_corners_are_not_visible():
    pattern, rig = studio(BoardConfig(), (128, 192))
    facing = np.diag([1.0, -1.0, -1.0])
    turned = facing @ np.diag([-1.0, 1.0, -1.0])
    pose = Rigid(turned, HEAD_CENTRE - turned @ np.append(pattern.extent / 2, 0))
    camera_from_board = rig[0].camera_from_rig @ pose
    light = render_board(pattern, camera_from_board, np.array([0.0, 0, 1]), BoardCamera(rig[0].camera))
    assert light.max() < 0.08
    assert light[96, 64].min() > light[0, 0].max()
    assert not seen_corners(pattern, pose, rig[0]).visible.any()


def test_a_board_out_of_sight_leaves_the_dark_studio():
    pattern, rig = studio(BoardConfig(), (128, 192))
    aside = Rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.9, 0.0, 0.0]))
    camera_from_board = rig[0].camera_from_rig @ aside
    light = render_board(pattern, camera_from_board, np.array([0.0, 0, -1]), BoardCamera(rig[0].camera))
    assert np.ptp(light) == 0
    assert not seen_corners(pattern, aside, rig[0]).visible.any()


def test_poses_tilt_up_to_the_limit_in_all_directions_and_stay_about_the_head():
    config = BoardConfig()
    pattern = BoardPattern.from_config(config)
    poses = [board_pose(config, pattern, 0, 0, frame) for frame in range(200)]
    normals = np.array([-pose.rotation[:, 2] for pose in poses])
    tilts = np.degrees(np.arccos(normals[:, 2]))
    assert tilts.max() <= 50
    assert tilts.max() > 47
    assert (np.abs(normals[:, :2].mean(axis=0)) < 0.05).all()
    middles = np.array([pose.apply(np.append(pattern.extent / 2, 0)) for pose in poses])
    assert np.abs(middles - HEAD_CENTRE).max() < 0.16


def test_every_camera_sees_a_good_part_of_the_frames_and_some_only_in_part():
    config = BoardConfig()
    pattern, rig = studio(config, (256, 384))
    poses = [board_pose(config, pattern, 0, 0, frame) for frame in range(40)]
    shares = np.array(
        [[seen_corners(pattern, pose, camera).visible.mean() for pose in poses] for camera in rig]
    )
    assert ((shares > 0.2).sum(axis=1) >= 15).all()
    assert ((shares > 0) & (shares < 1)).sum() > 30


def test_takes_and_frames_have_their_own_poses_and_a_seed_repeats_them():
    config = BoardConfig()
    pattern = BoardPattern.from_config(config)
    places = {which: board_pose(config, pattern, 0, *which).translation for which in ((0, 0), (0, 1), (1, 0))}
    assert len({tuple(place) for place in places.values()}) == 3
    np.testing.assert_array_equal(board_pose(config, pattern, 0, 1, 0).translation, places[1, 0])
