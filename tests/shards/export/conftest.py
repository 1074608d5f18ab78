"""Makes the small heads of the folder above importable, and a dataset of them in each pixel order."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))


@pytest.fixture(scope="session", params=["raster", "permuted"])
def folder(request, tmp_path_factory):
    """Five identities of four views in two shards; not to be changed."""
    import small_heads

    folder = tmp_path_factory.mktemp(f"export-{request.param}")
    small_heads.write_dataset(folder, request.param)
    return folder
