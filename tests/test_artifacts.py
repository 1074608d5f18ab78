"""Artefacts: exact round trips, faults injected at every point of a write, schemas and their examples."""

import contextlib
import errno
import json
import math
import multiprocessing
import os
import pickle
import resource
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from preface.artifacts import (
    MAX_JSON_BYTES,
    SCHEMA_DIRECTORY,
    ArtifactError,
    known_schemas,
    load_json,
    provenance,
    read_artifact,
    resolve_inside,
    sha256,
    write_artifact,
    write_bytes,
)

RIG = json.loads((SCHEMA_DIRECTORY / "rig.example.json").read_text())


def a_rig(**changes):
    return {**json.loads(json.dumps(RIG)), **changes}


# ------------------------------------------------------------------------------- exact round trips


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1))
def test_float64_survives_writing_and_reading_bit_for_bit(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("floats") / "rig.json"
    write_artifact(path, a_rig(metadata={"values": np.array(values)}))
    again = read_artifact(path, "preface/rig")["metadata"]["values"]
    assert [struct.pack("d", value) for value in again] == [struct.pack("d", value) for value in values]


def test_extreme_float64_survive():
    extremes = [5e-324, 2.2250738585072014e-308, 1.7976931348623157e308, -0.0, 0.1 + 0.2, 1 / 3, math.pi]
    assert [struct.pack("d", v) for v in json.loads(json.dumps(extremes))] == [
        struct.pack("d", v) for v in extremes
    ]


def test_writing_what_was_read_gives_the_same_bytes(tmp_path):
    first = write_artifact(tmp_path / "a.json", RIG).read_bytes()
    second = write_artifact(
        tmp_path / "b.json", read_artifact(tmp_path / "a.json", "preface/rig")
    ).read_bytes()
    assert first == second


def test_numpy_arrays_and_scalars_are_written_as_their_values(tmp_path):
    values = {"array": np.arange(6.0).reshape(2, 3), "scalar": np.float32(0.1), "count": np.int64(3)}
    write_artifact(tmp_path / "rig.json", a_rig(metadata=values))
    again = read_artifact(tmp_path / "rig.json", "preface/rig")["metadata"]
    assert again == {
        "array": [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]],
        "scalar": float(np.float32(0.1)),
        "count": 3,
    }


def test_written_files_keep_a_vector_on_one_line(tmp_path):
    text = write_artifact(tmp_path / "rig.json", a_rig(metadata={"row": [1 / 3] * 30})).read_text()
    assert max(text.splitlines(), key=len).count("0.333") == 30
    assert len(text.splitlines()) > 10


def test_a_byte_order_mark_is_accepted(tmp_path):
    (tmp_path / "rig.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(RIG).encode())
    assert read_artifact(tmp_path / "rig.json", "preface/rig") == RIG


def test_names_beyond_ascii_survive(tmp_path):
    write_artifact(tmp_path / "rig.json", a_rig(metadata={"Büro": "撮影"}))
    assert read_artifact(tmp_path / "rig.json", "preface/rig")["metadata"] == {"Büro": "撮影"}
    assert "撮影" in (tmp_path / "rig.json").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("value", "field"),
    [
        (math.nan, "metadata.value"),
        (-math.inf, "metadata.value"),
        ([0.0, [1.0, math.inf]], "metadata.value[1][1]"),
        (np.array([1.0, np.nan]), "metadata.value[1]"),
        ({1: "one"}, "metadata.value"),
        (b"bytes", "metadata.value"),
        (Path("x"), "metadata.value"),
        ("lone \ud800 surrogate", "metadata.value"),
    ],
)
def test_what_json_cannot_hold_is_refused_on_writing(tmp_path, value, field):
    with pytest.raises(ArtifactError) as caught:
        write_artifact(tmp_path / "rig.json", a_rig(metadata={"value": value}))
    assert caught.value.field == field
    assert list(tmp_path.iterdir()) == []


def test_an_invalid_artefact_is_not_written(tmp_path):
    with pytest.raises(ArtifactError, match="units: is 'inch'"):
        write_artifact(tmp_path / "rig.json", a_rig(units="inch"))
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------- faults at every point

OLD, NEW = b"old content", b"new content, which is longer than the old"


def assert_whole(path: Path, contents: tuple[bytes, ...]) -> None:
    assert path.read_bytes() in contents
    assert [p.name for p in path.parent.iterdir()] == [path.name], "a temporary file was left behind"


@pytest.fixture
def target(tmp_path):
    path = tmp_path / "artefact"
    path.write_bytes(OLD)
    return path


