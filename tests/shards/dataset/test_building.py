"""The dataset as a whole: exact cameras, resumed to the byte, rebuilt when stale, the same by every scheduler."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import made_up_capture
import numpy as np
import pytest
from made_up_capture import CAMERAS, contents

from preface.artifacts import sha256
from preface.capture.images import read_image, write_png
from preface.cli.build_shards import main
from preface.geometry import Views, cast_rays
from preface.shards import Dataset, verify
from preface.shards.dataset.heads import HeadMaker
from preface.shards.dataset.plan import splits

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="session")
def built(studio, tmp_path_factory):
    """The studio's dataset of two shards; not to be changed."""
    folder = tmp_path_factory.mktemp("built") / "shards"
    assert main(studio.arguments(folder, "--identities-per-shard", 2)) == 0
    return folder


def test_the_dataset_is_whole_and_says_where_it_comes_from(studio, built):
    assert verify(built) == []
    with Dataset(built) as dataset:
        assert dataset.names == ("p0", "p1", "p2")
        assert (dataset.manifest.width, dataset.manifest.height, dataset.manifest.views) == (24, 32, 3)
        assert dataset.manifest.scene_scale == 4
        entry = dataset.manifest.identities[1]
        assert entry.cameras == CAMERAS
        assert [s["file"] for s in entry.sources] == [f"subjects/p1/{c}.png" for c in CAMERAS]
        masks = entry.metadata["masks"]
        assert {mask["method"] for mask in masks.values()} == {"given"}
        assert masks["left"]["share"] == pytest.approx((made_up_capture.mask() > 0).mean(), abs=1e-4)
        assert np.abs(dataset.tables["keypoints"] - made_up_capture.made_up_studio.TEMPLATE).max() < 1e-9


def test_pixels_are_means_of_the_photograph_and_its_mask(studio, built):
    """The reduction is 4 to 1: of the sixteen that a pixel covers, those of the foreground count, if any."""
    source = read_image(studio.capture / "subjects/p1/left.png").astype(np.float64) / 255
    light = np.where(source <= 0.04045, source / 12.92, ((source + 0.055) / 1.055) ** 2.4)
    masks = made_up_capture.mask().reshape(32, 4, 24, 4).astype(np.float64)
    mask = masks.mean(axis=(1, 3))
    weights = np.where(mask[:, None, :, None] > 0, masks, 1.0)[..., None]
    mean = (weights * light.reshape(32, 4, 24, 4, 3)).sum(axis=(1, 3)) / weights.sum(axis=(1, 3))
    expected = 255 * np.where(mean <= 0.0031308, mean * 12.92, 1.055 * mean ** (1 / 2.4) - 0.055)
    with Dataset(built) as dataset:
        pixels = dataset.pixels(1, 0).astype(np.float64)
    assert np.abs(pixels[..., :3] - expected).max() <= 0.51
    assert np.abs(pixels[..., 3] - mask).max() <= 0.51


def test_a_ray_of_a_pixel_is_that_of_the_original_camera_through_the_alignment(built):
    """Every pixel's ray, taken back into the rig's frame, starts at the camera and projects to the pixel's place."""
    cameras = made_up_capture.rig().cameras
    y, x = np.mgrid[0:32, 0:24]
    pixels = np.stack([x, y], -1) + 0.5
    with Dataset(built) as dataset:
        for person in range(3):
            rig_from_canonical = made_up_capture.similarity(person).inverse
            for view, name in enumerate(CAMERAS):
                tables = {k: dataset.tables[k][person, view] for k in ("intrinsics", "monotonic_radius")}
                pose = dataset.tables["canonical_from_camera"][person, view]
                rays = cast_rays(Views(world_from_camera=pose, **tables), pixels)
                original = cameras[name]
                start = rig_from_canonical.apply(rays.origins[0, 0])
                assert np.abs(start - original.camera_from_rig.inverse.translation).max() < 1e-6
                for depth in (0.7, 1.0, 1.4):
                    points = rig_from_canonical.apply(rays.origins + depth * rays.directions)
                    seen, valid = original.camera.project(original.camera_from_rig.apply(points))
                    assert valid.all()
                    assert np.abs(seen - 4 * pixels).max() < 0.01


