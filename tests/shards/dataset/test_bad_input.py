"""What cannot be used is left out with its reason, or stops the build with --strict; never silently, never a crash."""

import json
import shutil
import struct
import zlib
from pathlib import Path

import cv2
import made_up_capture
import numpy as np
import pytest
from made_up_capture import CAMERAS, contents, write_studio
from PIL import Image

from preface.artifacts import sha256
from preface.capture.images import write_exr, write_png
from preface.capture.rig import read_rig, write_rig
from preface.cli.build_shards import main
from preface.shards import Dataset, verify

ROOT = Path(__file__).parents[3]


def photograph(own, person="p1", camera="left"):
    return own.capture / "subjects" / person / f"{camera}.png"


def bomb(path):
    """A PNG of a few bytes whose header promises 65535x65535 pixels."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 65535, 65535, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")
    )


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def saved_by_pillow(mode):
    def save(path):
        image = Image.open(path).convert("RGB").convert(mode)
        image.save(path, format="TIFF" if mode == "CMYK" else "PNG")

    return save


def animated(path):
    image = Image.open(path).convert("RGB")
    image.save(path, format="TIFF", save_all=True, append_images=[image])


def rotated(path):
    image = Image.open(path).convert("RGB")
    exif = Image.Exif()
    exif[0x0112] = 6
    image.save(path, exif=exif)


def of_another_size(path):
    write_png(path, made_up_capture.photograph(0, 0, 60, 80))


BAD = {
    "empty": lambda path: path.write_bytes(b""),
    "no image": lambda path: path.write_bytes(b"no image at all, only some words"),
    "truncated": truncate,
    "CMYK": saved_by_pillow("CMYK"),
    "palette": saved_by_pillow("P"),
    "animated": animated,
    "EXIF-rotated": rotated,
    "another size": of_another_size,
    "header bomb": bomb,
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_photograph_costs_its_view_only(own, tmp_path, kind, capsys):
    path = photograph(own)
    BAD[kind](path)
    assert main(own.arguments(tmp_path / "shards")) == 0
    assert "p1/left is left out: " in capsys.readouterr().err
    assert verify(tmp_path / "shards") == []
    with Dataset(tmp_path / "shards") as dataset:
        assert dataset.tables["view_valid"].tolist() == [[1, 1, 1], [0, 1, 1], [1, 1, 1]]
        entry = dataset.manifest.identities[1]
        assert entry.cameras == (None, *CAMERAS[1:])
        assert set(entry.metadata["left_out"]) == {"left"}
        (told,) = dataset.manifest.provenance["config"]["left_out"]
        assert (told["identity"], told["camera"]) == ("p1", "left")
    assert "p1/left is left out" in (tmp_path / "shards" / "README.md").read_text()


@pytest.mark.parametrize("kind", ["truncated", "another size", "EXIF-rotated"])
def test_strict_stops_at_it(own, tmp_path, kind, capsys):
    BAD[kind](photograph(own))
    assert main(own.arguments(tmp_path / "shards", "--strict")) == 1
    assert "p1.left" in capsys.readouterr().err
    assert not (tmp_path / "shards" / "manifest.json").exists()


def test_16_bit_photographs_and_exr_are_used(own, tmp_path):
    """The same light in 8 bits, 16 bits and as half floats gives the same pixels, to the last bit of 8."""
    eight = cv2.imread(str(photograph(own)), cv2.IMREAD_UNCHANGED)[..., ::-1]
    write_png(photograph(own), eight.astype(np.uint16) * 257)
    middle = photograph(own, camera="middle")
    encoded = cv2.imread(str(middle), cv2.IMREAD_UNCHANGED)[..., ::-1] / 255
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )
    middle.unlink()
    write_exr(middle.with_suffix(".exr"), {name: light[..., c] for c, name in enumerate("RGB")})
    forget_digests(own)
    assert main(own.arguments(tmp_path / "wide")) == 0
    original = write_studio(tmp_path / "original")
    assert main(original.arguments(tmp_path / "narrow")) == 0
    with Dataset(tmp_path / "wide") as wide, Dataset(tmp_path / "narrow") as narrow:
        for view in (0, 1):
            difference = np.abs(wide.pixels(1, view).astype(int) - narrow.pixels(1, view).astype(int))
            assert difference.max() <= 1


def forget_digests(places):
    """Take the photographs' digests out of the alignment, as with landmarks of another program."""
    for path in places.alignment.glob("p*.json"):
        content = json.loads(path.read_text())
        inputs = content["provenance"]["inputs"]
        content["provenance"]["inputs"] = {k: v for k, v in inputs.items() if k.startswith("rigs/")}
        path.write_text(json.dumps(content))


def test_a_photograph_that_changed_since_it_was_aligned(own, tmp_path, capsys):
    write_png(photograph(own), made_up_capture.photograph(7, 7))
    assert main(own.arguments(tmp_path / "shards")) == 0
    assert "p1/left is left out: the photograph has changed since it was aligned" in capsys.readouterr().err
    with Dataset(tmp_path / "shards") as dataset:
        assert dataset.tables["view_valid"][1].tolist() == [0, 1, 1]


def test_a_rig_other_than_the_alignments(own, tmp_path, capsys):
    write_rig(own.rig, _moved(own.rig))
    assert main(own.arguments(tmp_path / "shards")) == 1
    assert "is not the rig that" in capsys.readouterr().err