@contextlib.contextmanager
def file_size_limit(size: int):
    """Let the kernel refuse to write a file beyond `size` bytes: a genuine short write, then EFBIG."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("accepted", range(len(NEW)))
def test_a_write_that_the_kernel_cuts_short_leaves_the_old_content(target, accepted):
    with file_size_limit(accepted), pytest.raises(ArtifactError, match="artefact: writing: file too large"):
        write_bytes(target, NEW)
    assert_whole(target, (OLD,))


def failing(function, *, at: int, error: BaseException):
    """`function`, except that call number `at` (from 0) raises `error`; it counts in `.calls`."""

    def call(*args, **kwargs):
        call.calls += 1
        if call.calls - 1 == at:
            raise error
        return function(*args, **kwargs)

    call.calls = 0
    return call


STEPS = [("fsync", 0), ("replace", 0), ("open", 0), ("fsync", 1)]
FAULTS = [OSError(code, os.strerror(code)) for code in (errno.ENOSPC, errno.EIO, errno.EDQUOT, errno.EROFS)]


@pytest.mark.parametrize("error", FAULTS, ids=lambda e: errno.errorcode[e.errno])
@pytest.mark.parametrize(("step", "at"), STEPS, ids=["fsync file", "rename", "open folder", "fsync folder"])
def test_a_failing_system_call_leaves_old_or_new_content_whole(target, monkeypatch, step, at, error):
    replacement = failing(getattr(os, step), at=at, error=error)
    with monkeypatch.context() as patch:
        patch.setattr(os, step, replacement)
        with pytest.raises(ArtifactError) as caught:
            write_bytes(target, NEW)
    assert replacement.calls == at + 1, "the fault was not reached"
    assert caught.value.path == target
    assert caught.value.field == "writing"
    assert_whole(target, (OLD,) if (step, at) in STEPS[:2] else (NEW,))


@pytest.mark.parametrize(("step", "at"), STEPS[:2])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError()], ids=["ctrl-c", "memory"])
def test_an_interruption_leaves_the_old_content(target, monkeypatch, step, at, error):
    with monkeypatch.context() as patch:
        patch.setattr(os, step, failing(getattr(os, step), at=at, error=error))
        with pytest.raises(type(error)):
            write_bytes(target, NEW)
    assert_whole(target, (OLD,))


def test_file_systems_that_cannot_sync_folders_are_accepted(target, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", failing(os.fsync, at=1, error=OSError(errno.EINVAL, "Invalid argument")))
        write_bytes(target, NEW)
    assert_whole(target, (NEW,))


def _write_and_die(path: Path, step: str, at: int) -> None:
    original, calls = getattr(os, step), iter(range(100))
    setattr(os, step, lambda *a, **k: os._exit(9) if next(calls) == at else original(*a, **k))
    write_bytes(path, NEW)


@pytest.mark.parametrize(("step", "at"), STEPS)
def test_a_process_killed_at_any_step_leaves_old_or_new_content_whole(target, step, at):
    child = multiprocessing.get_context("fork").Process(target=_write_and_die, args=(target, step, at))
    child.start()
    child.join()
    assert child.exitcode == 9, "the step was not reached"
    assert target.read_bytes() == (OLD if (step, at) in STEPS[:2] else NEW)


def test_the_content_is_on_the_disk_before_it_takes_the_name(target, monkeypatch):
    log = []
    for name in ("fsync", "replace"):
        original = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, _n=name, _o=original, **k: (log.append(_n), _o(*a, **k))[1])
    write_bytes(target, NEW)
    assert log == ["fsync", "replace", "fsync"]


@pytest.fixture
def tiny_disk(tmp_path):
    """A real file system of 64 KiB."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    mounted = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True, check=False
    )
    if not mounted or mounted.returncode:
        pytest.skip("mounting a file system needs root")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_full_disk_keeps_the_previous_version(tiny_disk):
    path = tiny_disk / "rig.json"
    before = write_artifact(path, RIG).read_bytes()
    with pytest.raises(ArtifactError) as caught:
        write_artifact(path, a_rig(metadata={"much": list(range(100_000))}))
    assert "no space left on device. Free some space" in str(caught.value)
    assert_whole(path, (before,))


def test_writing_through_an_open_reader_does_not_disturb_it(target):
    with target.open("rb") as reader:
        write_bytes(target, NEW)
        assert reader.read() == OLD


def test_new_files_obey_the_umask(tmp_path):
    previous = os.umask(0o027)
    try:
        assert write_bytes(tmp_path / "file", NEW).stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(previous)


