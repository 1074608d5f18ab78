"""How fast shards are read, against what this machine's memory can do, measured in the same run.

    python tools/bench/shard_reader.py [--peers] [--folder DIR] [--threads 1] [--json FILE] [--reduced]

Synthesises datasets from noise, with distorting lenses and without, and prints:
- the limit: the best of `torch.index_select` and `np.take` gathering 4-byte pixels at random places, out of
  the same array that the reader gathers from, into memory that is there already;
- the paper's pattern (128 rays x 8 views x 64 identities of 64x13x256x384): pixels alone, picks, full batches;
- 8,192 rays of three views of 4096x4096;
- the first epoch from a cold page cache, raster and permuted (needs the right to drop a file's pages, and a
  file system on a disk: what is still in memory after dropping is stated);
- with --peers, other libraries on the same pattern, where they are installed (see `shard_peers.py`), with our
  full batches measured before and after each of them; the ratio takes the slower of the two.

Medians and minima over many repetitions. It needs 1.5 GB of disk, with peers 3 GB; run it on a quiet machine.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import mmap
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bench.shard_peers import PEERS, RAYS, VIEWS, Batches, Peer, drop_from_cache
from preface.artifacts import provenance, write_bytes
from preface.cli.usage import Parser
from preface.geometry import Camera, Rigid, Views
from preface.shards import Dataset, Loader, PaperPattern, Pick, Pixels, Placement, SingleRays
from preface.shards.building import build_manifest
from preface.shards.format import PixelOrder
from preface.shards.writer import Head, ShardWriter

BOX = np.array([[-0.15, -0.2, -0.15], [0.15, 0.2, 0.15]])
DISTORTION = {"pinhole": [0.0, 0.0, 0.0, 0.0], "distorted": [-0.1, 0.05, 1e-3, -1e-3]}


@dataclass(frozen=True)
class Sizes:
    """What is measured: identities, views, width, height of the paper's pattern; side of the large views."""

    paper: tuple[int, int, int, int] = (64, 13, 384, 256)
    large: int = 4096


REDUCED = Sizes((64, 13, 48, 32), 512)


@dataclass(frozen=True)
class Timing:
    """One line of the result; times are seconds, `share` is of the gather limit of the same placement."""

    section: str
    what: str
    median: float
    minimum: float
    rays: int
    share: float | None = None


@dataclass
class Results:
    """What was measured, as the JSON file has it."""

    configuration: dict[str, Any]
    timings: list[Timing] = field(default_factory=list)
    cold: list[dict[str, Any]] = field(default_factory=list)
    peers: list[dict[str, Any]] = field(default_factory=list)

    def add(self, timing: Timing) -> None:
        """Keep a line and print it."""
        first = not any(old.section == timing.section for old in self.timings)
        self.timings.append(timing)
        if first:
            heading(f"{timing.section}", "what", "median ms", "min ms", "M rays/s", "of the limit")
        share = f"{timing.share:.2f}" if timing.share is not None else ""
        rate = timing.rays / timing.median / 1e6
        row(timing.what, f"{timing.median * 1e3:.3f}", f"{timing.minimum * 1e3:.3f}", f"{rate:.1f}", share)


def heading(title: str, *columns: str) -> None:
    """Begin a Markdown table."""
    print(f"\n{title}\n\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")


