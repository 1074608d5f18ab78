"""Explicit rays against the slow and obvious ones of `preface.geometry`, in float64."""

import json
import re

import numpy as np
import pytest
import small_heads
from safetensors import safe_open

from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError
from preface.geometry import Box, Views, cast_rays, pixel_centers
from preface.shards import Dataset
from preface.shards.export import rays as rays_module
from preface.shards.export.rays import BYTES_PER_RAY, export_rays, rays_bytes
from preface.shards.export.selection import select


def exported(folder, output, scale=1.0, identities=None, views=None):
    with Dataset(folder) as dataset:
        chosen = select(dataset, identities, views)
        return chosen, export_rays(dataset, chosen, output, "metre", scale)


def tensors(path):
    with safe_open(path, "np") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118


@pytest.mark.parametrize("scale", [1.0, 4.5])
def test_every_ray_is_the_one_that_the_camera_sees(folder, tmp_path, scale, monkeypatch):
    monkeypatch.setattr(rays_module, "_CHUNK", 77)  # not a divisor of a view's pixels
    _, paths = exported(folder, tmp_path / "out", scale)
    assert [path.name for path in paths] == [f"{name}.safetensors" for name in small_heads.NAMES]
    for number, path in enumerate(paths):
        head = small_heads.head(number)
        found, metadata = tensors(path)
        views = [view for view, name in enumerate(head.cameras) if name]
        assert json.loads(metadata["cameras"]) == [head.cameras[view] for view in views]
        assert found["origins"].shape == (len(views), small_heads.HEIGHT, small_heads.WIDTH, 3)
        box = Box(*(head.box * scale))
        np.testing.assert_allclose(json.loads(metadata["box"]), head.box * scale)
        for place, view in enumerate(views):
            camera: Views = head.views[view]
            truth = cast_rays(camera, pixel_centers(small_heads.WIDTH, small_heads.HEIGHT))
            origins = truth.origins * scale
            near, far, hit = box.intersect(origins, truth.directions)
            assert np.abs(found["origins"][place] - origins).max() < 1e-6 * scale
            assert np.abs(found["directions"][place] - truth.directions).max() < 1e-6
            assert np.abs(found["viewdirs"][place] - truth.viewdirs).max() < 1e-6
            np.testing.assert_allclose(found["radii"][place], truth.radii, rtol=2e-5)
            np.testing.assert_array_equal(found["hit"][place][..., 0], hit)
            for name, depth in (("near", near), ("far", far)):
                np.testing.assert_allclose(found[name][place][..., 0][hit], depth[hit], rtol=1e-5)
            np.testing.assert_array_equal(np.rint(found["rgba"][place] * 255), head.pixels[view])


def test_only_the_chosen_identities_and_views_are_written(folder, tmp_path):
    names = ["camera3", "camera1"]
    chosen, paths = exported(folder, tmp_path / "out", identities=["id0001", "id0002"], views=names)
    assert [path.stem for path in paths] == ["id0001", "id0002"]
    assert json.loads(tensors(paths[0])[1]["cameras"]) == ["camera1"]  # its camera3 is missing
    assert json.loads(tensors(paths[1])[1]["cameras"]) == ["camera1", "camera3"]
    assert chosen.notes == ("id0001 has no view camera3",)


def test_the_size_that_is_stated_is_the_size_that_is_written(folder, tmp_path):
    chosen, paths = exported(folder, tmp_path / "out", views=["camera0"])
    size = sum(path.stat().st_size for path in paths)
    assert rays_bytes(chosen) - 4096 * len(paths) < size <= rays_bytes(chosen)
    assert BYTES_PER_RAY == 68


def test_the_page_describes_every_tensor_and_every_text_of_a_file(folder, tmp_path):
    _, paths = exported(folder, tmp_path / "out")
    found, metadata = tensors(paths[0])
    of_tensors, of_texts = (SCHEMA_DIRECTORY / "rays.md").read_text().split("\nThe file's metadata")
    rows = re.findall(r"^\| (`[^|]+`) \| \[V, H, W, (\d)\] \|", of_tensors, re.MULTILINE)
    described = {name: int(columns) for names, columns in rows for name in re.findall(r"\w+", names)}
    assert described == {name: tensor.shape[-1] for name, tensor in found.items()}
    assert {str(tensor.dtype) for tensor in found.values()} == {"float32"}
    assert set(re.findall(r"^\| `(\w+)` \|", of_texts, re.MULTILINE)) == set(metadata)
    assert metadata["format"] in of_texts


@pytest.mark.parametrize(
    ("identities", "views", "field"),
    [(["id9999"], None, "identities"), (None, ["camera9"], "views"), (["id0001"], ["camera3"], "views")],
)
def test_names_that_the_dataset_does_not_have_are_refused(folder, identities, views, field):
    with Dataset(folder) as dataset, pytest.raises(ArtifactError) as caught:
        select(dataset, identities, views)
    assert caught.value.field == field


def test_a_folder_with_files_is_not_mixed_with_rays(folder, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ArtifactError, match="not empty"):
        exported(folder, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_damaged_view_is_never_exported(tmp_path):
    (tmp_path / "shards").mkdir()
    small_heads.write_dataset(tmp_path / "shards", "raster")
    shard = tmp_path / "shards" / "shard-00000.safetensors"
    data = bytearray(shard.read_bytes())
    data[4096 + 17] ^= 4
    shard.write_bytes(data)
    with pytest.raises(ArtifactError, match=r"id0000\.camera0"):
        exported(tmp_path / "shards", tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []
