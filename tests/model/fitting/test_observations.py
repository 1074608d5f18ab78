"""The views of a fit: found by name, in the prior's space, with a head to be seen in them."""

from dataclasses import replace

import ball_heads
import numpy as np
import pytest

from preface.artifacts import ArtifactError, provenance
from preface.geometry import Rigid
from preface.model.fitting.observations import PixelGrids, grids, observe, view_numbers
from preface.model.training.prior_files import read_prior
from preface.shards import Dataset
from preface.shards.building import build_manifest
from preface.shards.writer import ShardWriter


def write(folder, head):
    """Shards of one head."""
    folder.mkdir()
    with ShardWriter(folder, 0, (ball_heads.WIDTH, ball_heads.HEIGHT), "raster", "one") as shard:
        shard.add(head)
    build_manifest(folder, 1, {"all": [head.identity]}, {}, provenance({}, {}))
    return folder


def refused(shards, identity, cameras, prior=None):
    with Dataset(shards) as dataset, pytest.raises(ArtifactError) as caught:
        observe(dataset, identity, cameras, prior)
    return str(caught.value)


def test_views_are_those_named_in_their_order_and_the_others_are_held_out(balls):
    with Dataset(balls) as dataset:
        data = observe(dataset, "id0001", ("camera4", "camera2"), None)
        assert data.names == ("id0001",)
        assert data.train.pairs.tolist() == [[1, 2], [1, 4]]
        assert view_numbers(data, ("camera4", "camera2")).tolist() == [[1, 4], [1, 2]]
        assert data.held_out_names == {"id0001": ("camera0", "camera1", "camera3", "camera5")}
        np.testing.assert_array_equal(data.scene.box, ball_heads.BOX)
        assert data.scene.resolution == (ball_heads.WIDTH, ball_heads.HEIGHT)


def test_the_only_identity_need_not_be_named(tmp_path):
    with Dataset(write(tmp_path / "one", ball_heads.head(2))) as dataset:
        assert observe(dataset, None, ("camera0",), None).names == ("id0002",)


def test_names_that_are_unknown_are_refused_with_the_nearest(balls):
    assert "knows no 'id003'. Perhaps 'id0003'" in refused(balls, "id003", ("camera0",))
    assert "4 identities, and none was chosen" in refused(balls, None, ("camera0",))
    words = refused(balls, "id0003", ("camera0", "kamera5"))
    assert "'id0003' has no view of a camera 'kamera5'" in words
    assert "'camera5' was meant" in words


def test_a_view_that_an_identity_has_not_is_refused(tmp_path):
    head = ball_heads.head(0)
    cameras = [*head.cameras[:-1], None]
    shards = write(tmp_path / "one", replace(head, cameras=cameras, sources=[*head.sources[:-1], None]))
    assert "no view of a camera 'camera5', but 5 others" in refused(shards, None, ("camera0", "camera5"))


def test_shards_of_another_box_are_refused_with_the_box_to_build_them_with(balls, prior, tmp_path):
    other = write(tmp_path / "one", replace(ball_heads.head(0), box=ball_heads.BOX * 1.5))
    words = refused(other, None, ("camera0",), read_prior(prior))
    assert "box" in words
    assert "--box -0.13 -0.15 -0.13 0.13 0.15 0.13" in words
    with Dataset(balls) as dataset:
        assert observe(dataset, "id0003", ("camera0",), read_prior(prior)).scene.scene_scale == pytest.approx(
            1 / 0.15
        )


def test_views_without_foreground_are_refused_by_name(tmp_path):
    head = ball_heads.head(0)
    head.pixels[3, :, :, 3] = 0
    shards = write(tmp_path / "one", head)
    assert "view camera3 of 'id0000' has no foreground" in refused(shards, None, ("camera0", "camera3"))
    with Dataset(shards) as dataset:
        observe(dataset, None, ("camera0", "camera5"), None)


@pytest.mark.parametrize("where", ["turned away", "behind"])
def test_cameras_whose_foreground_is_not_in_the_box_are_refused(tmp_path, where):
    head = ball_heads.head(0)
    poses = ball_heads.poses()
    about = np.diag([-1.0, 1.0, -1.0])
    pose = poses[1]
    center = pose.translation + np.array([float(where == "turned away"), 0, 0])
    poses[1] = Rigid(pose.rotation if where == "turned away" else pose.rotation @ about, center)
    views = type(head.views).stack([camera_of(head)] * len(poses), poses)
    shards = write(tmp_path / "one", replace(head, views=views))
    assert "camera1 of 'id0000' sees its foreground outside the box" in refused(shards, None, ("camera1",))


def camera_of(head):
    from preface.geometry import Camera

    return Camera("FULL_OPENCV", ball_heads.WIDTH, ball_heads.HEIGHT, head.views.intrinsics[0])


@pytest.mark.parametrize("side", [1, 5, 64])
def test_grids_are_spread_over_the_image(balls, side):
    with Dataset(balls) as dataset:
        data = observe(dataset, "id0000", ("camera0", "camera3"), None)
        pick = PixelGrids(data.train, data.train.pairs, side).pick(1, 0, 1)
        y, x = np.divmod(pick.pixel[0], ball_heads.WIDTH)
        assert pick.view.tolist() == [3]
        assert len(np.unique(x)) == min(side, ball_heads.WIDTH)
        assert len(np.unique(y)) == min(side, ball_heads.HEIGHT)
        assert abs(x.mean() + 0.5 - ball_heads.WIDTH / 2) <= 0.5
        assert abs(y.mean() + 0.5 - ball_heads.HEIGHT / 2) <= 0.5
        assert len(grids(data, side)) == 2
