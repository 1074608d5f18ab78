"""Faults: no flipped bit goes unnoticed, no write leaves half a file, a killed build is finished to the byte."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import small_heads
from small_heads import write_dataset, write_shard

from preface.artifacts import ArtifactError
from preface.shards import Dataset, Loader, SingleRays, read_manifest, verify
from preface.shards.building import claim, is_finished
from preface.shards.checksums import NO_DIGEST, text_digest
from preface.shards.format import PAGE
from preface.shards.manifest import write_manifest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def copy(folder, tmp_path):
    """A dataset that may be damaged."""
    return Path(shutil.copytree(folder, tmp_path / "shards"))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def flip(path, byte, bit):
    data = bytearray(path.read_bytes())
    data[byte] ^= 1 << bit
    path.write_bytes(data)


def test_a_dataset_as_written_verifies(folder):
    assert verify(folder) == []


def test_every_flipped_bit_is_found(copy):
    rng = np.random.default_rng(0)
    files = sorted(copy.iterdir())
    assert [f.name for f in files] == ["manifest.json", "shard-00000.safetensors", "shard-00001.safetensors"]
    for file in files:
        original = file.read_bytes()
        for region in (range(min(PAGE, len(original))), range(len(original))):
            for _ in range(25):
                flip(file, region[rng.integers(len(region))], rng.integers(8))
                assert verify(copy) != []
                file.write_bytes(original)
    assert verify(copy) == []


def test_a_flipped_pixel_is_never_read(copy):
    """At first touch, in every placement, before a batch comes out."""
    flip(copy / "shard-00000.safetensors", PAGE + 5 * 24 * 20 * 4 + 77, 3)  # identity 1, view 1
    with Dataset(copy) as dataset:
        with pytest.raises(ArtifactError, match=r"id0001\.camera1.*checksum"):
            Loader(dataset, SingleRays(dataset.index(), seed=0), placement="ram")
        with pytest.raises(ArtifactError, match="checksum"):
            Loader(dataset, SingleRays(dataset.index(), seed=0), placement="mmap").batch(0)
        with pytest.raises(ArtifactError, match="checksum"):
            dataset.pixels(1, 1)
        Loader(dataset, SingleRays(dataset.index().only([0]), seed=0), placement="mmap").batch(0)


def test_truncation_at_every_page_is_found(copy):
    for file in sorted(copy.glob("shard-*")):
        size = file.stat().st_size
        original = file.read_bytes()
        for length in [0, 1, 8, *range(PAGE, size, PAGE), size - 1]:
            os.truncate(file, length)
            assert verify(copy) != []
            with pytest.raises(ArtifactError, match=file.name):
                Dataset(copy)
            file.write_bytes(original)


def test_a_shard_that_shrinks_while_mapped_is_an_error_and_no_crash(copy):
    script = f"""
import os, sys
sys.path.insert(0, {str(ROOT)!r})
from preface.artifacts import ArtifactError
from preface.shards import Dataset, Loader, SingleRays
dataset = Dataset({str(copy)!r})
loader = Loader(dataset, SingleRays(dataset.index(), seed=0), placement="mmap")
loader.batch(0)
os.truncate({str(copy / "shard-00000.safetensors")!r}, 4096)
for use in (lambda: loader.batch(1), lambda: dataset.pixels(0, 0)):
    try:
        use()
    except ArtifactError as error:
        print("refused:", error.problem)
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("refused:") == 2


def rewrite(copy, **changes):
    """Change the manifest and give it the digest that fits."""
    payload = json.loads((copy / "manifest.json").read_text())
    payload.update(changes)
    text = json.dumps({**payload, "digest": NO_DIGEST}).encode()
    (copy / "manifest.json").write_bytes(text.replace(NO_DIGEST.encode(), text_digest(text)[1].encode()))


def test_manifests_from_the_future_say_upgrade(copy):
    rewrite(copy, schema_version=2)
    with pytest.raises(ArtifactError, match="Upgrade preface"):
        read_manifest(copy)


@pytest.mark.parametrize(
    "file", ["../shard-00000.safetensors", "/etc/passwd", "shard-00001.safetensors", "a\0"]
)
def test_manifests_cannot_name_other_files(copy, file):
    shards = json.loads((copy / "manifest.json").read_text())["shards"]
    shards[0]["file"] = file
    rewrite(copy, shards=shards)
    with pytest.raises(ArtifactError):
        Dataset(copy)


def test_links_out_of_the_folder_are_refused(copy, tmp_path):
    (copy / "shard-00000.safetensors").rename(tmp_path / "elsewhere")
    (copy / "shard-00000.safetensors").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ArtifactError, match="symbolic link"):
        Dataset(copy)


def test_a_shard_of_another_dataset_is_refused(copy, tmp_path):
    write_shard(tmp_path, 0, read_manifest(copy).pixel_order, recipe="other")
    (tmp_path / "shard-00000.safetensors").replace(copy / "shard-00000.safetensors")
    with pytest.raises(ArtifactError, match="manifest"):
        Dataset(copy)


@pytest.mark.parametrize(
    "changes",
    [
        {"splits": {"train": []}},
        {"shards": []},
        {"box": [[0, 0, 0], [0, 0, 0]]},
        {"views": 3},
        {"splits": None},
    ],
    ids=str,
)
def test_manifests_that_contradict_themselves_are_refused(copy, changes):
    rewrite(copy, **changes)
    with pytest.raises(ArtifactError):
        Dataset(copy)


