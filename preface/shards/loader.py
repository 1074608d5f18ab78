"""Batches for a trainer: pixels from where they are placed, rays formed, one batch ahead in the background.

    loader = Loader(dataset, PaperPattern(dataset.index("train"), seed=7), device="cuda")
    for step, batch in loader.batches(start):
        ...

To resume, start from the step that comes next.
"""

from __future__ import annotations

import queue
import threading
import warnings
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from preface.shards.batches import Batch, form_batch
from preface.shards.reader import Dataset
from preface.shards.routes import Route, fastest_route
from preface.shards.samplers import Pick, Sampler

Placement = Literal["device", "ram", "mmap", "auto"]
# "auto" leaves the other half to the model, or to the rest of the machine.
_SHARE = 0.5


class Pixels:
    """The pixels of a dataset, placed somewhere, each view checked before its first use.

    Args:
        dataset: opened.
        placement: "device": all on `device`; "ram": all in memory; "mmap": mapped from the files, pages are read
            when they are touched; "auto": the first of them that takes no more than half of what is free.
        device: of the trainer.
        check: False leaves the checksums of mapped views to `verify`, so that only the pages that are sampled are
            read; for data beyond the memory. It does not concern the other placements.

    Attributes:
        placement: where they are.
        sources: int32 [n], all pixels, or those of each shard if they are mapped; never to be written to.

    Raises:
        ArtifactError: a view is damaged, at once or (mapped) when it is first touched.
    """

    def __init__(self, dataset: Dataset, placement: Placement, device: torch.device, check: bool = True):
        self._dataset = dataset
        self.placement = _choose(dataset.pixel_bytes, device) if placement == "auto" else placement
        counts = [shard.layout.identities for shard in dataset.shards]
        self._first = np.cumsum([0, *counts])[:-1]  # of each shard, the number of its first identity
        self._checked = np.zeros((len(dataset), dataset.manifest.views), dtype=bool)
        if self.placement == "mmap":
            self._checked |= not check
            self.sources = [_read_only(dataset.map(number)) for number in range(len(dataset.shards))]
        else:
            place = device if self.placement == "device" else torch.device("cpu")
            self.sources = [_loaded(dataset, place)]

    def gather(self, pick: Pick) -> Tensor:
        """The four bytes of each pixel as int32 [G, P], on the device where they are.

        Raises:
            ArtifactError: a view that is touched for the first time is damaged, or a file was shortened.
        """
        manifest = self._dataset.manifest
        per_view = manifest.width * manifest.height
        if self.placement != "mmap":
            first = (pick.identity * manifest.views + pick.view) * per_view
            return self._take(0, first[:, None] + pick.slot)
        fresh = ~self._checked[pick.identity, pick.view]
        if fresh.any():
            self._check(pick.identity[fresh], pick.view[fresh])
        shard = self._dataset.shard_of[pick.identity]
        first = (self._dataset.place_of[pick.identity] * manifest.views + pick.view) * per_view
        used = np.unique(shard)
        for number in used:
            self._dataset.shards[number].file.check_size()
        if len(used) == 1:
            return self._take(int(used[0]), first[:, None] + pick.slot)
        result = torch.empty(pick.slot.shape, dtype=torch.int32)
        for number in used:
            groups = np.flatnonzero(shard == number)
            result[torch.from_numpy(groups)] = self._take(
                int(number), first[groups, None] + pick.slot[groups]
            )
        return result

    def _take(self, source: int, places: np.ndarray) -> Tensor:
        pixels = self.sources[source]
        index = torch.from_numpy(places).view(-1).to(pixels.device)
        return pixels.index_select(0, index).view(places.shape)

    def _check(self, identities: np.ndarray, views: np.ndarray) -> None:
        """Check views that are touched for the first time; by pread, which also reads them ahead in one go."""
        for identity, view in zip(identities.tolist(), views.tolist(), strict=True):
            if not self._checked[identity, view]:
                shard = self._dataset.shards[self._dataset.shard_of[identity]]
                shard.read_view(int(self._dataset.place_of[identity]), view)
                self._checked[identity, view] = True


def _read_only(pixels: np.ndarray) -> Tensor:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        return torch.from_numpy(pixels)  # only ever read, by index_select


