"""Makes the modules beside the tests importable, and a small dataset in each pixel order."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session", params=["raster", "permuted"])
def folder(request, tmp_path_factory):
    """Five identities of four views in two shards; not to be changed."""
    import small_heads

    folder = tmp_path_factory.mktemp(request.param)
    small_heads.write_dataset(folder, request.param)
    return folder
