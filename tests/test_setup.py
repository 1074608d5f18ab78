"""The set-up: the lock fits the declared ranges, and wrong beginnings are refused with a remedy."""

import re
import shutil
import subprocess
import tomllib
from importlib.metadata import distributions, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOCK = (ROOT / "requirements.lock").read_text()
PINS = {canonicalize_name(n): v for n, v in re.findall(r"^([\w.-]+)==(\S+)$", LOCK, re.MULTILINE)}
EXTRAS = [line for lines in PROJECT["optional-dependencies"].values() for line in lines]


@pytest.mark.parametrize("line", PROJECT["dependencies"] + EXTRAS)
def test_every_declared_dependency_is_locked_to_a_version_in_its_range(line):
    requirement = Requirement(line)
    assert requirement.specifier.contains(PINS[canonicalize_name(requirement.name)])


def test_every_line_of_the_lock_is_one_exact_version():
    lines = [line for line in LOCK.splitlines() if line and not line.startswith("#")]
    assert len(lines) == len(PINS)
    assert not [line for line in lines if "+" in line or "@" in line]
    assert "mediapipe" not in PINS  # its metadata asks for numpy<2: only --no-deps installs it


def test_the_lock_brings_one_opencv_and_so_does_the_environment():
    assert [name for name in PINS if name.startswith("opencv")] == ["opencv-contrib-python-headless"]
    assert len([d for d in distributions() if d.name.lower().startswith("opencv")]) == 1


def test_the_environment_holds_the_mediapipe_that_set_up_names():
    pinned = re.search(r"^mediapipe=mediapipe==(\S+)$", (ROOT / "tools/setup.sh").read_text(), re.MULTILINE)
    assert version("mediapipe") == pinned.group(1)


@pytest.mark.parametrize("script", ["tools/setup.sh", "tools/test.sh", "tools/demo.sh", ".ci/run"])
def test_scripts_parse_and_stop_at_the_first_error(script):
    text = (ROOT / script).read_text()
    assert text.startswith("#!/usr/bin/env bash\n")
    assert "\nset -euo pipefail\n" in text
    subprocess.run(["bash", "-n", ROOT / script], check=True)


def test_a_python_that_does_not_fit_is_refused_before_anything_is_made(tmp_path):
    checkout = tmp_path / "check out"
    (checkout / "tools").mkdir(parents=True)
    for name in ("tools/setup.sh", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, checkout / name)
    environment = {"PATH": "/usr/bin:/bin", "PYTHON": "/bin/false"}
    result = subprocess.run(
        ["bash", checkout / "tools/setup.sh"], env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    assert "3.11" in result.stderr
    assert "/bin/false" in result.stderr
    assert not (checkout / ".venv").exists()
