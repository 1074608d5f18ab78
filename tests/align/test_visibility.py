"""What the head hides from itself, judged on a real face that is turned."""

import numpy as np
import pytest
from face_pictures import portrait

from preface.align.crops import Picture, Region
from preface.align.keypoints import FACEMESH478
from preface.align.visibility import facing, mesh_triangles, visibility

RIGHT_CHEEK, LEFT_CHEEK, NOSE, RIGHT_EYE_INNER = 50, 280, 1, 133


@pytest.fixture(scope="module")
def face(models):
    """Landmarks [478, 3] of a face from the front, x right, y down, z away from the camera."""
    side = models.model.crop_side
    return models.model.landmarks(Picture(portrait()).crop(Region(np.array([262.0, 240.0]), 320.0), side))


def turned(face, degrees):
    """The face turned about the vertical; positive shows more of the subject's right cheek."""
    angle = np.radians(degrees)
    rotation = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    centre = face.mean(0)
    return (face - centre) @ rotation.T + centre


def test_the_mesh_covers_the_skin_and_is_the_same_on_both_halves():
    triangles = mesh_triangles()
    assert set(triangles.ravel()) == set(range(468))
    given = {frozenset(triangle) for triangle in triangles.tolist()}
    twins = {frozenset(FACEMESH478.mirror[triangle].tolist()) for triangle in triangles}
    assert len(given & twins) > 0.95 * len(given)  # some quadrangles are cut along the other diagonal


def test_from_the_front_almost_everything_is_seen(face):
    seen = visibility(face)
    assert seen[[NOSE, RIGHT_CHEEK, LEFT_CHEEK, 468, 473]].min() > 0.9
    assert (seen > 0.5).mean() > 0.8
    assert ((seen >= 0) & (seen <= 1)).all()


@pytest.mark.parametrize(
    ("degrees", "near", "far"), [(70, RIGHT_CHEEK, LEFT_CHEEK), (-70, LEFT_CHEEK, RIGHT_CHEEK)]
)
def test_from_the_side_the_far_cheek_is_hidden(face, degrees, near, far):
    seen = visibility(turned(face, degrees))
    assert seen[near] > 0.9
    assert seen[far] == 0
    assert facing(turned(face, degrees))[far] < 0


def test_the_nose_hides_the_far_eye_though_that_faces_the_camera(face):
    side = turned(face, -50)  # more of the subject's left
    assert facing(side)[RIGHT_EYE_INNER] > 0.3
    assert visibility(side)[RIGHT_EYE_INNER] == 0


def test_from_behind_no_part_of_the_face_is_seen(face):
    assert (visibility(turned(face, 180))[[NOSE, RIGHT_CHEEK, LEFT_CHEEK]] == 0).all()


def test_size_and_place_do_not_matter(face):
    np.testing.assert_allclose(facing(1e3 * face + 5e4), facing(face), atol=1e-6)
    np.testing.assert_allclose(visibility(1e3 * face), visibility(face), atol=1e-12)
