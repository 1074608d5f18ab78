"""The reader stands alone: what importing and using it loads."""

import subprocess
import sys
from pathlib import Path

import small_heads

ROOT = Path(__file__).parents[2]
# numpy and torch bring these along by themselves.
BARE = "import numpy, torch, google_crc32c, sys; torch.zeros(2).numpy(); "


def modules(code):
    script = f"import sys; sys.path.insert(0, {str(ROOT)!r}); {code}; print('|'.join(sorted(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return {
        name.split(".")[0] if not name.startswith("preface") else name
        for name in result.stdout.strip().split("|")
    }


USE = (
    "from preface.shards import *; data = Dataset({folder!r}); "
    "loader = Loader(data, SingleRays(data.index('train'), seed=0, rays=2000)); batch = loader.batch(0); "
)


def test_reading_needs_nothing_but_numpy_torch_and_the_checksums(tmp_path):
    small_heads.write_dataset(tmp_path, "permuted")
    use = "sys.modules['numba'] = None; " + USE.format(folder=str(tmp_path))
    use += f"assert verify({str(tmp_path)!r}) == []; assert loader.route.startswith('torch (')"
    loaded = modules(BARE + use) - modules(BARE + "sys.modules['numba'] = None")
    others = {name for name in loaded if name not in sys.stdlib_module_names and not name.startswith("_")}
    allowed = ("preface.shards", "preface.artifacts", "preface.plain_words")
    assert {name for name in others if name != "preface" and not name.startswith(allowed)} == set()


def test_numba_is_loaded_only_to_form_batches(tmp_path):
    assert "numba" not in modules("import preface.shards")
    small_heads.write_dataset(tmp_path, "raster")
    loaded = modules(USE.format(folder=str(tmp_path)) + "assert loader.route.startswith('compiled by numba')")
    assert "numba" in loaded


def test_importing_the_builder_loads_neither_capture_nor_align():
    loaded = modules("import preface.shards.writer, preface.shards.building")
    assert not [name for name in loaded if name.startswith(("preface.capture", "preface.align"))]
