"""Disks that take no more: every writer names the file and the remedy, and keeps the previous version."""

import contextlib
import errno
import os
import resource
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest

from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError, read_artifact, write_artifact
from preface.capture.images import write_exr, write_jpeg, write_png
from preface.capture.manifest import CaptureCamera, Manifest, Take, write_capture
from preface.capture.rig import read_rig, write_rig

NOISE = np.random.default_rng(0).integers(0, 256, (64, 48, 3)).astype(np.uint8)
EXAMPLE_RIG = SCHEMA_DIRECTORY / "rig.example.json"
WRITERS = {
    "artefact": ("rig.json", lambda p: write_artifact(p, read_artifact(EXAMPLE_RIG, "preface/rig"))),
    "rig": ("rig.json", lambda p: write_rig(p, read_rig(EXAMPLE_RIG))),
    "capture": (
        "capture.json",
        lambda p: write_capture(p.parent, Manifest((CaptureCamera("front"),), (Take("monday"),), ())),
    ),
    "PNG": ("a.png", lambda p: write_png(p, NOISE)),
    "JPEG": ("a.jpg", lambda p: write_jpeg(p, NOISE, 90)),
    "EXR": ("a.exr", lambda p: write_exr(p, {"Y": NOISE[..., 0].astype(np.float32)})),
}


def fsync_refuses(code):
    @contextlib.contextmanager
    def fault():
        def refuse(descriptor):
            raise OSError(code, os.strerror(code))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "fsync", refuse)
            yield

    return fault


@contextlib.contextmanager
def kernel_cuts_the_write_short():
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


FULL = {
    "full disk": (fsync_refuses(errno.ENOSPC), "Free some space"),
    "quota": (fsync_refuses(errno.EDQUOT), "quota"),
    "broken disk": (fsync_refuses(errno.EIO), "Check the disk"),
    "short write": (kernel_cuts_the_write_short, "file-size limit"),
}


@pytest.mark.parametrize("previous", [None, b"the previous version"])
@pytest.mark.parametrize("fault", FULL)
@pytest.mark.parametrize("writer", WRITERS)
def test_a_failed_write_names_the_file_and_keeps_the_previous_version(tmp_path, writer, fault, previous):
    name, write = WRITERS[writer]
    target = tmp_path / name
    if previous is not None:
        target.write_bytes(previous)
    break_disk, remedy = FULL[fault]
    with break_disk(), pytest.raises(ArtifactError) as caught:
        write(target)
    assert caught.value.path == target
    assert caught.value.field == "writing"
    assert remedy in caught.value.remedy
    assert [path.read_bytes() for path in tmp_path.iterdir()] == ([] if previous is None else [previous])
    write(target)  # and once the disk is well again, it works
    assert target.read_bytes() not in (b"", previous)


@pytest.fixture
def read_only_folder():
    """A folder that this process may not write to, even when the tests run as root."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o555)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)  # nobody
    yield folder
    if user == 0:
        os.seteuid(0)
    folder.chmod(0o755)
    shutil.rmtree(folder)


def test_a_read_only_folder_is_refused_with_the_remedy(read_only_folder):
    with pytest.raises(ArtifactError, match=r"a\.png: writing: permission denied\. Correct the permissions"):
        write_png(read_only_folder / "a.png", NOISE)
    assert list(read_only_folder.iterdir()) == []


UNWRITABLE = {
    "no such folder": ("gone/a.png", "Correct the path"),
    "a file as folder": ("file/a.png", "one of its folders is a file"),
    "a folder as file": ("folder", "names a folder"),
    "a name too long": ("x" * 300, "shorter name"),
}


@pytest.mark.parametrize("name", UNWRITABLE)
def test_a_place_that_cannot_be_written_is_refused_with_the_remedy(tmp_path, name):
    place, remedy = UNWRITABLE[name]
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ArtifactError) as caught:
        write_png(tmp_path / place, NOISE)
    assert caught.value.path == tmp_path / place
    assert remedy in caught.value.remedy
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "folder"]
