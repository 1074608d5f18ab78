"""How fast shards are read, against what this machine's memory can do, measured in the same run.

    python tools/bench/shard_reader.py [--peers] [--folder DIR] [--threads 1]

Synthesises datasets from noise, with distorting lenses and without, and prints:
- the limit: the best of `torch.index_select` and `np.take` gathering 4-byte pixels at random places, out of
  the same array that the reader gathers from, into memory that is there already;
- the paper's pattern (128 rays x 8 views x 64 identities of 64x13x256x384): pixels alone, picks, full batches;
- 8,192 rays of three views of 4096x4096;
- the first epoch from a cold page cache, raster and permuted (needs the right to drop a file's pages);
- with --peers, MosaicML Streaming and webdataset on the same pattern, where they are installed.

Medians and minima over many repetitions. It needs 1.5 GB of disk; run it on a quiet machine.
"""

from __future__ import annotations

import argparse
import io
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch

from preface.artifacts import provenance
from preface.geometry import Camera, Rigid, Views
from preface.shards import Dataset, Loader, PaperPattern, Pick, Pixels, Placement, SingleRays
from preface.shards.building import build_manifest
from preface.shards.format import PixelOrder
from preface.shards.writer import Head, ShardWriter

BOX = np.array([[-0.15, -0.2, -0.15], [0.15, 0.2, 0.15]])
PAPER = (64, 13, 384, 256)  # identities, views, width, height
DISTORTION = {"pinhole": [0.0, 0.0, 0.0, 0.0], "distorted": [-0.1, 0.05, 1e-3, -1e-3]}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peers", action="store_true", help="measure peers too, where they are installed")
    parser.add_argument("--folder", type=Path, help="where to put the data; a temporary folder by default")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--repeats", type=int, default=100, help="of each measurement")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        root = Path(name)
        full = 0.0
        for lens in DISTORTION:
            full = paper_pattern(write(root / lens, PAPER, "raster", lens), lens, arguments.repeats)
        large = write(root / "large", (1, 3, 4096, 4096), "raster", "distorted")
        single_head(large, arguments.repeats)
        write(root / "permuted", PAPER, "permuted", "distorted")
        for order, folder in (("raster", root / "distorted"), ("permuted", root / "permuted")):
            for check in (True, False):
                cold_epoch(folder, order, check)
        if arguments.peers:
            peers(root, root / "distorted", full)


def write(folder: Path, shape: tuple[int, int, int, int], order: PixelOrder, lens: str) -> Path:
    """Write a dataset of noise: identities, views, width, height."""
    identities, views, width, height = shape
    folder.mkdir()
    rng = np.random.default_rng(0)
    cameras, poses = [], []
    for angle in np.linspace(-1.2, 1.2, views):
        right, down, forward = (
            (np.cos(angle), 0, -np.sin(angle)),
            (0, -1, 0),
            (-np.sin(angle), 0, -np.cos(angle)),
        )
        rotation = np.stack([right, down, forward], axis=1)
        focal = 2.2 * width
        params = np.array([focal, focal, width / 2, height / 2, *DISTORTION[lens]])
        cameras.append(Camera("OPENCV", width, height, params))
        poses.append(Rigid(rotation, -rotation[:, 2]))
    stacked = Views.stack(cameras, poses)
    names = [f"id{number:04d}" for number in range(identities)]
    with ShardWriter(folder, 0, (width, height), order, "noise") as shard:
        for name in names:
            pixels = rng.integers(0, 256, (views, height, width, 4), dtype=np.uint8)
            cameras_of = [f"camera{view:02d}" for view in range(views)]
            unknown = (["unknown"] * views, [None] * views)
            shard.add(Head(name, "take", cameras_of, stacked, pixels, BOX, np.zeros((5, 3)), *unknown))
    build_manifest(folder, 1, {"train": names}, {}, provenance({}, {}, seed=0))
    return folder


def timed(work: Callable[[int], object], repeats: int) -> tuple[float, float]:
    """Median and minimum of the seconds that work(0), work(1), ... take, after a warm-up."""
    for step in range(3):
        work(step)
    seconds = []
    for step in range(repeats):
        begin = time.perf_counter()
        work(step)
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds)), min(seconds)


def report(what: str, seconds: tuple[float, float], rays: int, limit: float | None) -> None:
    """Print one line."""
    share = f"{limit / seconds[0]:8.2f} of the limit" if limit else ""
    print(
        f"{what:<50}{seconds[0] * 1e3:9.3f} ms (min {seconds[1] * 1e3:.3f}) {rays / seconds[0] / 1e6:8.1f} M/s{share}"
    )


def gather_limit(pixels: torch.Tensor, rays: int, repeats: int) -> float:
    """Seconds that gathering `rays` random pixels takes, by the faster of two libraries."""
    index = torch.randint(0, len(pixels), (repeats, rays), generator=torch.Generator().manual_seed(0))
    out = torch.empty(rays, dtype=torch.int32)
    arrays = pixels.numpy(), index.numpy(), out.numpy()
    by_torch = timed(lambda i: torch.index_select(pixels, 0, index[i], out=out), repeats)
    by_numpy = timed(lambda i: np.take(arrays[0], arrays[1][i], out=arrays[2], mode="clip"), repeats)
    report("limit: torch.index_select(out=)", by_torch, rays, None)
    report("limit: np.take(out=, mode='clip')", by_numpy, rays, None)
    return min(by_torch[0], by_numpy[0])


