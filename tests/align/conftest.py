"""Makes the drawn scenes and the face pictures importable, and loads the face models once for all tests."""

import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))


@pytest.fixture(scope="session")
def models():
    """MediaPipe's face models, the shipped ones."""
    from preface.align.facemesh import FaceModels

    return FaceModels(None)
