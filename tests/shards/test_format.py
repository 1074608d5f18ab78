"""The file itself: readable by safetensors, small, aligned, and nothing but its own layout is accepted."""

import json
import struct

import numpy as np
import pytest
import small_heads
from safetensors import safe_open

from preface.artifacts import ArtifactError
from preface.shards import Dataset
from preface.shards.format import PAGE, FormatError, Layout, parse_header, shard_name, shard_number
from preface.shards.shard import Shard
from preface.shards.streams import permutation


def test_safetensors_reads_what_was_written(folder):
    with safe_open(folder / "shard-00000.safetensors", framework="numpy") as file:
        order = file.metadata()["pixel_order"]
        pixels = file.get_tensor("pixels").reshape(3, 4, -1, 4)
        intrinsics, poses = file.get_tensor("intrinsics"), file.get_tensor("canonical_from_camera")
        valid, notes = file.get_tensor("view_valid"), json.loads(file.get_tensor("notes").tobytes())
    for number in range(3):
        head = small_heads.head(number)
        views = 3 if number % 2 else 4
        raster = head.pixels.reshape(4, -1, 4)
        stored = raster if order == "raster" else raster[:, permutation(raster.shape[1])[0]]
        assert np.array_equal(pixels[number, :views], stored[:views])
        assert np.array_equal(intrinsics[number, :views], head.views.intrinsics[:views])
        assert np.array_equal(poses[number, :views], head.views.world_from_camera[:views])
        assert valid[number].tolist() == [1, 1, 1, 1 if views == 4 else 0]
        assert notes["identities"][number]["metadata"] == {"age": 30 + number}
    assert not pixels[1, 3].any()


def test_pixels_start_on_a_page(folder):
    data = (folder / "shard-00001.safetensors").read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    assert length + 8 == PAGE
    assert json.loads(data[8:PAGE])["pixels"]["data_offsets"][0] == 0


def test_the_papers_shards_need_four_bytes_and_a_hundredth_per_ray():
    notes = 64 * 13 * 200  # two hundred bytes of names and sources per view
    layout = Layout(64, 13, 256, 384, "raster", notes)
    assert layout.file_bytes / (64 * 13 * 256 * 384) <= 4.01


def test_foreground_boxes_and_counts_are_those_of_the_mask(folder):
    with Dataset(folder) as dataset:
        for identity in range(len(dataset)):
            for view in np.flatnonzero(dataset.tables["view_valid"][identity]):
                inside = dataset.pixels(identity, view)[:, :, 3] > 0
                y, x = np.nonzero(inside)
                expected = [x.min(), y.min(), x.max() + 1, y.max() + 1]
                assert dataset.tables["foreground_box"][identity, view].tolist() == expected
                assert dataset.tables["foreground_count"][identity, view] == len(x)


def rewritten(page: bytes, change) -> bytes:
    entries = json.loads(page[8:])
    change(entries)
    return page[:8] + json.dumps(entries).encode().ljust(PAGE - 8)


def offsets(name, begin, end):
    return lambda entries: entries[name].update(data_offsets=[begin, end])


LAYOUT = Layout(2, 3, 8, 6, "raster", 100)
HEADER_FAULTS = {
    "overlapping tensors": lambda page: rewritten(page, offsets("box", 0, 96)),
    "overflowing offsets": lambda page: rewritten(page, offsets("notes", 2**63, 2**64)),
    "negative offsets": lambda page: rewritten(page, offsets("box", -8, 88)),
    "huge shape": lambda page: rewritten(page, lambda e: e["pixels"].update(shape=[2**40, 2**40, 8, 6, 4])),
    "negative shape": lambda page: rewritten(page, lambda e: e["pixels"].update(shape=[-2, -3, 8, 6, 4])),
    "digits": lambda page: page[:8] + (b'{"a":' + b"9" * 3000 + b"}").ljust(PAGE - 8),
    "nesting": lambda page: page[:8] + (b"[" * (PAGE - 8)),
    "missing tensor": lambda page: rewritten(page, lambda e: e.pop("box")),
    "other type": lambda page: rewritten(page, lambda e: e["box"].update(dtype="F32")),
    "bomb of a header": lambda page: struct.pack("<Q", 2**62) + page[8:],
    "unknown order": lambda page: rewritten(page, lambda e: e["__metadata__"].update(pixel_order="spiral")),
    "not JSON": lambda page: page[:8] + b"x" * (PAGE - 8),
    "a list": lambda page: page[:8] + b"[]".ljust(PAGE - 8),
    "short": lambda page: page[:100],
}


@pytest.mark.parametrize("fault", HEADER_FAULTS)
def test_headers_that_are_not_a_shards_are_refused(fault):
    page = LAYOUT.header()
    assert parse_header(page, LAYOUT.file_bytes) == LAYOUT
    with pytest.raises(FormatError):
        parse_header(HEADER_FAULTS[fault](page), LAYOUT.file_bytes)


def test_a_file_of_another_size_is_refused():
    with pytest.raises(FormatError, match="bytes"):
        parse_header(LAYOUT.header(), LAYOUT.file_bytes - 1)


def test_names_of_shards():
    assert shard_name(7) == "shard-00007.safetensors"
    assert shard_number("shard-00007.safetensors") == 7
    assert [
        shard_number(n) for n in ("shard-7.safetensors", "../shard-00007.safetensors", "shard-00007.st")
    ] == [None] * 3


def test_a_shard_checks_itself_without_a_manifest(folder):
    with Shard(folder / "shard-00000.safetensors") as shard:
        assert shard.problems() == []
        assert shard.recipe == "recipe"


@pytest.mark.parametrize(
    "change",
    [
        {"identity": "../up"},
        {"identity": "/absolute"},
        {"identity": "nul\0"},
        {"identity": ""},
        {"pixels": np.zeros((4, 20, 25, 4), np.uint8)},
        {"pixels": np.zeros((4, 20, 24, 4), np.uint16)},
        {"backgrounds": ["sky"] * 4},
        {"box": np.array([[0, 0, 0], [1, 1, 0.0]])},
        {"box": np.array([[0, 0, np.nan], [1, 1, 1.0]])},
    ],
    ids=str,
)
def test_heads_that_cannot_be_read_again_are_refused(tmp_path, change):
    with pytest.raises(ArtifactError), small_heads.ShardWriter(tmp_path, 0, (24, 20), "raster", "") as shard:
        shard.add(small_heads.Head(**{**vars(small_heads.head(0)), **change}))
    assert list(tmp_path.iterdir()) == []


def refusal(folder, *heads):
    """What is wrong with the last of these heads."""
    with small_heads.ShardWriter(folder, 0, (24, 20), "raster", "") as shard:
        for head in heads[:-1]:
            shard.add(head)
        with pytest.raises(ArtifactError) as refused:
            shard.add(heads[-1])
        shard.add(small_heads.head(4))
    return str(refused.value)


def test_a_lens_that_folds_inside_the_image_is_refused(tmp_path):
    camera = small_heads.Camera("SIMPLE_RADIAL", 24, 20, [20.0, 12.0, 10.0, -0.9])
    views = small_heads.Views.stack([camera] * 4, [small_heads.Rigid.identity()] * 4)
    head = small_heads.Head(**{**vars(small_heads.head(0)), "views": views})
    assert "folds" in refusal(tmp_path, head)


def test_two_names_that_differ_in_case_only_are_refused(tmp_path):
    other = small_heads.Head(**{**vars(small_heads.head(0)), "identity": "ID0000"})
    assert "upper and lower" in refusal(tmp_path, small_heads.head(0), other)
