"""The demo's script with commands that do nothing: its order, its count of stages, and how it goes on."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[3] / "tools"
COMMANDS = ("align", "build-shards", "calibrate", "evaluate", "fit", "inspect", "render", "train")
# Says what it was asked; fails where a file of its name is beside it.
STUB = '#!/bin/sh\nif [ -e "$0.fails" ]; then exit 1; fi\nif [ "$1" = -c ]; then echo 96x144; fi\n'


@pytest.fixture
def checkout(tmp_path):
    """A checkout of which only demo.sh is real."""
    (tmp_path / "tools").mkdir()
    shutil.copy(TOOLS / "demo.sh", tmp_path / "tools")
    (tmp_path / "tools" / "setup.sh").write_text("")
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("python", *(f"preface-{command}" for command in COMMANDS)):
        (programs / name).write_text(STUB)
        (programs / name).chmod(0o755)
    return tmp_path


def demo(checkout, *words):
    script = ["bash", checkout / "tools" / "demo.sh", *words]
    return subprocess.run(script, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("words", [(), ("--pretrained",)])
def test_every_stage_is_counted_and_the_time_that_is_left_comes_to_nothing(checkout, words):
    run = demo(checkout, *words)
    assert run.returncode == 0, run.stderr
    announced = re.findall(r"== (\d+) of (\d+): (.*), about (\d+) minutes to the end", run.stdout)
    numbers, totals, names, left = zip(*announced, strict=True)
    assert [int(number) for number in numbers] == list(range(1, len(announced) + 1))
    assert {int(total) for total in totals} == {len(announced)}
    assert len(set(names)) == len(names)
    minutes = [int(value) for value in left]
    assert minutes == sorted(minutes, reverse=True)
    assert minutes[0] < 15
    assert minutes[-1] == 0
    assert ("fit, the prior in the box" in names) == (not words)


def test_a_stage_that_failed_is_done_again_and_those_before_it_are_not(checkout):
    trained = checkout / ".venv" / "bin" / "preface-train.fails"
    trained.touch()
    broken = demo(checkout)
    assert broken.returncode == 1
    noted = checkout / "demo_output" / "stages.tsv"
    assert [line.split("\t")[0] for line in noted.read_text().splitlines()][-1] == "shards"
    trained.unlink()
    again = demo(checkout)
    assert again.returncode == 0
    assert again.stdout.count("was done before") == 5
    assert again.stdout.rstrip().endswith("demo_output/report.html")
    names = [line.split("\t")[0] for line in noted.read_text().splitlines()]
    assert len(names) == len(set(names))
