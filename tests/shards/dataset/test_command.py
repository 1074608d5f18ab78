"""The command itself: what it refuses, what it says, and how `preface-inspect` shows and verifies its dataset."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from preface.cli import inspect
from preface.cli.build_shards import main

ROOT = Path(__file__).parents[3]


def test_dry_run_writes_nothing_and_says_what_it_would_take(own, tmp_path, capsys):
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert main(own.arguments(tmp_path / "shards", "--dry-run", "--identities-per-shard", 2)) == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    printed = capsys.readouterr().out
    assert "3 identities, 9 views" in printed
    assert "2 shards (0 to 1) of 42.2 kB in all" in printed


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--resolution", "24x30"), "24x30 has another aspect than the photograph's 96x128"),
        (("--resolution", "192x256"), "larger than the photograph"),
        (("--only", "p7"), "there is no 'p7'"),
        (("--holdout", "3"), "leave nobody for training"),
        (("--holdout", "p0", "nobody"), "there is no 'nobody'"),
    ],
)
def test_impossible_wishes_are_refused(own, tmp_path, more, words, capsys):
    assert main(own.arguments(tmp_path / "shards", *more)) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "shards").exists()


@pytest.mark.parametrize(
    "more",
    [
        ("--resolution", "24"),
        ("--foreground", "magic"),
        ("--foreground", "onnx"),
        ("--dask-address", "tcp://nowhere:1"),
        ("--shard", "0", "--finish"),
        ("--box", "0", "0", "0", "1", "1", "0"),
        ("--white", "0"),
        ("--masks", "somewhere"),
    ],
)
def test_wrong_usage_is_exit_status_2(own, tmp_path, more):
    with pytest.raises(SystemExit) as stopped:
        main(own.arguments(tmp_path / "shards", *more))
    assert stopped.value.code == 2


def test_a_folder_of_other_things_is_not_written_to(own, tmp_path, capsys):
    (tmp_path / "shards").mkdir()
    (tmp_path / "shards" / "README.md").write_text("mine")
    assert main(own.arguments(tmp_path / "shards")) == 1
    assert "holds other things than a dataset" in capsys.readouterr().err
    assert (tmp_path / "shards" / "README.md").read_text() == "mine"


def test_help_does_not_wait_for_numpy():
    script = (
        "import sys; from preface.cli.build_shards import _parser; _parser(); print('numpy' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.strip() == "False"


# ----------------------------------------------------------------------------------------- inspect


@pytest.fixture
def dataset(own, tmp_path):
    """A dataset that may be damaged."""
    assert main(own.arguments(tmp_path / "shards", "--identities-per-shard", 2, "--holdout", "p1")) == 0
    return tmp_path / "shards"


def test_inspect_shows_a_dataset(dataset, capsys):
    capsys.readouterr()
    assert inspect.main([str(dataset), "--json"]) == 0
    (shown,) = json.loads(capsys.readouterr().out)["artifacts"]
    assert shown["schema"] == "preface/shards"
    summary = shown["summary"]
    assert summary["identities"] == ["p0", "p1", "p2"]
    assert summary["splits"] == {"train": 2, "holdout": 1}
    assert summary["views"] == 9
    assert summary["shards"] == 2
    assert summary["scene_scale"] == 4


def test_inspect_shows_one_shard(dataset, capsys):
    assert inspect.main([str(dataset / "shard-00001.safetensors")]) == 0
    assert "1: p2" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["shard-00000.safetensors", "shard-00001.safetensors", "manifest.json"])
def test_inspect_finds_a_flipped_bit_wherever_it_is(dataset, name, capsys):
    data = bytearray((dataset / name).read_bytes())
    data[len(data) // 2] ^= 16
    (dataset / name).write_bytes(data)
    assert inspect.main([str(dataset)]) == 1
    assert str(dataset / name) in capsys.readouterr().err
    if name.startswith("shard"):
        assert inspect.main([str(dataset / name)]) == 1


def test_inspect_of_an_unfinished_dataset(dataset, capsys):
    (dataset / "manifest.json").unlink()
    assert inspect.main([str(dataset)]) == 1
    assert "building was not finished" in capsys.readouterr().err
