"""The ray dataset: pixels and cameras of many heads, exact, compact, verifiable, and read at memory's speed.

Reading needs numpy, torch, safetensors' layout (not even the package) and google-crc32c, and nothing of the
pipeline that made the shards:

    from preface.shards import Dataset, Loader, PaperPattern

    dataset = Dataset("shards/")
    sampler = PaperPattern(dataset.index("train"), seed=7)
    loader = Loader(dataset, sampler, device="cuda", scale=dataset.manifest.scene_scale)
    for step, batch in loader.batches(start=0, stop=1000):
        batch.origins, batch.directions, batch.rgb, batch.identity      # float32 [n, 3], ..., int64 [n]

`format` says what is in a file, `manifest` what is in a folder. Writing (`writer`, `building`) also needs
`preface.geometry` and is imported only where it is used.
"""

from preface.shards.batches import Batch
from preface.shards.format import BACKGROUND_KINDS
from preface.shards.loader import Loader, Pixels, Placement
from preface.shards.manifest import Manifest, read_manifest
from preface.shards.reader import Dataset, verify
from preface.shards.samplers import PaperPattern, Patches, Pick, Sampler, SingleRays, ViewIndex

__all__ = [
    "BACKGROUND_KINDS",
    "Batch",
    "Dataset",
    "Loader",
    "Manifest",
    "PaperPattern",
    "Patches",
    "Pick",
    "Pixels",
    "Placement",
    "Sampler",
    "SingleRays",
    "ViewIndex",
    "read_manifest",
    "verify",
]
