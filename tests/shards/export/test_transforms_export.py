"""A nerfstudio folder, read by a reader that knows nothing of preface, against the shards' own rays."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_heads

from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError, provenance
from preface.geometry import Camera, Rigid, Views
from preface.shards import Dataset, Loader, Pick
from preface.shards.building import build_manifest
from preface.shards.export.selection import select
from preface.shards.export.transforms import export_transforms, images_bytes
from preface.shards.writer import ShardWriter

sys.path.insert(0, str(Path(__file__).parent))
import nerfstudio_reader

VIEWS = ["camera0", "camera1", "camera3"]  # camera2 has k4


class WholeView:
    """All pixels of one view."""

    groups = 1

    def __init__(self, index, identity, view):
        self.index, self.identity, self.view = index, np.array([identity]), np.array([view])

    def pick(self, step, rank, world) -> Pick:
        pixels = np.arange(self.index.width * self.index.height)
        return self.index.pick(self.identity, self.view, pixels[None])


def exported(folder, output, scale=1.0, images="rgba", views=VIEWS, identities=None):
    with Dataset(folder) as dataset:
        chosen = select(dataset, identities, views)
        return chosen, export_transforms(dataset, chosen, output, scale, images)


@pytest.mark.parametrize("scale", [1.0, 4.5])
def test_rays_of_the_folder_are_those_of_the_shards(folder, tmp_path, scale):
    chosen, paths = exported(folder, tmp_path / "out", scale)
    worst, seen = 0.0, 0
    with Dataset(folder) as dataset:
        for person, path in zip(chosen.people, paths, strict=True):
            frames, content = nerfstudio_reader.frames(path.parent)
            assert content["applied_scale"] == scale
            assert list(frames) == [f"images/{camera}.png" for camera in person.cameras]
            for view, frame in zip(person.views, frames.values(), strict=True):
                loader = Loader(dataset, WholeView(dataset.index(), person.number, view), scale=scale)
                batch = loader.batch(0)
                shape = (frame["h"], frame["w"], -1)
                origins, directions = (
                    t.view(shape).double().numpy() for t in (batch.origins, batch.directions)
                )
                theirs, their_directions = nerfstudio_reader.rays(frame)
                assert np.abs(origins - theirs).max() < 1e-6 * scale
                assert np.abs(directions - their_directions).max() < 1e-6
                # The point that a ray of the shard sees at 1 m, in nerfstudio's camera.
                pixels = nerfstudio_reader.projected(frame, origins + directions * scale)
                across, down = np.meshgrid(np.arange(frame["w"]) + 0.5, np.arange(frame["h"]) + 0.5)
                worst = max(worst, float(np.abs(pixels - np.stack([across, down], -1)).max()))
                seen += 1
    assert seen == 5 * 3 - 2  # two identities lack camera3
    assert worst < 0.01


@pytest.mark.parametrize("images", ["rgba", "rgb"])
def test_images_and_masks_are_the_pixels_of_the_shards(folder, tmp_path, images):
    chosen, paths = exported(folder, tmp_path / "out", images=images, identities=["id0001"])
    frames, _ = nerfstudio_reader.frames(paths[0].parent)
    truth = small_heads.head(1).pixels
    for view, frame in zip(chosen.people[0].views, frames.values(), strict=True):
        pixels, mask = nerfstudio_reader.image(paths[0].parent, frame)
        whole = pixels if images == "rgba" else np.concatenate([pixels, mask[..., None]], axis=-1)
        np.testing.assert_array_equal(whole, truth[view])
    masks = paths[0].parent / "masks"
    assert masks.is_dir() == (images == "rgb")


def test_noise_takes_no_more_than_the_size_that_is_stated(folder, tmp_path):
    for images in ("rgba", "rgb"):
        chosen, _ = exported(folder, tmp_path / images, images=images)
        size = sum(path.stat().st_size for path in (tmp_path / images).rglob("*") if path.is_file())
        assert size <= images_bytes(chosen)


def test_a_lens_that_nerfstudio_cannot_express_is_refused_before_anything_is_written(folder, tmp_path):
    with pytest.raises(ArtifactError) as caught:
        exported(folder, tmp_path / "out", views=["camera0", "camera2"])
    assert caught.value.field == "id0000.camera2"
    assert "k4 0.2" in caught.value.problem
    assert "--undistort" in caught.value.remedy
    assert "--format rays" in caught.value.remedy
    assert not (tmp_path / "out").exists()


def test_a_scene_is_whole_or_not_there(tmp_path):
    shards = tmp_path / "shards"
    shards.mkdir()
    small_heads.write_dataset(shards, "raster")
    file = shards / "shard-00000.safetensors"
    data = bytearray(file.read_bytes())
    view_bytes = small_heads.WIDTH * small_heads.HEIGHT * 4
    data[4096 + view_bytes * (small_heads.VIEWS + 1) + 5] ^= 1  # the second identity's second view
    file.write_bytes(data)
    with pytest.raises(ArtifactError, match=r"id0001\.camera1"):
        exported(shards, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["id0000"]


def test_a_third_radial_coefficient_survives(tmp_path):
    truth = small_heads.head(0)
    lens = [40.0, 41.0, 12.3, 9.8, 0.12, -0.3, 2e-3, -1e-3, 0.4, 0, 0, 0]
    camera = Camera("FULL_OPENCV", small_heads.WIDTH, small_heads.HEIGHT, np.array(lens))
    poses = [Rigid.from_matrix(matrix) for matrix in truth.views.world_from_camera]
    with ShardWriter(tmp_path, 0, (small_heads.WIDTH, small_heads.HEIGHT), "raster", "r") as shard:
        shard.add(replace(truth, views=Views.stack([camera] * len(poses), poses)))
    build_manifest(tmp_path, 1, {"train": ["id0000"]}, {}, provenance({}, {}))
    _, paths = exported(tmp_path, tmp_path / "out", views=None)
    frames, _ = nerfstudio_reader.frames(paths[0].parent)
    for matrix, frame in zip(truth.views.world_from_camera, frames.values(), strict=True):
        points = matrix[:, 3] + (np.random.default_rng(0).normal(size=(9, 3)) * (0.1, 0.1, 0) + (0, 0, 1)) @ (
            matrix[:, :3].T
        )
        expected, valid = camera.project((points - matrix[:, 3]) @ matrix[:, :3])
        assert valid.all()
        assert np.abs(nerfstudio_reader.projected(frame, points) - expected).max() < 1e-9


def test_the_page_s_example_has_the_keys_of_a_real_folder_and_describes_them(folder, tmp_path):
    page = (SCHEMA_DIRECTORY / "transforms.md").read_text()
    example = json.loads(page.split("```json")[1].split("```")[0])
    _, (path, *_) = exported(folder, tmp_path / "out", images="rgb")
    _, content = nerfstudio_reader.frames(path.parent)
    assert list(example) == list(content)
    assert list(example["preface"]) == list(content["preface"])
    assert {*example["frames"][0], "mask_path"} == {*content["frames"][0]}
    named = {*content, *content["frames"][0], *content["preface"]}
    assert named <= set(re.findall(r"`(\w+)`", page))
