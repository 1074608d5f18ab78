"""The third-party trainer learns from shards where nothing but the reader can be imported."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import small_heads

from preface.artifacts import provenance
from preface.shards.building import build_manifest
from preface.shards.writer import ShardWriter

ROOT = Path(__file__).parents[3]

# What reading may use; everything else that is not part of Python is refused, as are its other packages here.
SCRIPT = """
import sys
import numpy, torch, safetensors, google_crc32c
import torch.optim  # and what torch brings along by itself, before the gate closes
torch.optim.Adam([torch.zeros(1, requires_grad=True)])

class Gate:
    closed = ("preface.capture", "preface.align", "preface.geometry", "preface.model", "preface.cli",
              "preface.reports", "numba", "cv2", "scipy", "PIL", "jsonschema", "matplotlib", "mediapipe", "pycolmap")

    def find_spec(self, name, path=None, target=None):
        if any(name == closed or name.startswith(closed + ".") for closed in self.closed):
            raise ImportError(f"the reader alone must do, and {name} was asked for")
        return None

sys.meta_path.insert(0, Gate())
already = [name for name in sys.modules if name.startswith("preface")]
assert not already, already
sys.path[:0] = ROOTS
from train_elsewhere import train
losses = train(FOLDER, steps=60, device="cpu", identities=2)
print(losses[0], sum(losses[-10:]) / 10)
"""


def write_smooth_heads(folder):
    """Heads whose colours follow from the place in the image, so that there is something to learn."""
    across, down = np.meshgrid(
        np.linspace(0, 255, small_heads.WIDTH), np.linspace(0, 255, small_heads.HEIGHT)
    )
    image = np.stack([across, down, 255 - across, np.full_like(across, 255)], axis=-1).astype(np.uint8)
    with ShardWriter(folder, 0, (small_heads.WIDTH, small_heads.HEIGHT), "raster", "smooth") as shard:
        for number in range(2):
            head = small_heads.head(number)
            head.pixels[:] = image
            shard.add(head)
    build_manifest(folder, 1, {"train": small_heads.NAMES[:2]}, {}, provenance({}, {}))


def test_a_network_learns_with_the_reader_alone(tmp_path):
    write_smooth_heads(tmp_path)
    roots = [str(ROOT), str(ROOT / "tools")]
    script = SCRIPT.replace("ROOTS", repr(roots)).replace("FOLDER", repr(str(tmp_path)))
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    first, last = map(float, result.stdout.split())
    assert last < first / 3
