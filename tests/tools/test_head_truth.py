"""A head's surface against a truth that is known in closed form: a ball, seen in two frames of different scale."""

import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from bench.head_truth import (
    Surface,
    mean_errors,
    read_surface,
    reduced,
    show,
    similarity_of_cameras,
    table,
    view_errors,
)
from preface.artifacts import ArtifactError
from preface.capture.images import read_image, write_exr, write_png
from preface.geometry import Camera, Rigid, Similarity, Views, cast_rays, pixel_centers
from preface.geometry.transforms import rotation_from_quaternion
from preface.model.rendering.image import RenderedImage
from preface.model.rendering.paths import look_at
from synthetic_studio.layout import Layout

RADIUS = 0.1  # metres, studio
WIDTH, HEIGHT, FACTOR = 30, 40, 4
CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, np.array([100.0, 100.0, 15.0, 20.0]))
FINE = Camera("PINHOLE", WIDTH * FACTOR, HEIGHT * FACTOR, np.array([100.0, 100.0, 15.0, 20.0]) * FACTOR)
TURN = rotation_from_quaternion(np.array([0.9, 0.1, -0.3, 0.2]) / np.linalg.norm([0.9, 0.1, -0.3, 0.2]))
PLACE = Similarity(1.25, TURN, np.array([0.02, -0.03, 0.01]))  # canonical_from_studio


def studio_pose(angle=0.4) -> Rigid:
    return look_at(np.array([np.sin(angle), 0.2, np.cos(angle)]), np.zeros(3))


def ball(camera: Camera, pose: Rigid, center, radius) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] along the camera's axis and normals [H, W, 3] of a ball, NaN beside it."""
    rays = cast_rays(Views.stack([camera], [pose])[0], pixel_centers(camera.width, camera.height))
    origins, length = rays.origins - center, np.linalg.norm(rays.directions, axis=-1)
    along = (origins * rays.viewdirs).sum(-1)
    inside = along**2 - (origins**2).sum(-1) + radius**2
    reached = np.where(inside > 0, -along - np.sqrt(np.maximum(inside, 0)), np.nan)
    return reached / length, (origins + reached[..., None] * rays.viewdirs) / radius


@pytest.fixture
def surface() -> Surface:
    depth, normals = ball(FINE, studio_pose(), np.zeros(3), RADIUS)
    return reduced(Surface(depth, normals, np.isfinite(depth).astype(float)), FACTOR)


def head(radius=RADIUS, moved=(0.0, 0.0, 0.0)) -> RenderedImage:
    """The same ball as a head of the canonical frame shows it: larger, turned, elsewhere."""
    pose = PLACE.apply_to_pose(studio_pose())
    center = PLACE.apply(np.array(moved))
    depth, normals = ball(CAMERA, pose, center, radius * PLACE.scale)
    alpha = np.isfinite(depth).astype(np.float32)
    return RenderedImage(np.zeros((HEIGHT, WIDTH, 3), np.float32), alpha, depth.astype(np.float32), normals)