def _gather(pixels: Pixels, picks: Sequence[Pick], step: int) -> torch.Tensor:
    return pixels.gather(picks[step])


def paper_pattern(folder: Path, lens: str, repeats: int) -> float:
    """The paper's batches from memory and from the mapped file; returns seconds of a full batch from memory."""
    with Dataset(folder) as dataset:
        print(f"\npaper's pattern, {lens}, {dataset.bytes_per_ray:.4f} bytes per ray on disk")
        sampler = PaperPattern(dataset.index("train"), seed=0)
        rays, full = sampler.groups * sampler.rays, 0.0
        placements: tuple[Placement, ...] = ("mmap", "ram")
        for placement in placements:
            loader = Loader(dataset, sampler, placement=placement)
            pixels = loader.pixels.sources[0]
            for step in range(40):  # every view has been touched
                loader.batch(step)
            print(f"placement {placement}:")
            limit = gather_limit(pixels, rays, repeats)
            picks = [sampler.pick(step, 0, 1) for step in range(repeats)]
            report(
                "pixels alone",
                timed(partial(_gather, loader.pixels, picks), repeats),
                rays,
                limit,
            )
            report("picks alone", timed(lambda i: sampler.pick(i, 0, 1), repeats), rays, limit)
            seconds = timed(loader.batch, repeats)
            report("full batches", seconds, rays, limit)
            full = seconds[0]
        return full


def single_head(folder: Path, repeats: int) -> None:
    """8,192 rays of three large views."""
    with Dataset(folder) as dataset:
        print("\n8,192 rays of three views of 4096x4096, target 1 ms")
        for share in (0.0, 0.5):
            sampler = SingleRays(dataset.index(), seed=0, foreground_share=share)
            loader = Loader(dataset, sampler, placement="ram")
            report(
                f"full batches, foreground share {share}", timed(loader.batch, repeats), sampler.rays, None
            )


def cold_epoch(folder: Path, order: str, check: bool) -> None:
    """Steps of the paper's pattern until each pixel has been drawn once on average, from a cold page cache."""
    for path in folder.glob("shard-*"):
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)
    with Dataset(folder) as dataset:
        sampler = PaperPattern(dataset.index("train"), seed=0)
        loader = Loader(dataset, sampler, placement="mmap", check=check)
        steps = dataset.pixel_bytes // 4 // (sampler.groups * sampler.rays)
        begin = time.perf_counter()
        loader.batch(0)
        first = time.perf_counter() - begin
        for step in range(1, steps):
            loader.batch(step)
        whole = time.perf_counter() - begin
    checks = "checked at first touch" if check else "unchecked"
    print(f"cold, {order}, {checks}: first batch {first * 1e3:.1f} ms, epoch of {steps} steps {whole:.2f} s")


# ------------------------------------------------------------------------------------------------ peers


def peers(root: Path, folder: Path, ours: float) -> None:
    """The same pattern through libraries that store a view as a sample: read 512 views, take 128 pixels of each."""
    print("\npeers: 512 views read and 128 pixels of each taken, no rays formed")
    for name, measure in (("streaming", _streaming), ("webdataset", _webdataset)):
        try:
            seconds = measure(root / name, folder)
        except ImportError as error:
            print(f"{name}: not installed ({error})")
            continue
        print(f"{name:<50}{seconds * 1e3:9.1f} ms per batch, {seconds / ours:.0f} times our full batch")


def _samples(folder: Path) -> list[bytes]:
    with Dataset(folder) as dataset:
        views = range(dataset.manifest.views)
        return [dataset.pixels(i, v).tobytes() for i in range(len(dataset)) for v in views]


def _taken(samples: Callable[[int], bytes], count: int) -> float:
    """Seconds per batch, median of ten."""
    rng = np.random.default_rng(0)

    def batch(_: int) -> np.ndarray:
        rows = []
        for sample in rng.integers(count, size=512).tolist():
            pixels = np.frombuffer(samples(sample), np.uint32)
            rows.append(pixels[rng.integers(len(pixels), size=128)])
        return np.stack(rows)

    return timed(batch, 10)[0]


def _streaming(out: Path, folder: Path) -> float:
    from streaming import LocalDataset, MDSWriter  # type: ignore[import-not-found]

    samples = _samples(folder)
    with MDSWriter(out=str(out), columns={"pixels": "bytes"}) as writer:
        for sample in samples:
            writer.write({"pixels": sample})
    dataset = LocalDataset(local=str(out))
    return _taken(lambda number: dataset[number]["pixels"], len(samples))


def _webdataset(out: Path, folder: Path) -> float:
    import webdataset  # type: ignore[import-not-found]

    out.mkdir()
    samples = _samples(folder)
    with webdataset.TarWriter(str(out / "data.tar")) as writer:
        for number, sample in enumerate(samples):
            writer.write({"__key__": f"{number:06d}", "bin": sample})
    stream = iter(webdataset.WebDataset(str(out / "data.tar"), shardshuffle=False).repeat())
    return _taken(lambda _: io.BytesIO(next(stream)["bin"]).getvalue(), len(samples))


if __name__ == "__main__":
    main()