def test_bytes_per_ray_at_a_real_size(studio, tmp_path):
    """96x128 is far smaller than real views, and the tables weigh the more."""
    assert main(studio.arguments(tmp_path / "shards", resolution="96x128")) == 0
    with Dataset(tmp_path / "shards") as dataset:
        small = dataset.bytes_per_ray
        assert small == pytest.approx(4 + _table_bytes(dataset) / (9 * 96 * 128), rel=1e-6)
        assert 4 + _table_bytes(dataset) / (9 * 512 * 768) <= 4.01


def _table_bytes(dataset):
    return sum(shard.layout.file_bytes for shard in dataset.shards) - dataset.pixel_bytes


def test_two_builds_are_the_same_to_the_byte(studio, built, tmp_path):
    assert main(studio.arguments(tmp_path / "again", "--identities-per-shard", 2, "--jobs", 2)) == 0
    assert contents(tmp_path / "again") == contents(built)


def test_a_build_killed_anywhere_is_resumed_to_the_byte(studio, built, tmp_path):
    """Killed as soon as the first bytes are on the disk, and once more when the first shard is there."""
    folder = tmp_path / "shards"
    command = [sys.executable, "-m", "preface.cli.build_shards"]
    command += studio.arguments(folder, "--identities-per-shard", 2)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    for waited_for in (".shard-00000.*.tmp", "shard-00000.safetensors"):
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        while not list(folder.glob(waited_for)) and process.poll() is None:
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert main(studio.arguments(folder, "--identities-per-shard", 2)) == 0
    assert contents(folder) == contents(built)


def test_two_builders_share_the_work_and_end_with_the_same_dataset(studio, built, tmp_path):
    folder = tmp_path / "shards"
    command = [sys.executable, "-m", "preface.cli.build_shards"]
    command += studio.arguments(folder, "--identities-per-shard", 2)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    processes = [subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) for _ in range(2)]
    assert [process.wait() for process in processes] == [0, 0]
    assert verify(folder) == []
    assert {n: b for n, b in contents(folder).items() if not n.endswith(".claim")} == contents(built)


def test_finished_shards_are_kept(studio, built, tmp_path, capsys):
    folder = Path(shutil.copytree(built, tmp_path / "shards"))
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("shard-*")}
    assert main(studio.arguments(folder, "--identities-per-shard", 2)) == 0
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("shard-*")} == before
    assert "2 of them finished before and kept" in capsys.readouterr().out


def test_only_the_shard_of_a_changed_source_is_built_again(own, tmp_path):
    folder = tmp_path / "shards"
    arguments = own.arguments(folder, "--identities-per-shard", 1)
    assert main(arguments) == 0
    before = contents(folder)
    write_png(own.capture / "masks/p1/left.png", 255 - made_up_capture.mask())
    assert main(arguments) == 0
    after = contents(folder)
    changed = {name for name in before if before[name] != after[name]}
    assert "shard-00001.safetensors" in changed
    assert not changed & {"shard-00000.safetensors", "shard-00002.safetensors"}
    assert verify(folder) == []


@pytest.mark.parametrize(
    "more", [("--filter", "bilinear"), ("--pixel-order", "permuted"), ("--framing", "center")]
)
def test_another_configuration_builds_everything_again(own, tmp_path, more):
    folder = tmp_path / "shards"
    assert main(own.arguments(folder)) == 0
    assert main(own.arguments(folder, *more)) == 0
    assert main(own.arguments(tmp_path / "fresh", *more)) == 0
    assert contents(folder) == contents(tmp_path / "fresh")


def test_fewer_people_leave_no_shard_behind(own, tmp_path):
    folder = tmp_path / "shards"
    assert main(own.arguments(folder, "--identities-per-shard", 1)) == 0
    assert main(own.arguments(folder, "--identities-per-shard", 1, "--only", "p0", "p2")) == 0
    assert sorted(path.name for path in folder.glob("shard-*")) == [
        "shard-00000.safetensors",
        "shard-00001.safetensors",
    ]
    assert verify(folder) == []


def test_shards_of_a_job_array_and_a_last_job_equal_one_run(studio, built, tmp_path, capsys):
    folder = tmp_path / "shards"
    arguments = studio.arguments(folder, "--identities-per-shard", 2)
    assert main([*arguments, "--shard", "1"]) == 0
    assert main([*arguments, "--finish"]) == 1
    assert "1 of 2 shards are missing: 0" in capsys.readouterr().err
    assert main([*arguments, "--shard", "0"]) == 0
    assert main([*arguments, "--shard", "2"]) == 1
    assert main([*arguments, "--finish"]) == 0
    assert contents(folder) == contents(built)