def row(*cells: str) -> None:
    """Print a row of it."""
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Measure, print, and write the JSON."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", action="store_true", help="measure peers too, where they are installed")
    parser.add_argument("--folder", type=Path, help="where to put the data; a temporary folder by default")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--repeats", type=int, default=100, help="of each measurement")
    parser.add_argument("--json", type=Path, help="file to write the results to")
    parser.add_argument(
        "--reduced", action="store_true", help="small views: a trial, whose numbers say little"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    sizes = REDUCED if arguments.reduced else Sizes()
    settings = {"threads": arguments.threads, "repeats": arguments.repeats, **asdict(sizes)}
    results = Results({**settings, "torch": torch.__version__, "numpy": np.__version__})
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        root = Path(name)
        for lens in DISTORTION:
            paper_pattern(write(root / lens, sizes.paper, "raster", lens), lens, arguments.repeats, results)
        large = write(root / "large", (1, 3, sizes.large, sizes.large), "raster", "distorted")
        single_head(large, arguments.repeats, results)
        write(root / "permuted", sizes.paper, "permuted", "distorted")
        heading(
            "first epoch from a cold page cache",
            "order",
            "checked",
            "in memory",
            "first ms",
            "epoch s",
            "steps",
        )
        for order, folder in (("raster", root / "distorted"), ("permuted", root / "permuted")):
            for check in (True, False):
                cold_epoch(folder, order, check, results)
        if arguments.peers:
            peers(root / "peers", root / "distorted", results, max(3, arguments.repeats // 10))
    if arguments.json:
        write_bytes(arguments.json, f"{json.dumps(asdict(results), indent=1)}\n".encode())
        print(f"\n{arguments.json}")


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


# --------------------------------------------------------------------------------------------- hot


def gather_limit(pixels: torch.Tensor, section: str, rays: int, repeats: int, results: Results) -> float:
    """Seconds that gathering `rays` random pixels takes, by the faster of two libraries."""
    index = torch.randint(0, len(pixels), (repeats, rays), generator=torch.Generator().manual_seed(0))
    out = torch.empty(rays, dtype=torch.int32)
    arrays = pixels.numpy(), index.numpy(), out.numpy()
    by_torch = timed(lambda i: torch.index_select(pixels, 0, index[i % repeats], out=out), repeats)
    by_numpy = timed(
        lambda i: np.take(arrays[0], arrays[1][i % repeats], out=arrays[2], mode="clip"), repeats
    )
    results.add(Timing(section, "limit: torch.index_select(out=)", *by_torch, rays))
    results.add(Timing(section, "limit: np.take(out=, mode='clip')", *by_numpy, rays))
    return min(by_torch[0], by_numpy[0])


def _gather(pixels: Pixels, picks: Sequence[Pick], step: int) -> torch.Tensor:
    return pixels.gather(picks[step % len(picks)])


def paper_pattern(folder: Path, lens: str, repeats: int, results: Results) -> None:
    """The paper's batches from the mapped file and from memory."""
    with Dataset(folder) as dataset:
        sampler = PaperPattern(dataset.index("train"), seed=0)
        rays = sampler.groups * sampler.rays
        placements: tuple[Placement, ...] = ("mmap", "ram")
        for placement in placements:
            section = f"paper's pattern, {lens}, {placement}, {dataset.bytes_per_ray:.4f} bytes per ray"
            loader = Loader(dataset, sampler, placement=placement)
            for step in range(40):  # every view has been touched
                loader.batch(step)
            limit = gather_limit(loader.pixels.sources[0], section, rays, repeats, results)
            picks = [sampler.pick(step, 0, 1) for step in range(repeats)]
            works: dict[str, Callable[[int], object]] = {
                "pixels alone": partial(_gather, loader.pixels, picks),
                "picks alone": lambda i: sampler.pick(i, 0, 1),
                f"full batches, {loader.route}": loader.batch,
            }
            for what, work in works.items():
                seconds = timed(work, repeats)
                results.add(Timing(section, what, *seconds, rays, limit / seconds[0]))


def single_head(folder: Path, repeats: int, results: Results) -> None:
    """8,192 rays of three large views."""
    with Dataset(folder) as dataset:
        section = f"8,192 rays of three views of {dataset.manifest.width}x{dataset.manifest.height}"
        for share in (0.0, 0.5):
            sampler = SingleRays(dataset.index(), seed=0, foreground_share=share)
            loader = Loader(dataset, sampler, placement="ram")
            seconds = timed(loader.batch, repeats)
            results.add(Timing(section, f"full batches, foreground share {share}", *seconds, sampler.rays))


# -------------------------------------------------------------------------------------------- cold


def resident_share(folder: Path) -> float:
    """The share of a folder's bytes that the page cache holds, by mincore."""
    library = ctypes.CDLL(None, use_errno=True)
    library.mincore.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p]
    resident = total = 0
    for path in (path for path in folder.rglob("*") if path.is_file() and path.stat().st_size):
        with path.open("rb") as file:
            mapping = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        pages = np.zeros(-(-len(mapping) // mmap.PAGESIZE), np.uint8)
        address = np.frombuffer(mapping, np.uint8).ctypes.data
        if library.mincore(address, len(mapping), pages.ctypes.data):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        resident, total = resident + int((pages & 1).sum()), total + len(pages)
    return resident / total


def cold_epoch(folder: Path, order: str, check: bool, results: Results) -> None:
    """Steps of the paper's pattern until each pixel has been drawn once on average, from a cold page cache."""
    drop_from_cache(folder)
    resident = resident_share(folder)
    with Dataset(folder) as dataset:
        sampler = PaperPattern(dataset.index("train"), seed=0)
        loader = Loader(dataset, sampler, placement="mmap", check=check)
        steps = max(1, dataset.pixel_bytes // 4 // (sampler.groups * sampler.rays))
        begin = time.perf_counter()
        loader.batch(0)
        first = time.perf_counter() - begin
        for step in range(1, steps):
            loader.batch(step)
        epoch = time.perf_counter() - begin
    found = {"order": order, "checked": check, "resident_share": resident, "first": first, "epoch": epoch}
    results.cold.append({**found, "steps": steps})
    checks = "at first touch" if check else "no"
    row(order, checks, f"{100 * resident:.0f}%", f"{first * 1e3:.1f}", f"{epoch:.2f}", str(steps))


# ------------------------------------------------------------------------------------------- peers


def peers(root: Path, folder: Path, results: Results, repeats: int) -> None:
    """The same pattern through other libraries, each between two measurements of our full batches."""
    root.mkdir()
    columns = ("library", "hot ms", "ours before, after ms", "times ours", "cold first batch ms", "in memory")
    heading(
        f"peers: {VIEWS} views of each identity read, {RAYS} pixels of each taken, no rays formed", *columns
    )
    with Dataset(folder) as dataset:
        loader = Loader(dataset, PaperPattern(dataset.index("train"), seed=0), placement="mmap")
        for step in range(40):
            loader.batch(step)
        for name, peer in PEERS.items():
            try:
                found = measure_peer(name, peer, root, dataset, loader, repeats)
            except ImportError as error:
                results.peers.append({"library": name, "missing": str(error)})
                row(name, f"not installed ({error})", "", "", "", "")
                continue
            results.peers.append(found)
            ours = f"{found['ours_before'] * 1e3:.3f}, {found['ours_after'] * 1e3:.3f}"
            cold, resident = f"{found['cold_first'] * 1e3:.0f}", f"{100 * found['resident_share']:.0f}%"
            label = f"{name} {found['version']}"
            row(label, f"{found['hot'] * 1e3:.1f}", ours, f"{found['ratio']:.0f}", cold, resident)


def measure_peer(
    name: str, peer: Peer, root: Path, dataset: Dataset, loader: Loader, repeats: int
) -> dict[str, Any]:
    """Write a peer's files, measure its batches hot and its first one cold, and remove the files."""
    manifest, target = dataset.manifest, root / name.replace(" ", "-")
    shape = (len(dataset), manifest.views, manifest.width * manifest.height)
    try:
        peer.write(target, _samples(dataset))
        hot = Batches(peer.open(target), *shape)
        before = timed(loader.batch, 10 * repeats)[0]
        seconds = timed(hot, repeats)
        after = timed(loader.batch, 10 * repeats)[0]
        del hot
        drop_from_cache(target)
        resident = resident_share(target)
        cold = Batches(peer.open(target), *shape)
        begin = time.perf_counter()
        cold(0)
        first = time.perf_counter() - begin
    finally:
        shutil.rmtree(target, ignore_errors=True)
    return {
        "library": name,
        "version": peer.version,
        "hot": seconds[0],
        "hot_minimum": seconds[1],
        "ours_before": before,
        "ours_after": after,
        "ratio": seconds[0] / max(before, after),
        "cold_first": first,
        "resident_share": resident,
    }


def _samples(dataset: Dataset) -> Iterator[bytes]:
    """The bytes of each view, identity by identity."""
    for identity in range(len(dataset)):
        for view in range(dataset.manifest.views):
            yield dataset.pixels(identity, view).tobytes()


if __name__ == "__main__":
    main()
