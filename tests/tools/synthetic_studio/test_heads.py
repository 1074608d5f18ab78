"""The head as a whole: what a camera and the truth say about it must agree."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from synthetic_studio.hair import grow_hair
from synthetic_studio.heads import Head, build_head
from synthetic_studio.identity import sample_identity
from synthetic_studio.render import HeadRender, HeadRenderer
from synthetic_studio.rig import StudioCamera, nominal_rig
from synthetic_studio.template import head_template

SEED = 3


@pytest.fixture(scope="module")
def head() -> Head:
    return build_head(SEED, 0)


@pytest.fixture(scope="module")
def cameras() -> list[StudioCamera]:
    return nominal_rig(13, (64, 96), SEED)


@pytest.fixture(scope="module")
def front(head: Head, cameras: list[StudioCamera]) -> HeadRender:
    return HeadRenderer(head).render(cameras[0].camera, cameras[0].camera_from_rig, 2)


def surface_points(render: HeadRender, view: StudioCamera) -> tuple[np.ndarray, np.ndarray]:
    """Back-project the depth map: points [P, 3] in the studio and where they are in the image [H, W]."""
    seen = np.isfinite(render.depth)
    rows, columns = np.nonzero(seen)
    xy, _ = view.camera.unproject(np.stack([columns + 0.5, rows + 0.5], axis=-1))
    in_camera = np.c_[xy, np.ones(len(xy))] * render.depth[seen][:, None]
    return view.camera_from_rig.inverse.apply(in_camera), seen


def test_the_same_seed_gives_the_same_person_and_the_same_bits(head, cameras, front):
    again = build_head(SEED, 0)
    assert again.parameters == head.parameters
    repeated = HeadRenderer(again).render(cameras[0].camera, cameras[0].camera_from_rig, 2)
    for name in ("radiance", "alpha", "depth", "normals"):
        assert getattr(repeated, name).tobytes() == getattr(front, name).tobytes(), name


def test_another_index_or_seed_gives_another_person():
    first = sample_identity(SEED, 0).to_json()
    assert sample_identity(SEED, 1).to_json() != first
    assert sample_identity(SEED + 1, 0).to_json() != first


def test_left_and_right_controls_are_alike_but_not_equal():
    controls = sample_identity(SEED, 4).controls
    pairs = [(controls[name], controls["r-" + name[2:]]) for name in controls if name.startswith("l-")]
    assert len(pairs) > 20
    difference = np.diff(pairs, axis=1)
    assert 0.0 < np.abs(difference).max() < 0.25
    assert np.std([left for left, _ in pairs]) > 2 * np.std(difference)


def test_identities_differ_in_what_people_differ_in():
    people = [sample_identity(SEED, index) for index in range(60)]
    assert len({person.hair_style for person in people}) >= 6
    assert len({person.iris for person in people}) >= 4
    assert np.ptp([person.melanin for person in people]) > 0.5
    assert {person.phenotypes["gender"] > 0.5 for person in people} == {True, False}


def test_a_head_has_human_size_and_sits_at_the_origin(head):
    points = np.array(list(head.keypoints.values()))
    assert np.linalg.norm(points.mean(axis=0)) < 0.03
    eyes = np.linalg.norm(head.keypoints["left_eye_outer"] - head.keypoints["right_eye_outer"])
    assert 0.075 < eyes < 0.115
    assert head.keypoints["left_eye_outer"][0] > head.keypoints["right_eye_outer"][0]
    assert head.keypoints["nose_tip"][2] > head.keypoints["left_eye_outer"][2]
    heights = [head.keypoints[name][1] for name in ("left_eye_outer", "nose_tip", "mouth_center", "chin")]
    assert heights == sorted(heights, reverse=True)


def test_landmarks_lie_on_the_skin(head):
    points = np.array([head.landmarks[str(index)] for index in range(468)])
    nearest, _ = cKDTree(head.surface.vertices).query(points)
    assert nearest.max() < 0.003  # the fine mesh has edges of about 2 mm


def test_irises_lie_between_the_corners_of_their_eyes(head):
    for iris, inner, outer in (("468", "133", "33"), ("473", "362", "263")):
        between = 0.5 * (head.landmarks[inner] + head.landmarks[outer])
        assert np.linalg.norm(head.landmarks[iris] - between) < 0.013


def test_coverage_is_fractional_at_edges_and_full_inside(front):
    assert front.alpha.min() == 0.0
    assert front.alpha.max() == 1.0
    fractional = (front.alpha > 0.0) & (front.alpha < 1.0)
    assert 0.01 < fractional.mean() < 0.3
    assert (front.radiance[front.alpha == 0.0] == 0.0).all()


def test_depth_and_coverage_agree(front):
    # The ray through a centre may slip between strands that cover the samples around it.
    assert np.isfinite(front.depth)[front.alpha == 1.0].mean() > 0.98
    assert np.isnan(front.depth)[front.alpha == 0.0].mean() > 0.99
    assert (np.isnan(front.normals).any(axis=-1) == np.isnan(front.depth)).all()


def test_depth_carries_pixels_onto_the_true_surface(head, cameras, front):
    points, _ = surface_points(front, cameras[0])
    distance = head.scene.compute_distance(points.astype(np.float32)).numpy()
    assert np.quantile(distance, 0.999) < 2e-6


def test_normals_are_unit_and_face_the_camera(cameras, front):
    points, seen = surface_points(front, cameras[0])
    normals = front.normals[seen]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    towards = cameras[0].camera_from_rig.inverse.translation - points
    facing = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    assert np.quantile(facing, 0.02) > -0.2


def test_the_nose_is_in_front_of_its_own_projection(head, cameras, front):
    view = cameras[0]
    nose = view.camera_from_rig.apply(head.keypoints["nose_tip"][None])
    pixel, valid = view.camera.project(nose)
    assert valid.all()
    column, row = np.floor(pixel[0]).astype(int)
    assert abs(front.depth[row, column] - nose[0, 2]) < 0.004


def test_appearance_depends_on_the_view(head, cameras, front):
    # The same points of the face, seen from two sides, have different radiance: highlights and Fresnel.
    points, seen = surface_points(front, cameras[0])
    from_front = front.radiance[seen]
    other = HeadRenderer(head).render(cameras[5].camera, cameras[5].camera_from_rig, 2)
    in_other = cameras[5].camera_from_rig.apply(points)
    pixels, valid = cameras[5].camera.project(in_other)
    inside = valid & (pixels >= 0).all(axis=1) & (pixels < (64, 96)).all(axis=1)
    column, row = np.floor(pixels[inside]).astype(int).T
    visible = np.abs(other.depth[row, column] - in_other[inside, 2]) < 0.002
    change = np.abs(other.radiance[row, column] - from_front[inside])[visible]
    assert visible.sum() > 300
    assert np.median(change) > 0.005


def test_light_comes_from_the_key_and_chin_and_nose_cast_shadows(head):
    # The key stands high on the subject's left: that cheek is brighter, and the skin under the chin darker.
    light = head.surface.irradiance.mean(axis=1)
    points = head.landmarks
    brightness = {
        name: light[np.argmin(((head.surface.vertices - points[index]) ** 2).sum(axis=1))]
        for name, index in {"left cheek": "425", "right cheek": "205", "forehead": "10"}.items()
    }
    below_chin = points["152"] + np.array([0.0, -0.012, -0.030])
    shadow = light[np.argmin(((head.surface.vertices - below_chin) ** 2).sum(axis=1))]
    assert brightness["left cheek"] > brightness["right cheek"]
    assert shadow < 0.6 * brightness["forehead"]


@pytest.mark.parametrize("style", ["short", "side_part", "bob", "long", "curly"])
def test_no_hair_hangs_before_the_eyes(style):
    template = head_template()
    person = replace(sample_identity(SEED, 1), hair_style=style)
    vertices = template.vertices(person.phenotypes, person.controls, person.actions)
    eyes = 0.5 * (template.eyeball(vertices, "left")[0] + template.eyeball(vertices, "right")[0])
    skin = vertices[: template.skin_vertex_count]
    grown = grow_hair(person, template, skin, eyes, np.random.default_rng(0))
    assert grown is not None
    x, y, z = np.moveaxis(grown[0].points - eyes, -1, 0)
    before = (np.abs(x) < 0.042) & (np.abs(y) < 0.012) & (z > 0.0)
    assert len(grown[0]) > 5000
    assert not before.any()