def _loaded(dataset: Dataset, device: torch.device) -> Tensor:
    """All pixels, int32 [N * V * H * W], every view checked."""
    count = dataset.pixel_bytes // 4
    # Numpy asks for huge pages, with which a random gather is twice as fast.
    cpu = device.type == "cpu"
    result = (
        torch.from_numpy(np.empty(count, "<i4"))
        if cpu
        else torch.empty(count, dtype=torch.int32, device=device)
    )
    begin = 0
    for shard in dataset.shards:
        for identity in range(shard.layout.identities):
            for view in range(shard.layout.views):
                pixels = torch.from_numpy(shard.read_view(identity, view).view("<i4").reshape(-1))
                result[begin : begin + len(pixels)] = pixels.to(device)
                begin += len(pixels)
    return result


def _choose(pixel_bytes: int, device: torch.device) -> Placement:
    if device.type == "cuda" and pixel_bytes <= _SHARE * torch.cuda.mem_get_info(device)[0]:
        return "device"
    return "ram" if pixel_bytes <= _SHARE * _free_memory() else "mmap"


def _free_memory() -> int:
    """Bytes that programs can have without swapping; 0 where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:  # noqa: PTH123 - no file of ours
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 0


class Loader:
    """Forms the batches of a sampler for one rank.

    Args:
        dataset: opened; it must stay open.
        sampler: what each step consists of.
        device: of the batches.
        placement: of the pixels, see `Pixels`.
        scale: what lengths are multiplied with: 1 for metres, `dataset.manifest.scene_scale` for the model's units.
        rank, world: this process and how many there are.
        check: see `Pixels`.
        compiled: False forms batches by torch even where a compiled kernel could; results are the same.

    Attributes:
        route: how batches are formed: "compiled by numba ...", or "torch" and why.

    Raises:
        ArtifactError: a view is damaged, a lens folds, or a file fails; at once or when it is touched.
    """

    def __init__(
        self,
        dataset: Dataset,
        sampler: Sampler,
        device: str | torch.device = "cpu",
        placement: Placement = "auto",
        scale: float = 1.0,
        rank: int = 0,
        world: int = 1,
        check: bool = True,
        compiled: bool = True,
    ):
        self.device = torch.device(device)
        # Apple's devices have no float64, in which rays are formed.
        rays_on = torch.device("cpu") if self.device.type == "mps" else self.device
        self.pixels = Pixels(dataset, placement, rays_on, check)
        self._table = dataset.ray_table(scale, rays_on)
        self._sampler, self._views = sampler, dataset.manifest.views
        self._rank, self._world = rank, world
        rays, _, self.route = self._choose_route(compiled)
        self._compiled = rays.CompiledTable(self._table) if rays else None

    def _choose_route(self, compiled: bool) -> Route:
        """Choose between torch, which runs anywhere, and what is compiled for processors."""
        if not compiled:
            return Route(None, None, "torch (asked for)")
        if self._table.device.type != "cpu":
            return Route(None, None, f"torch (on {self._table.device})")
        return fastest_route()

    def batch(self, step: int) -> Batch:
        """Form the batch of a step, now."""
        pick = self._sampler.pick(step, self._rank, self._world)
        rgba = self.pixels.gather(pick)
        if self._compiled:
            batch = self._compiled.form_batch(pick.identity, pick.view, self._views, pick.pixel, rgba)
        else:
            identity, view, pixel = map(torch.from_numpy, (pick.identity, pick.view, pick.pixel))
            batch = form_batch(self._table, identity, view, self._views, pixel, rgba)
        return batch if self._table.device == self.device else batch.to(self.device)

    def batches(self, start: int, stop: int | None = None) -> Iterator[tuple[int, Batch]]:
        """Yield (step, batch) from step `start` to before `stop`, each formed while the one before is used.

        Errors of the background thread are raised here, in place of the batch that they prevented. The thread
        ends with the iteration, also when that is left early.
        """
        ahead: queue.Queue[Any] = queue.Queue(maxsize=1)
        stopped = threading.Event()

        def put(item: Any) -> bool:
            while not stopped.is_set():
                try:
                    ahead.put(item, timeout=0.1)
                    return True
                except queue.Full:
                    continue
            return False

        def work() -> None:
            step = start
            try:
                while (stop is None or step < stop) and put((step, self.batch(step))):
                    step += 1
                put(None)
            except BaseException as error:
                put(error)

        thread = threading.Thread(target=work, name="preface-batches", daemon=True)
        thread.start()
        try:
            while (item := ahead.get()) is not None:
                if isinstance(item, BaseException):
                    raise item
                yield item
        finally:
            stopped.set()
            thread.join()
