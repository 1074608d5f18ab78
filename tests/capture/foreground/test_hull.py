"""Masks of one head from all around: which contradicts the others. The head is an ellipsoid drawn exactly."""

import numpy as np
import pytest

from preface.capture.foreground import hull_disagreement
from preface.geometry import Camera, GeometryError, Rigid, Views, cast_rays, pixel_centers

BOX = np.array([[-0.15, -0.2, -0.15], [0.15, 0.2, 0.15]])
RADII = np.array([0.08, 0.12, 0.1])
HEIGHT, WIDTH = 96, 72


def rig(count):
    """Cameras on an arc of 240 degrees, a metre off, that look at the origin."""
    cameras, poses = [], []
    for angle in np.linspace(-2.1, 2.1, count):
        back = np.array([np.sin(angle), 0.15 * (-1) ** len(poses), np.cos(angle)])
        back /= np.linalg.norm(back)
        right = np.cross([0, 1, 0], back)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, -np.cross(back, right), -back], axis=1)
        poses.append(Rigid(rotation, back))
        cameras.append(Camera("PINHOLE", WIDTH, HEIGHT, [170.0, 170.0, WIDTH / 2, HEIGHT / 2]))
    return Views.stack(cameras, poses)


def silhouettes(views):
    """Exact masks of the ellipsoid: a ray meets it where a quadratic has a root."""
    masks = []
    for index in range(len(views.intrinsics)):
        rays = cast_rays(views[index], pixel_centers(WIDTH, HEIGHT))
        o, d = rays.origins / RADII, rays.directions / RADII
        discriminant = (o * d).sum(-1) ** 2 - (d * d).sum(-1) * ((o * o).sum(-1) - 1)
        masks.append((discriminant > 0).astype(np.float32))
    return masks


@pytest.mark.parametrize("count", [3, 5, 13])
def test_right_masks_agree(count):
    views = rig(count)
    found = hull_disagreement(silhouettes(views), views, BOX)
    assert not found.flagged.any()
    assert found.excess.max() < 0.02


def empty(mask):
    mask[:] = 0


def beheaded(mask):
    mask[: HEIGHT // 2] = 0


def everything(mask):
    mask[:] = 1


@pytest.mark.parametrize("spoil", [empty, beheaded, everything])
@pytest.mark.parametrize("which", [0, 4, 9])
def test_the_one_wrong_mask_is_flagged_and_no_other(spoil, which):
    views = rig(13)
    masks = silhouettes(views)
    spoil(masks[which])
    found = hull_disagreement(masks, views, BOX)
    assert np.flatnonzero(found.flagged).tolist() == [which]
    assert np.nanargmax(found.disagreement) == which


def test_two_wrong_masks_are_both_flagged():
    views = rig(13)
    masks = silhouettes(views)
    empty(masks[3])
    beheaded(masks[8])
    assert np.flatnonzero(hull_disagreement(masks, views, BOX).flagged).tolist() == [3, 8]


def test_views_without_masks_are_left_out_and_bytes_serve():
    views = rig(13)
    masks = [np.rint(mask * 255).astype(np.uint8) for mask in silhouettes(views)]
    masks[2], masks[5] = None, np.zeros_like(masks[5])
    found = hull_disagreement(masks, views, BOX)
    assert np.isnan(found.disagreement[2])
    assert np.flatnonzero(found.flagged).tolist() == [5]


def test_two_views_say_nothing():
    views = rig(2)
    found = hull_disagreement(silhouettes(views), views, BOX)
    assert np.isnan(found.disagreement).all()
    assert not found.flagged.any()


def test_wrong_numbers_of_masks_and_empty_boxes_are_refused():
    views = rig(3)
    with pytest.raises(GeometryError, match="2 masks for 3 views"):
        hull_disagreement(silhouettes(views)[:2], views, BOX)
    with pytest.raises(GeometryError, match="box"):
        hull_disagreement(silhouettes(views), views, BOX[::-1])