def test_the_similarity_of_two_frames_is_found_from_the_cameras_that_stand_in_both():
    studio = [studio_pose(angle) for angle in (-0.5, 0.0, 0.7)]
    found = similarity_of_cameras([PLACE.apply_to_pose(pose) for pose in studio], studio)
    assert float(found.scale) == pytest.approx(1.25, rel=1e-12)
    np.testing.assert_allclose(found.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(found.translation, PLACE.translation, atol=1e-12)


def test_the_right_surface_has_no_error_in_whatever_frame_it_is(surface):
    found = view_errors(head(), surface, PLACE, "density")
    assert found["depth_median_mm"] < 0.1  # of the reduction to coarse pixels
    assert abs(found["depth_bias_mm"]) < 0.1
    assert found["density_normals_median_deg"] < 0.3
    assert found["silhouette_iou"] > 0.93
    assert found["compared"] > 0.95
    assert "predicted_normals_median_deg" not in found


def test_a_surface_that_is_five_millimetres_further_is_found_so(surface):
    center = studio_pose().translation
    away = -5e-3 * center / np.linalg.norm(center)
    # Along rays that meet the ball at a slant it is a little more than that.
    here, there = (ball(FINE, studio_pose(), at, RADIUS)[0] for at in (np.zeros(3), away))
    expected = 1e3 * np.nanmedian(there - here)
    assert 5 < expected < 5.5
    found = view_errors(head(moved=away), surface, PLACE, "predicted")
    assert found["depth_median_mm"] == pytest.approx(expected, abs=0.1)
    assert found["depth_bias_mm"] == pytest.approx(expected, abs=0.1)
    nearer = view_errors(head(moved=-away), surface, PLACE, "predicted")
    assert nearer["depth_bias_mm"] == pytest.approx(-expected, abs=0.2)
    assert "predicted_normals_mean_deg" in found


def test_normals_that_are_turned_by_ten_degrees_are_found_so(surface):
    image = head()
    axis = PLACE.rotation @ studio_pose().rotation[:, 2]  # about the line of sight, canonical
    cosine, sine = np.cos(np.radians(10)), np.sin(np.radians(10))
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + sine * cross + (1 - cosine) * cross @ cross
    turned = RenderedImage(image.rgb, image.alpha, image.depth, image.normals @ turn.T)
    found = view_errors(turned, surface, PLACE, "density")
    # By 10 degrees at the outline, where normals stand across the line of sight, by none in the middle.
    exact = ball(CAMERA, studio_pose(), np.zeros(3), RADIUS)[1]
    across = np.linalg.norm(np.cross(exact, studio_pose().rotation[:, 2]), axis=-1)
    expected = np.degrees(2 * np.arcsin(across * np.sin(np.radians(5))))
    assert found["density_normals_median_deg"] == pytest.approx(np.nanmedian(expected), abs=0.4)


def test_a_transparent_head_has_nothing_to_compare(surface):
    nothing = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    empty = RenderedImage(np.zeros((HEIGHT, WIDTH, 3), np.float32), np.zeros_like(nothing), nothing, None)
    assert view_errors(empty, surface, PLACE, "density") == {"silhouette_iou": 0.0, "compared": 0.0}


def test_a_reduced_pixel_has_the_median_depth_of_most_of_what_it_covers():
    depth = np.array([[1.0, 1.0, np.nan, np.nan], [1.0, 9.0, np.nan, 2.0]])
    normals = np.where(np.isnan(depth)[..., None], np.nan, [0.0, 0.6, 0.8])
    found = reduced(Surface(depth, normals, np.isfinite(depth).astype(float)), 2)
    np.testing.assert_array_equal(found.depth, [[1.0, np.nan]])
    np.testing.assert_allclose(found.normals[0, 0], [0, 0.6, 0.8])
    np.testing.assert_allclose(found.mask, [[1.0, 0.25]])


def test_pixels_that_are_no_whole_number_of_the_truth_s_count_those_on_their_border_by_halves():
    fine = np.broadcast_to([2.0, 4.0, 8.0], (3, 3))  # three pixels under two
    nothing = np.zeros((3, 3))
    found = reduced(
        Surface(fine, np.broadcast_to([0.0, 0.0, 1.0], (3, 3, 3)), nothing + fine), Fraction(3, 2)
    )
    np.testing.assert_allclose(found.mask, [[8 / 3, 20 / 3]] * 2)
    np.testing.assert_array_equal(found.depth, [[2.0, 8.0]] * 2)


def studio_of_one_view(folder: Path) -> Layout:
    """6x9 pixels, 2 m away, facing the camera."""
    layout = Layout(folder)
    files = layout.view(0, 0)
    for path in (files.mask, files.depth, files.normals):
        path.parent.mkdir(parents=True, exist_ok=True)
    flat = np.zeros((9, 6), np.float32)
    write_exr(files.depth, {"Y": flat + 2})
    write_exr(files.normals, {"R": flat, "G": flat, "B": flat + 1})
    write_png(files.mask, np.full((9, 6), 65535, np.uint16))
    return layout


def test_the_truth_is_read_at_simple_ratios_of_its_size_and_refused_at_others(tmp_path):
    layout = studio_of_one_view(tmp_path)
    for size in ((6, 9), (2, 3), (4, 6)):
        found = read_surface(layout, "id0000", "cam00", size)
        assert found.depth.shape == size[::-1]
        np.testing.assert_array_equal(found.depth, 2)
        np.testing.assert_array_equal(found.mask, 1)
    for size in ((12, 18), (3, 3), (5, 9)):
        with pytest.raises(ArtifactError, match="no simple multiple of"):
            read_surface(layout, "id0000", "cam00", size)


def test_pictures_of_the_right_surface_show_no_error_and_of_a_wrong_one_the_bright_end(surface, tmp_path):
    show(head(), surface, PLACE, tmp_path / "right", "cam00")
    away = -30e-3 * studio_pose().translation / np.linalg.norm(studio_pose().translation)
    show(head(moved=away), surface, PLACE, tmp_path / "wrong", "cam00")
    middle = (HEIGHT // 2, WIDTH // 2)
    right, wrong = (
        read_image(tmp_path / name / "cam00.depth.error.png")[middle] for name in ("right", "wrong")
    )
    assert right.max() < 20
    assert wrong.sum() > 500
    normals = [read_image(tmp_path / "right" / f"cam00.normals{kind}.png")[middle] for kind in ("", ".true")]
    np.testing.assert_allclose(*np.asarray(normals, float), atol=3)


def test_the_table_has_a_column_per_head_and_a_dash_for_what_is_missing():
    views = [{"depth_median_mm": 1.0, "silhouette_iou": 0.5}, {"depth_median_mm": 3.0}]
    mean = mean_errors(views)
    assert mean == {"depth_median_mm": 2.0, "silhouette_iou": 0.5}
    heads = [
        {"head": "a", "identity": "id0", "views": {"x": {}, "y": {}}, "mean": mean},
        {"head": "b", "identity": "id0", "views": {"x": {}}, "mean": {"silhouette_iou": 0.25}},
    ]
    lines = table(heads).splitlines()
    assert lines[2] == "| depth, median | 2.000 mm | – |"
    assert lines[3] == "| silhouette, IoU | 0.500 | 0.250 |"
    assert lines[-1] == "| views | 2 | 1 |"