def _moved(path):
    from dataclasses import replace

    rig = read_rig(path)
    name = CAMERAS[0]
    moved = replace(rig.cameras[name], translation=(0.0, 0.0, 1.1))
    return replace(rig, cameras={**rig.cameras, name: moved})


def test_people_who_are_not_aligned_are_named(tmp_path, capsys):
    places = write_studio(tmp_path / "studio", excluded=("p1",))
    assert main(places.arguments(tmp_path / "shards")) == 0
    assert "p1 is left out: not aligned: only one view shows a face" in capsys.readouterr().err
    with Dataset(tmp_path / "shards") as dataset:
        assert dataset.names == ("p0", "p2")
    assert main(places.arguments(tmp_path / "strict", "--strict")) == 1


@pytest.mark.parametrize("people_per_shard", [1, 2])
def test_a_person_all_of_whose_photographs_are_bad(own, tmp_path, people_per_shard):
    """With one person to a shard, the shard would be empty: the last one takes its number."""
    for camera in CAMERAS:
        truncate(photograph(own, "p0", camera))
    more = ("--identities-per-shard", people_per_shard)
    assert main(own.arguments(tmp_path / "shards", *more)) == 0
    assert verify(tmp_path / "shards") == []
    with Dataset(tmp_path / "shards") as dataset:
        assert sorted(dataset.names) == ["p1", "p2"]
        told = [
            e["identity"] for e in dataset.manifest.provenance["config"]["left_out"] if e["camera"] is None
        ]
        assert told == ["p0"]
    before = contents(tmp_path / "shards")
    assert main(own.arguments(tmp_path / "shards", *more)) == 0
    assert contents(tmp_path / "shards") == before


def test_nobody_left(own, tmp_path, capsys):
    for person in ("p0", "p1", "p2"):
        for camera in CAMERAS:
            truncate(photograph(own, person, camera))
    assert main(own.arguments(tmp_path / "shards")) == 1
    assert "not one of the people can be used" in capsys.readouterr().err
    assert not (tmp_path / "shards" / "manifest.json").exists()


def test_a_missing_photograph_and_a_camera_without_calibration(own, tmp_path, capsys):
    from dataclasses import replace

    photograph(own, "p0", "right").unlink()
    rig = read_rig(own.rig)
    write_rig(own.rig, replace(rig, cameras={name: rig.cameras[name] for name in CAMERAS[1:]}))
    for path in own.alignment.glob("p*.json"):
        content = json.loads(path.read_text())
        content["provenance"]["inputs"]["rigs/take.json"] = sha256(own.rig)
        path.write_text(json.dumps(content))
    assert main(own.arguments(tmp_path / "shards")) == 0
    said = capsys.readouterr().err
    assert "p0/right is left out: there is no photograph" in said
    assert "p0/left is left out: rig.json has no camera 'left'" in said
    with Dataset(tmp_path / "shards") as dataset:
        assert dataset.manifest.views == 2
        assert dataset.tables["view_valid"].tolist() == [[1, 0], [1, 1], [1, 1]]


def test_an_odd_view_is_remarked_on_and_kept(own, tmp_path):
    mask = np.zeros((128, 96), np.uint8)
    write_png(own.capture / "masks/p1/left.png", mask)
    assert main(own.arguments(tmp_path / "shards", "--box", -0.01, -0.01, -0.01, 0.01, 0.01, 0.01)) == 0
    with Dataset(tmp_path / "shards") as dataset:
        remarks = dataset.manifest.identities[1].metadata["remarks"]
    assert "there is no foreground in it" in remarks["left"]
    assert any("lies outside the box" in words for words in remarks["middle"])


# ------------------------------------------------------------------------------------------- names


def with_manifest(own, change):
    path = own.capture / "capture.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


NAMES = ["../p1", "/etc/passwd", "p1\x00", "p1/..", "", "p" * 101]


@pytest.mark.parametrize("name", NAMES)
def test_unsafe_names_of_people_are_refused(own, tmp_path, name, capsys):
    with_manifest(own, lambda content: content["subjects"][1].update(id=name))
    assert main(own.arguments(tmp_path / "shards")) == 1
    assert "subjects[1].id" in capsys.readouterr().err
    assert not (tmp_path / "shards").exists()


@pytest.mark.parametrize("name", ["p0", "P0"])
def test_names_that_clash_are_refused(own, tmp_path, name, capsys):
    with_manifest(own, lambda content: content["subjects"][1].update(id=name))
    assert main(own.arguments(tmp_path / "shards")) == 1
    assert "repeats 'p0'" in capsys.readouterr().err


def test_links_out_of_the_capture_are_refused(own, tmp_path, capsys):
    outside = tmp_path / "outside.png"
    shutil.move(photograph(own), outside)
    photograph(own).symlink_to(outside)
    assert main(own.arguments(tmp_path / "shards")) == 1
    assert "leads out of the folder through a symbolic link" in capsys.readouterr().err


def test_paths_out_of_the_capture_are_refused(own, tmp_path, capsys):
    for path in ("../outside.png", str(tmp_path / "outside.png")):
        with_manifest(own, lambda c, path=path: c["subjects"][1].update(images={"left": path}))
        assert main(own.arguments(tmp_path / "shards")) == 1
        assert "subjects[1].images" in capsys.readouterr().err