def test_dask_builds_the_same_dataset(studio, built, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    arguments = studio.arguments(tmp_path / "shards", "--identities-per-shard", 2, "--scheduler", "dask")
    assert main(arguments) == 0
    assert contents(tmp_path / "shards") == contents(built)


def test_splits_hold_out_whom_they_should(studio, tmp_path):
    def held_out(*who):
        assert main(studio.arguments(tmp_path / "shards", "--holdout", *who)) == 0
        with Dataset(tmp_path / "shards") as dataset:
            found = dataset.manifest.splits
        assert sorted((*found["train"], *found["holdout"])) == ["p0", "p1", "p2"]
        return set(found["holdout"])

    assert held_out("p2", "p0") == {"p0", "p2"}
    assert len(held_out("1")) == len(held_out("33%")) == len(held_out("0.33")) == 1
    assert held_out("1") == held_out("1")
    by_seed = {held_out("1", "--seed", str(seed)).pop() for seed in range(8)}
    assert len(by_seed) > 1


@pytest.mark.parametrize("seed", range(4))
def test_the_expressions_of_a_person_are_all_on_one_side(seed):
    persons = {f"p{person}-{frame}": f"p{person}" for person in range(5) for frame in range(3)}
    divided = splits([*persons, "alone"], ["2"], seed, Path("capture"), persons)
    sides = {side: {persons.get(name, name) for name in names} for side, names in divided.items()}
    assert not sides["train"] & sides["holdout"]
    assert len(sides["holdout"]) == 2
    assert sorted([*divided["train"], *divided["holdout"]]) == sorted([*persons, "alone"])


def test_the_papers_of_a_dataset(built):
    card = (built / "README.md").read_text()
    assert "3 heads in 9 posed views of 24x32 pixels" in card
    assert "| views with foreground by `given` | 9 |" in card
    described = json.loads((built / "croissant.json").read_text())
    manifest = json.loads((built / "manifest.json").read_text())
    digests = {entry["name"]: entry["sha256"] for entry in described["distribution"]}
    assert digests == {shard["file"]: shard["sha256"] for shard in manifest["shards"]}
    assert "9 photographs" in (built / "masks.html").read_text()
    assert [row["identities/identity"] for row in described["recordSet"][0]["data"]] == ["p0", "p1", "p2"]


def test_the_template_goes_with_the_shards(studio, built):
    """Whoever is fitted later by a prior of these shards is placed on it."""
    assert (built / "template.json").read_bytes() == (studio.alignment / "template.json").read_bytes()
    inputs = json.loads((built / "manifest.json").read_text())["provenance"]["inputs"]
    assert inputs["alignment/template.json"] == sha256(built / "template.json")


def test_photographs_of_one_person_become_a_dataset(own, tmp_path):
    """As `preface-align photos` leaves them: a folder of photographs, each a camera of the rig by its name."""
    photographs = own.capture / "subjects" / "p1"
    shutil.copy(photographs / "left.png", photographs / "unused.png")
    made_up_capture.align(own, ["p1"])
    words = own.arguments(tmp_path / "shards", "--masks", own.capture / "masks" / "p1")
    assert main([str(photographs), *words[1:]]) == 0
    assert verify(tmp_path / "shards") == []
    with Dataset(tmp_path / "shards") as dataset:
        (entry,) = dataset.manifest.identities
        assert (entry.identity, entry.cameras) == ("p1", CAMERAS)
        assert [source["file"] for source in entry.sources] == [f"{camera}.png" for camera in CAMERAS]
        assert {mask["method"] for mask in entry.metadata["masks"].values()} == {"given"}
        (told,) = dataset.manifest.provenance["config"]["left_out"]
        assert (told["camera"], told["reason"]) == ("unused", "rig.json has no camera 'unused'")


def test_a_photograph_that_is_written_to_meanwhile_stops_the_build(own, tmp_path, monkeypatch, capsys):
    made = HeadMaker.make

    def make_and_touch(self, person, cameras, digests):
        head = made(self, person, cameras, digests)
        write_png(own.capture / "subjects/p1/left.png", made_up_capture.photograph(5, 5))
        return head

    monkeypatch.setattr(HeadMaker, "make", make_and_touch)
    assert main(own.arguments(tmp_path / "shards")) == 1
    assert "changed while it was read" in capsys.readouterr().err
    assert not list((tmp_path / "shards").glob("shard-*"))