# ---------------------------------------------------------------------------------------- schemas


def schema_files():
    return sorted(SCHEMA_DIRECTORY.glob("*.schema.json"))


def test_the_installed_schemas_are_those_of_the_checkout():
    top = Path(__file__).parents[1] / "data_specs"
    assert {p.name: p.read_text() for p in top.glob("*.json")} == {
        p.name: p.read_text() for p in SCHEMA_DIRECTORY.glob("*.json")
    }
    assert {"preface/capture", "preface/rig"} <= set(known_schemas())


@pytest.mark.parametrize("file", schema_files(), ids=lambda p: p.name)
def test_each_schema_is_itself_valid_and_has_a_page(file):
    schema = json.loads(file.read_text())
    Draft202012Validator.check_schema(schema)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert file.with_name(file.name.replace(".schema.json", ".md")).is_file()


@pytest.mark.parametrize("name", known_schemas())
def test_each_example_validates(name):
    read_artifact(SCHEMA_DIRECTORY / f"{name.removeprefix('preface/')}.example.json", name)


def _objects_with_properties(node, place="$"):
    if isinstance(node, dict):
        if isinstance(node.get("properties"), dict):
            yield place, node
        for key, child in node.items():
            yield from _objects_with_properties(child, f"{place}.{key}")
    elif isinstance(node, list):
        for index, child in enumerate(node):
            yield from _objects_with_properties(child, f"{place}[{index}]")


@pytest.mark.parametrize("name", ["capture", "rig"])  # the formats that people write by hand
def test_each_property_is_described_and_unknown_keys_are_refused(name):
    schema = json.loads((SCHEMA_DIRECTORY / f"{name}.schema.json").read_text())
    for place, node in _objects_with_properties(schema):
        if place.endswith((".if", ".then", ".else")):
            continue  # these constrain properties that are described where they are defined
        assert node["additionalProperties"] is False, place
        for key, prop in node["properties"].items():
            target = schema["$defs"][prop["$ref"].removeprefix("#/$defs/")] if "$ref" in prop else {}
            description = prop.get("description") or target.get("description", "")
            assert len(description) > 10, f"{place}.{key}"


# ------------------------------------------------------------------------------ the rest of the API


def test_provenance_is_the_same_twice_and_validates(tmp_path):
    (tmp_path / "input.bin").write_bytes(b"abc")
    block = provenance({"noise": 0.1}, {"input": tmp_path / "input.bin"}, seed=3)
    assert block == provenance({"noise": 0.1}, {"input": tmp_path / "input.bin"}, seed=3)
    assert block["inputs"] == {"input": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"}
    assert block["versions"]["numpy"] == np.__version__
    write_artifact(tmp_path / "rig.json", a_rig(provenance=block))
    assert read_artifact(tmp_path / "rig.json", "preface/rig")["provenance"] == block


def test_a_missing_input_is_named(tmp_path):
    with pytest.raises(ArtifactError, match=r"gone: file: no such file"):
        sha256(tmp_path / "gone")


def test_paths_inside_the_folder_are_joined_to_it(tmp_path):
    assert resolve_inside(tmp_path / "capture.json", "x", "a/./b.png") == tmp_path / "a/b.png"


def test_a_symbolic_link_within_the_folder_is_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    assert resolve_inside(tmp_path / "capture.json", "x", "link/b.png") == tmp_path / "link/b.png"


def test_an_error_is_one_readable_line():
    error = ArtifactError(
        "capture.json", "subjects[3].take", "'take7' is not one of the takes (a)", "Correct it"
    )
    assert str(error) == "capture.json: subjects[3].take: 'take7' is not one of the takes (a). Correct it."


def test_an_error_shows_no_control_codes():
    assert "\x1b" not in str(ArtifactError("a\x1b[31m.json", "x\n", "b\x07", "c"))
    assert len(str(ArtifactError("a", "x\ny", "b\r\nc", "d")).splitlines()) == 1


def test_an_error_survives_the_way_from_a_worker_process():
    error = pickle.loads(pickle.dumps(ArtifactError("a.json", "x", "is wrong", "Correct it")))
    assert (error.path, error.field, error.remedy) == (Path("a.json"), "x", "Correct it")


def test_the_size_limit_is_checked_before_parsing(tmp_path):
    path = tmp_path / "huge.json"
    with path.open("wb") as file:
        file.truncate(MAX_JSON_BYTES + 1)
    with pytest.raises(ArtifactError, match="larger than 64 MiB"):
        load_json(path)
