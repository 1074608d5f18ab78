"""Other libraries that feed trainers from files, on the pattern of `shard_reader.py`, which runs this.

Each stores a view as one sample, as these libraries are meant to be used, and a batch is 512 views of which 128
pixels are taken each: 64 identities x 8 of their views, chosen anew for every batch. No rays are formed, which
the shards' full batches do beside it. webdataset reads in the order of its archive, so that its 512 views are the
next 512; the others have random access. All data are uncompressed and lie in the page cache when "hot" is measured;
"cold" is the first batch after the cache was dropped, by a reader opened anew.

None of them is needed to use preface. To measure them, beside an environment that has preface and torch:

    python -m venv --without-pip peers
    python -c "import site; print(site.getsitepackages()[0])" > peers/lib/python3.11/site-packages/preface.pth
    pwd >> peers/lib/python3.11/site-packages/preface.pth
    pip --python peers/bin/python install --no-deps mosaicml-streaming==0.13.0 transformers==5.23.0 regex \\
        huggingface_hub tokenizers httpx2 httpcore2 truststore h11 brotli python-snappy cramjam zstd xxhash \\
        catalogue webdataset==1.0.2 braceexpand zarr==3.1.6 numcodecs donfig litdata==0.2.76 \\
        lightning_utilities boto3 botocore s3transfer jmespath
    peers/bin/python tools/bench/shard_reader.py --peers

(--no-deps, because their dependencies would bring another torch along.)
"""

from __future__ import annotations

import os
import sys
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np

IDENTITIES, VIEWS, RAYS = 64, 8, 128  # of a batch

# A view's bytes (anything with the buffer protocol) by its number, identity * views + view.
Reader = Callable[[int], bytes | np.ndarray]


@dataclass(frozen=True)
class Peer:
    """A library: how its files are written, and how they are opened for reading.

    Attributes:
        package: its distribution.
        write: (folder, samples) to files.
        open: folder to reader.
    """

    package: str
    write: Callable[[Path, Iterator[bytes]], None]
    open: Callable[[Path], Reader]

    @property
    def version(self) -> str:
        """The installed version."""
        return metadata.version(self.package)


class Batches:
    """Batches out of a peer's reader: pixels uint32 [512, 128], by number of the batch."""

    def __init__(self, reader: Reader, people: int, views: int, view_pixels: int):
        self._reader, self._people, self._views, self._pixels = reader, people, views, view_pixels

    def __call__(self, step: int) -> np.ndarray:
        """Read the batch of a step."""
        rng = np.random.default_rng(step)
        people = rng.choice(self._people, min(IDENTITIES, self._people), replace=False)
        rows = []
        for person in people.tolist():
            for view in rng.choice(self._views, min(VIEWS, self._views), replace=False).tolist():
                pixels = np.frombuffer(self._reader(person * self._views + view), np.uint32)
                rows.append(pixels[rng.integers(self._pixels, size=RAYS)])
        return np.stack(rows)


def drop_from_cache(folder: Path) -> None:
    """Write a folder's files to the disk and drop their pages from memory; needs a file system on a disk."""
    for path in (path for path in folder.rglob("*") if path.is_file()):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)


# ----------------------------------------------------------------------------- MosaicML Streaming


def _write_streaming(folder: Path, samples: Iterator[bytes]) -> None:
    _without_torchvision()
    from streaming import MDSWriter  # type: ignore[import-not-found]

    with MDSWriter(out=str(folder), columns={"pixels": "bytes"}) as writer:
        for sample in samples:
            writer.write({"pixels": sample})


def _open_streaming(folder: Path) -> Reader:
    _without_torchvision()
    from streaming import LocalDataset

    dataset = LocalDataset(local=str(folder))
    return lambda number: dataset[number]["pixels"]


def _without_torchvision() -> None:
    """Let `streaming` be imported without torchvision, of whose datasets it needs a base class for its own.

    The registry's torchvision does not load beside a CPU build of torch. Nothing of it is used here.
    """
    names = [f"torchvision{rest}" for rest in ("", ".datasets", ".transforms", ".transforms.functional")]
    for name in (name for name in names if "streaming" not in sys.modules and name not in sys.modules):
        module = types.ModuleType(name)
        module.__spec__, module.__path__ = ModuleSpec(name, None), []
        vars(module).update(VisionDataset=object, to_tensor=None)
        sys.modules[name] = module


# ------------------------------------------------------------------------------------- webdataset


def _write_webdataset(folder: Path, samples: Iterator[bytes]) -> None:
    import webdataset  # type: ignore[import-not-found]

    folder.mkdir()
    with webdataset.TarWriter(str(folder / "data.tar")) as writer:
        for number, sample in enumerate(samples):
            writer.write({"__key__": f"{number:06d}", "bin": sample})


def _open_webdataset(folder: Path) -> Reader:
    import webdataset

    stream = iter(webdataset.WebDataset(str(folder / "data.tar"), shardshuffle=False).repeat())
    return lambda _: next(stream)["bin"]


# ----------------------------------------------------------------------------------- zarr, litdata


def _write_zarr(folder: Path, samples: Iterator[bytes]) -> None:
    import zarr  # type: ignore[import-not-found]

    rows = [np.frombuffer(sample, np.uint8) for sample in samples]
    shape = (len(rows), len(rows[0]))
    array = zarr.create_array(
        store=str(folder), shape=shape, chunks=(1, shape[1]), dtype="u1", compressors=None
    )
    for number, row in enumerate(rows):
        array[number] = row


def _open_zarr(folder: Path) -> Reader:
    import zarr

    array = zarr.open_array(store=str(folder), mode="r")
    return lambda number: np.ascontiguousarray(array[number])


def _write_litdata(folder: Path, samples: Iterator[bytes]) -> None:
    from litdata.streaming.writer import BinaryWriter  # type: ignore[import-not-found]

    folder.mkdir()
    writer = BinaryWriter(str(folder), chunk_bytes=64 * 2**20)
    for number, sample in enumerate(samples):
        writer.add_item(number, {"pixels": sample})
    writer.done()
    writer.merge()


def _open_litdata(folder: Path) -> Reader:
    from litdata import StreamingDataset  # type: ignore[import-not-found]

    dataset = StreamingDataset(str(folder))
    return lambda number: dataset[number]["pixels"]


PEERS = {
    "MosaicML Streaming": Peer("mosaicml-streaming", _write_streaming, _open_streaming),
    "webdataset": Peer("webdataset", _write_webdataset, _open_webdataset),
    "zarr": Peer("zarr", _write_zarr, _open_zarr),
    "litdata": Peer("litdata", _write_litdata, _open_litdata),
}
