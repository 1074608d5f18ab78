"""Cameras against OpenCV, COLMAP, automatic differentiation and the definition of the monotonic radius."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from preface.geometry import CAMERA_MODELS, Camera, GeometryError, lens, stack_intrinsics
from preface.geometry.conventions import camera_to_opencv, pixels_from_opencv, pixels_to_opencv

WIDTH, HEIGHT = 640, 960
PARAMS = {
    "PINHOLE": [1500.0, 1510.0, 330.0, 470.0],
    "SIMPLE_RADIAL": [1500.0, 330.0, 470.0, -0.3],
    "RADIAL": [1500.0, 330.0, 470.0, -0.3, 0.12],
    "OPENCV": [1500.0, 1510.0, 330.0, 470.0, -0.3, 0.12, 2e-3, -3e-3],
    "FULL_OPENCV": [1500.0, 1510.0, 330.0, 470.0, 0.2, -0.1, 2e-3, -3e-3, 0.03, 0.3, -0.05, 0.02],
}
CAMERAS = [Camera(model, WIDTH, HEIGHT, params) for model, params in PARAMS.items()]
each_model = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)


def image_grid() -> np.ndarray:
    return np.stack(np.meshgrid(np.linspace(0, WIDTH, 9), np.linspace(0, HEIGHT, 13)), axis=-1).reshape(-1, 2)


def points_in_view(count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(3)
    z = rng.uniform(0.5, 3, (count, 1))
    return np.concatenate([rng.uniform(-0.3, 0.3, (count, 2)) * z, z], axis=-1)


def at_depth_one(normalised: np.ndarray) -> np.ndarray:
    return np.concatenate([normalised, np.ones_like(normalised[..., :1])], axis=-1)


@st.composite
def random_cameras(draw: st.DrawFn) -> Camera:
    model = draw(st.sampled_from(sorted(CAMERA_MODELS)))
    strength = draw(st.sampled_from([1e-3, 0.1, 1.0, 10.0]))
    params = []
    for name in CAMERA_MODELS[model]:
        if name in ("f", "fx", "fy"):
            params.append(draw(st.floats(300, 20000)))
        elif name in ("cx", "cy"):
            params.append(draw(st.floats(0, 1000)))
        else:
            size = strength * (0.03 if name.startswith("p") else 1)
            params.append(draw(st.floats(-size, size)))
    return Camera(model, WIDTH, HEIGHT, np.array(params))


@each_model
def test_projection_agrees_with_opencv(camera: Camera) -> None:
    points = points_in_view()
    pixels, valid = camera.project(points)
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), *camera_to_opencv(camera))[0][:, 0]
    assert valid.all()
    np.testing.assert_allclose(pixels, pixels_from_opencv(expected), rtol=0, atol=1e-9)


@each_model
def test_unprojection_agrees_with_opencv_iterated_to_convergence(camera: Camera) -> None:
    K, distortion = camera_to_opencv(camera)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    opencv = pixels_to_opencv(image_grid())
    expected = cv2.undistortPointsIter(opencv[:, None], K, distortion, None, None, criteria)[:, 0]
    normalised, valid = camera.unproject(image_grid())
    assert valid.all()
    np.testing.assert_allclose(normalised, expected, rtol=0, atol=1e-12)


@each_model
def test_camera_agrees_with_colmap(camera: Camera) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    peer = pycolmap.Camera(model=camera.model, width=WIDTH, height=HEIGHT, params=camera.params)
    points = points_in_view()
    np.testing.assert_allclose(camera.project(points)[0], peer.img_from_cam(points), rtol=0, atol=1e-9)
    # COLMAP's own iteration stops at about 1e-10.
    np.testing.assert_allclose(camera.unproject(image_grid())[0], peer.cam_from_img(image_grid()), atol=1e-8)


@given(random_cameras(), st.floats(0, 0.9999), st.floats(0, 2 * np.pi))
def test_what_projects_inside_the_monotonic_radius_comes_back(
    camera: Camera, share: float, angle: float
) -> None:
    radius = share * min(camera.monotonic_radius, 2.0)
    point = np.array([radius * np.cos(angle), radius * np.sin(angle), 1.0])
    pixel, projected = camera.project(point)
    normalised, unprojected = camera.unproject(pixel)
    assert projected
    assert unprojected
    # A rounding of the pixel grows by 1/squeeze on the way back, one of the point by stretch on the way out.
    at = lens.distort(camera.intrinsics, *normalised)
    squeeze, stretch = np.linalg.eigvalsh([[at.xx, at.xy], [at.xy, at.yy]])
    of_pixel = 1e-14 * (np.abs(pixel).max() + camera.intrinsics[:4].max())
    of_point = 1e-14 * (1 + radius)
    again, _ = camera.project(at_depth_one(normalised))
    np.testing.assert_allclose(
        again, pixel, rtol=0, atol=of_pixel + camera.intrinsics[:2].max() * stretch * of_point
    )
    np.testing.assert_allclose(
        normalised, point[:2], rtol=0, atol=of_point + of_pixel / camera.intrinsics[0] / squeeze
    )


@given(random_cameras(), st.floats(-3000, 4000), st.floats(-3000, 4000))
def test_unprojection_is_right_or_masked(camera: Camera, x: float, y: float) -> None:
    normalised, valid = camera.unproject(np.array([x, y]))
    if valid:
        assert np.hypot(*normalised) < camera.monotonic_radius
        np.testing.assert_allclose(camera.project(at_depth_one(normalised))[0], (x, y), rtol=1e-11, atol=1e-9)
    else:
        assert np.isnan(normalised).all()


def test_points_behind_the_camera_are_masked() -> None:
    pixels, valid = CAMERAS[0].project([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.1, 0.1, 1.0]])
    assert valid.tolist() == [False, False, True]
    assert np.isnan(pixels).all(axis=-1).tolist() == [True, True, False]


def test_simple_radial_folds_where_its_cubic_turns() -> None:
    camera = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, [1500.0, 330.0, 470.0, -0.3])
    assert camera.monotonic_radius == pytest.approx(1 / np.sqrt(0.9), rel=1e-14)


def test_a_pole_of_the_rational_model_ends_the_monotonic_range() -> None:
    params = np.zeros(12)
    params[[0, 1, 9]] = 1000, 1000, -4  # radial(u) = 1 / (1 - 4u)
    assert Camera("FULL_OPENCV", WIDTH, HEIGHT, params).monotonic_radius == pytest.approx(0.5, rel=1e-14)


@pytest.mark.parametrize("params", [PARAMS["PINHOLE"], [1000.0, 1000, 320, 480, 0.5, 0.5, 0, 0]])
def test_lenses_that_only_stretch_never_fold(params: list[float]) -> None:
    camera = Camera("PINHOLE" if len(params) == 4 else "OPENCV", WIDTH, HEIGHT, params)
    assert camera.monotonic_radius == np.inf


def test_radial_lenses_grow_up_to_the_monotonic_radius_and_stop_there() -> None:
    rng = np.random.default_rng(0)
    intrinsics = np.zeros((500, 12))
    intrinsics[:, [4, 5, 8, 9, 10, 11]] = rng.normal(size=(500, 6)) * 10 ** rng.uniform(-3, 2, (500, 1))
    radius = lens.monotonic_radius(intrinsics)
    assert 0.5 < np.isfinite(radius).mean() < 1
    r = np.linspace(0, 1 - 1e-9, 2000) * np.minimum(radius, 5)[:, None]
    distorted = lens.distort(intrinsics[:, None], r, 0 * r).x
    assert (np.diff(distorted, axis=-1) > 0).all()
    just_past = (1 + 1e-4) * radius[np.isfinite(radius), None] * np.array([1, 1 + 1e-4])
    turned = lens.distort(intrinsics[np.isfinite(radius), None], just_past, 0 * just_past).x
    assert ((turned[:, 1] < turned[:, 0]) | (turned[:, 0] < 0)).all()


def test_the_distortion_is_one_to_one_on_the_monotonic_disc_with_tangential_terms() -> None:
    rng = np.random.default_rng(1)
    intrinsics = np.zeros((300, 12))
    intrinsics[:, 4:] = rng.normal(size=(300, 8)) * 10 ** rng.uniform(-2, 0.5, (300, 1))
    radius = np.minimum(lens.monotonic_radius(intrinsics), 5)[:, None, None]
    r, angle = np.linspace(0, 1 - 1e-9, 200)[:, None], np.linspace(0, 2 * np.pi, 90)
    at = lens.distort(intrinsics[:, None, None], radius * r * np.cos(angle), radius * r * np.sin(angle))
    assert ((at.xx + at.yy > 0) & (at.xx * at.yy > at.xy**2)).all()


def test_tangential_terms_shrink_the_disc_to_the_first_fold_in_their_direction() -> None:
    camera = Camera("OPENCV", WIDTH, HEIGHT, [1000.0, 1000, 320, 480, -0.2, 0.0, 0.0, 0.01])
    at = lens.distort(camera.intrinsics, -camera.monotonic_radius, 0.0)
    assert at.xx == pytest.approx(0, abs=1e-14)


@each_model
def test_jacobians_agree_with_automatic_differentiation(camera: Camera) -> None:
    points = torch.tensor(points_in_view(20))
    intrinsics = torch.tensor(camera.intrinsics)
    radius = torch.tensor(camera.monotonic_radius)
    by_point, by_intrinsics = lens.projection_jacobians(intrinsics, radius, points)
    for i, point in enumerate(points):
        expected = torch.autograd.functional.jacobian(
            lambda lens_i, point_i: lens.project(lens_i, radius, point_i)[0], (intrinsics, point)
        )
        torch.testing.assert_close(by_intrinsics[i], expected[0], rtol=1e-12, atol=1e-10)
        torch.testing.assert_close(by_point[i], expected[1], rtol=1e-12, atol=1e-10)


@each_model
def test_parameter_jacobian_predicts_how_pixels_move(camera: Camera) -> None:
    points = points_in_view(20)
    _, by_params = camera.projection_jacobians(points)
    for i, value in enumerate(camera.params):
        step = np.zeros(len(camera.params))
        step[i] = 1e-5 * max(1, abs(value))
        after, before = (
            Camera(camera.model, WIDTH, HEIGHT, camera.params + sign * step).project(points)[0]
            for sign in (1, -1)
        )
        np.testing.assert_allclose(by_params[..., i], (after - before) / (2 * step[i]), rtol=1e-6, atol=1e-6)


@each_model
def test_unprojection_jacobian_is_the_slope_of_unprojection(camera: Camera) -> None:
    intrinsics, radius = camera.intrinsics, camera.monotonic_radius
    _, jacobian, _ = lens.unproject(intrinsics, radius, image_grid())
    for axis in range(2):
        step = 0.01 * np.eye(2)[axis]
        after, before = (
            lens.unproject(intrinsics, radius, image_grid() + sign * step)[0] for sign in (1, -1)
        )
        np.testing.assert_allclose(jacobian[..., axis], (after - before) / 0.02, rtol=1e-6, atol=1e-11)


def test_mixed_models_in_one_stack_equal_each_camera_alone() -> None:
    intrinsics, radius = stack_intrinsics(CAMERAS)
    points = points_in_view()
    pixels, valid = lens.project(intrinsics[:, None], radius[:, None], points)
    assert valid.shape == (5, 200)
    for i, camera in enumerate(CAMERAS):
        np.testing.assert_array_equal(pixels[i], camera.project(points)[0])
    normalised, jacobian, _ = lens.unproject(intrinsics[:, None], radius[:, None], image_grid())
    assert jacobian.shape == (5, 117, 2, 2)
    for i, camera in enumerate(CAMERAS):
        np.testing.assert_allclose(normalised[i], camera.unproject(image_grid())[0], rtol=0, atol=1e-15)


@each_model
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-15), (torch.float32, 3e-7)])
def test_torch_runs_the_same_formulas(camera: Camera, dtype: torch.dtype, tolerance: float) -> None:
    normalised, valid = camera.unproject(torch.tensor(image_grid(), dtype=dtype))
    assert normalised.dtype == dtype
    assert valid.all()
    np.testing.assert_allclose(normalised, camera.unproject(image_grid())[0], rtol=0, atol=tolerance)
    pixels, _ = camera.project(torch.tensor(points_in_view(), dtype=dtype))
    assert pixels.dtype == dtype
    np.testing.assert_allclose(pixels, camera.project(points_in_view())[0], rtol=0, atol=2000 * tolerance)


def test_masked_points_leave_the_gradients_of_the_others_finite() -> None:
    points = torch.tensor(
        [[0.0, 0.0, 1.0], [0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [9.0, 9.0, 1.0]], requires_grad=True
    )
    pixels, valid = CAMERAS[1].project(points)
    pixels[valid].sum().backward()
    assert valid.tolist() == [True, False, False, False]
    assert torch.isfinite(points.grad).all()


@given(random_cameras(), st.integers(1, 5000), st.integers(1, 5000))
def test_resizing_the_image_scales_its_pixels(camera: Camera, width: int, height: int) -> None:
    pixels, _ = camera.project(points_in_view(20))
    resized, _ = camera.resized(width, height).project(points_in_view(20))
    np.testing.assert_allclose(resized, pixels * (width / WIDTH, height / HEIGHT), rtol=1e-12, atol=1e-9)


@given(random_cameras(), st.integers(-500, 500), st.integers(-500, 500))
def test_cropping_the_image_shifts_its_pixels(camera: Camera, left: int, top: int) -> None:
    pixels, _ = camera.project(points_in_view(20))
    cropped = camera.cropped(left, top, 300, 200)
    assert (cropped.width, cropped.height) == (300, 200)
    np.testing.assert_allclose(
        cropped.project(points_in_view(20))[0], pixels - (left, top), rtol=1e-12, atol=1e-9
    )


def test_single_focal_models_keep_their_model_unless_the_axes_scale_differently() -> None:
    camera = CAMERAS[1]
    assert camera.resized(WIDTH // 2, HEIGHT // 2).model == "SIMPLE_RADIAL"
    stretched = camera.resized(2 * WIDTH, HEIGHT)
    assert stretched.model == "OPENCV"
    assert stretched.params.tolist() == [3000, 1500, 660, 470, -0.3, 0, 0, 0]


def test_a_camera_turns_into_a_richer_model_but_never_loses_parameters() -> None:
    assert CAMERAS[2].as_model("FULL_OPENCV").as_model("RADIAL") == CAMERAS[2]
    with pytest.raises(GeometryError, match="OPENCV cannot express k3, k4, k5, k6"):
        CAMERAS[4].as_model("OPENCV")


def test_cameras_compare_by_value_and_cannot_be_changed() -> None:
    same = Camera("PINHOLE", WIDTH, HEIGHT, PARAMS["PINHOLE"])
    assert same == CAMERAS[0]
    assert len({same, CAMERAS[0], CAMERAS[1]}) == 2
    with pytest.raises(ValueError, match="read-only"):
        same.params[0] = 1


def test_a_lens_that_folds_inside_the_image_is_refused() -> None:
    folding = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, [600.0, 320.0, 480.0, -0.5])
    assert folding.folds_inside_image()
    with pytest.raises(GeometryError, match=r"folds inside its 640x960 image, at 0\.8165 focal lengths"):
        folding.require_unfolded()
    for camera in CAMERAS:
        camera.require_unfolded()


@pytest.mark.parametrize(
    ("model", "width", "height", "params", "message"),
    [
        ("FISHEYE", 640, 960, [1, 1, 1, 1], "model: 'FISHEYE' is unknown; use one of PINHOLE"),
        ("PINHOLE", 0, 960, [1, 1, 1, 1], "width: 0 is not a positive"),
        ("PINHOLE", 640, -1, [1, 1, 1, 1], "height: -1 is not a positive"),
        ("PINHOLE", 640.5, 960, [1, 1, 1, 1], "width: 640.5 is not a positive whole"),
        ("PINHOLE", True, 960, [1, 1, 1, 1], "width: True"),
        ("PINHOLE", 640, 960, [1, 1, 1], r"PINHOLE takes 4 numbers \(fx, fy, cx, cy\)"),
        ("PINHOLE", 640, 960, [[1, 1, 1, 1]], "not an array of shape"),
        ("PINHOLE", 640, 960, ["a", 1, 1, 1], "are not numbers"),
        ("PINHOLE", 640, 960, [-5, 1, 1, 1], "fx of this PINHOLE camera is -5.0; a focal length is positive"),
        ("PINHOLE", 640, 960, [1, 0, 1, 1], "fy of this PINHOLE camera is 0.0"),
        ("RADIAL", 640, 960, [1, 1, np.nan, 0, 0], "cy of this RADIAL camera is nan"),
        ("SIMPLE_RADIAL", 640, 960, [1, 1, 1, np.inf], "k of this SIMPLE_RADIAL camera is inf"),
    ],
)
def test_impossible_cameras_are_refused_by_field(
    model: str, width: int, height: int, params: list, message: str
) -> None:
    with pytest.raises(GeometryError, match=message):
        Camera(model, width, height, params)