# --------------------------------------------------------------------------------------------- writing


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    write_dataset(folder, "raster")
    return contents(folder)


FAILING = {"write": "pwrite", "fsync": "fsync", "rename": "replace", "open": "open"}


@pytest.mark.parametrize("call", FAILING)
def test_every_nth_call_that_fails_leaves_nothing_and_the_next_run_finishes(
    call, reference, tmp_path, monkeypatch
):
    real = getattr(os, FAILING[call])
    for nth in range(1, 60):
        count = 0

        def failing(*arguments, nth=nth, **options):
            nonlocal count
            count += 1
            if count == nth:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return real(*arguments, **options)

        folder = tmp_path / f"{call}{nth}"
        folder.mkdir()
        monkeypatch.setattr(os, FAILING[call], failing)
        problem = ""
        try:
            write_dataset(folder, "raster")
        except ArtifactError as error:
            problem = str(error)
        monkeypatch.setattr(os, FAILING[call], real)
        assert ("space" in problem) == (count >= nth)
        assert not list(folder.glob(".*.tmp"))
        for name, data in contents(folder).items():  # what has its name is whole
            assert name.endswith(".claim") or data == reference[name]
        write_dataset(folder, "raster")
        assert contents(folder) == reference
        if not problem:
            assert nth > 1
            return
    raise AssertionError("the build makes more calls than this test tries")


def test_short_writes_are_continued(reference, tmp_path, monkeypatch):
    real = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda file, data, at: real(file, data[: max(1, len(data) // 3)], at))
    write_dataset(tmp_path, "raster")
    assert contents(tmp_path) == reference


def test_builders_killed_at_any_moment_are_finished_to_the_byte(reference, tmp_path):
    rng = np.random.default_rng(1)
    begin = time.perf_counter()
    write_dataset(tmp_path, "raster")
    duration = time.perf_counter() - begin
    for number in range(40):
        folder = tmp_path / str(number // 4)
        folder.mkdir(exist_ok=True)
        builder = os.fork()
        if builder == 0:
            try:
                write_dataset(folder, "raster")
            finally:
                os._exit(0)
        time.sleep(rng.uniform(0, duration))
        os.kill(builder, signal.SIGKILL)
        os.waitpid(builder, 0)
        for name, data in contents(folder).items():
            assert name.startswith(".") or data == reference[name]
    for number in range(10):
        write_dataset(tmp_path / str(number), "raster")
        assert contents(tmp_path / str(number)) == reference


def test_a_finished_shard_is_kept_and_a_damaged_one_or_another_recipe_is_not(tmp_path):
    write_dataset(tmp_path, "raster")
    shard = tmp_path / "shard-00000.safetensors"
    before = shard.stat().st_mtime_ns
    assert is_finished(tmp_path, 0, "recipe")
    write_dataset(tmp_path, "raster")
    assert shard.stat().st_mtime_ns == before
    flip(shard, PAGE + 100, 0)
    assert not is_finished(tmp_path, 0, "recipe")
    assert not (tmp_path / "manifest.json").exists()
    write_dataset(tmp_path, "raster")
    assert not is_finished(tmp_path, 0, "another recipe")
    assert not shard.exists()


def test_a_shard_is_claimed_by_one_at_a_time(tmp_path):
    (tmp_path / ".shard-00000.safetensors.0123.tmp").write_bytes(b"left by a killed writer")
    with claim(tmp_path, 0) as first:
        assert first
        assert not list(tmp_path.glob("*.tmp"))
        (tmp_path / ".shard-00000.safetensors.4567.tmp").write_bytes(b"being written")
        with claim(tmp_path, 0) as second, claim(tmp_path, 1) as other:
            assert (second, other) == (False, True)
        assert list(tmp_path.glob(".*.tmp"))
    with claim(tmp_path, 0) as again:
        assert again


def test_two_writers_and_eight_readers_of_one_folder(tmp_path):
    """Readers see a whole dataset or none, while two builders race."""
    stop, wrong, seen = threading.Event(), [], []

    def read():
        while not stop.is_set():
            try:
                with Dataset(tmp_path) as dataset:
                    seen.append(np.array_equal(dataset.pixels(2, 1), small_heads.head(2).pixels[1]))
            except ArtifactError as error:
                if "manifest.json" not in str(error):
                    wrong.append(error)

    readers = [threading.Thread(target=read) for _ in range(8)]
    for reader in readers:
        reader.start()
    writers = [threading.Thread(target=write_shard, args=(tmp_path, n, "raster")) for n in (0, 0, 1, 1)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    write_dataset(tmp_path, "raster")
    deadline = time.monotonic() + 20
    while not seen and time.monotonic() < deadline:
        time.sleep(0.01)
    stop.set()
    for reader in readers:
        reader.join()
    assert wrong == []
    assert seen
    assert all(seen)


def test_a_key_called_digest_cannot_fool_the_digest(tmp_path, reference):
    payload = json.loads(reference["manifest.json"])
    payload.pop("digest")
    payload["configuration"] = {"digest": NO_DIGEST}
    with pytest.raises(ArtifactError, match="digest"):
        write_manifest(tmp_path, payload)
