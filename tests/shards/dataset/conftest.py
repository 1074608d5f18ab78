"""Makes the helpers beside these tests, and those of alignment, importable; and the studio that the tests share."""

import shutil
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
for folder in (HERE, HERE.parents[1] / "align"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))


@pytest.fixture(scope="session")
def studio(tmp_path_factory):
    """Three people; not to be changed."""
    from made_up_capture import write_studio

    return write_studio(tmp_path_factory.mktemp("studio"))


@pytest.fixture
def own(studio, tmp_path):
    """A studio that may be changed."""
    from made_up_capture import Places

    copy = shutil.copytree(studio.capture.parent, tmp_path / "own")
    return Places(copy / "capture", copy / "rig.json", copy / "alignment")
