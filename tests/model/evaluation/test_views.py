"""Which views are evaluated, and which square of them is the face, against geometry done by hand."""

import json

import numpy as np
import pytest

from preface.artifacts import ArtifactError
from preface.geometry import Camera, Rigid
from preface.model.evaluation.views import (
    Square,
    StandingCamera,
    camera_names,
    choose_views,
    degrees_between,
    face_square,
    fitted_views,
    identity_of,
    require_same_space,
    standing_camera,
)
from preface.model.training.prior_files import read_prior

ALL = [f"camera{number}" for number in range(6)]


def facing(distance: float, size=(100, 150), focal=500.0, x=0.0) -> StandingCamera:
    """A pinhole in front of the face at a distance, x metres to the subject's left, that looks along -z."""
    camera = Camera("PINHOLE", *size, np.array([focal, focal, size[0] / 2, size[1] / 2]))
    return StandingCamera("front", camera, Rigid(np.diag([1.0, -1.0, -1.0]), np.array([x, 0.0, distance])))


def test_the_face_fills_a_square_about_the_origin_s_image():
    # 0.1 m at 1 m and 500 px are 50 px to either side of the middle.
    assert face_square(facing(1.0), 0.1) == Square(0, 25, 100)
    # Twice as far, half as large; the origin moves to where a ray by hand says: 50 - 500 * 0.1 / 2 = 25.
    assert face_square(facing(2.0, x=0.1), 0.1) == Square(0, 50, 50)
    assert face_square(facing(2.0, x=0.05), 0.04) == Square(38 - 10, 65, 20)


def test_a_square_larger_than_the_image_is_its_shorter_side_and_one_at_an_edge_is_moved_inside():
    assert face_square(facing(0.3), 0.1) == Square(0, 25, 100)
    assert face_square(facing(1.0, x=0.09), 0.02) == Square(0, 65, 20)


@pytest.mark.parametrize("standing", [facing(1.0, x=0.2), facing(-1.0), facing(1e6)])
def test_there_is_no_face_beside_the_image_behind_the_camera_or_below_a_pixel(standing):
    assert face_square(standing, 0.1) is None


def test_a_square_cuts_its_part_out():
    image = np.arange(20).reshape(4, 5)
    np.testing.assert_array_equal(Square(1, 2, 2).of(image), [[11, 12], [16, 17]])


def test_angles_between_cameras_are_those_at_the_origin():
    here, there = (Rigid(np.eye(3), np.array(c)) for c in ([0.0, 0.0, 2.0], [1.0, 0.0, 1.0]))
    assert degrees_between(here, there) == pytest.approx(45)
    assert degrees_between(here, here) == 0


def test_a_prior_is_evaluated_at_the_views_that_it_held_out(prior, dataset):
    known = read_prior(prior)
    for name in known.identities:
        assert choose_views([known], dataset, name, None) == known.held_out[name]
        assert set(fitted_views(known, dataset, name)) == set(ALL) - set(known.held_out[name])


def test_heads_are_compared_at_views_that_none_of_them_has_seen(head, dataset):
    one, other = (read_prior(head(name, views)) for name, views in (("a", ALL[:2]), ("b", ALL[1:4])))
    assert choose_views([one], dataset, "id0000", None) == tuple(ALL[2:])
    assert choose_views([one, other], dataset, "id0000", None) == ("camera4", "camera5")


def test_views_that_are_asked_for_come_in_the_order_of_the_shards_whether_seen_or_not(head, dataset):
    known = read_prior(head("a", ALL[:2]))
    assert choose_views([known], dataset, "id0000", ["camera5", "camera0", "camera5"]) == (
        "camera0",
        "camera5",
    )


def test_no_view_left_is_an_error_with_a_way_out(head, dataset):
    with pytest.raises(ArtifactError, match=r"no view of 'id0000' is left .* --views"):
        choose_views([read_prior(head("a", ALL))], dataset, "id0000", None)


def test_unknown_cameras_and_identities_are_named_with_the_nearest(prior, dataset):
    known = read_prior(prior)
    with pytest.raises(ArtifactError, match=r"no view 'camera9'.*Perhaps 'camera"):
        choose_views([known], dataset, "id0000", ["camera9"])
    with pytest.raises(ArtifactError, match=r"there is no 'id000'.*Perhaps 'id000"):
        camera_names(dataset, "id000")
    with pytest.raises(ArtifactError, match=r"there is no 'id0009'.*Perhaps 'id000"):
        identity_of(known, "id0009")


def test_a_prior_of_several_needs_an_identity_and_a_head_does_not(prior, head):
    with pytest.raises(ArtifactError, match=r"none was chosen.*--identity"):
        identity_of(read_prior(prior), None)
    assert identity_of(read_prior(head("a", ALL[:1])), None) == "id0000"


@pytest.mark.parametrize(("field", "value"), [("box", [[-0.1] * 3, [0.13] * 3]), ("scene_scale", 6.5)])
def test_shards_of_another_box_are_refused(prior, dataset, tmp_path, field, value):
    content = json.loads((prior / "model.json").read_text())
    (tmp_path / "model.json").write_text(json.dumps(content | {field: value}))
    require_same_space(read_prior(prior), dataset)
    with pytest.raises(ArtifactError, match=r"box.*same --box"):
        require_same_space(read_prior(tmp_path), dataset)


def test_a_standing_camera_sees_points_where_the_photograph_shows_them(dataset):
    """Every ball is about the origin, so its outline is about the origin's image."""
    for name in ALL:
        standing = standing_camera(dataset, "id0001", name)
        origin, valid = standing.camera.project(standing.canonical_from_camera.inverse.apply(np.zeros(3)))
        y, x = np.nonzero(dataset.pixels(1, ALL.index(name))[..., 3])
        assert valid
        np.testing.assert_allclose(origin, [x.mean() + 0.5, y.mean() + 0.5], atol=0.3)
