"""From tasks to a complete dataset: run them until all shards are there, write its papers, and the manifest last."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from preface.align.alignment_files import TEMPLATE_FILE
from preface.artifacts import ArtifactError, provenance, write_bytes
from preface.capture.foreground.sheet import MaskFigures, mask_report
from preface.shards.building import build_manifest, claim
from preface.shards.dataset.croissant import CROISSANT_FILE, croissant
from preface.shards.dataset.data_card import CARD_FILE, Contents, data_card
from preface.shards.dataset.heads import mask_figures
from preface.shards.dataset.people import TEMPLATE_INPUT, LeftOut, People, persons_of
from preface.shards.dataset.plan import ShardTask, splits
from preface.shards.dataset.tasks import TaskResult
from preface.shards.format import shard_name, shard_number
from preface.shards.shard import Shard
from preface.shards.streams import permutation

MASKS_FILE = "masks.html"
POLL = 0.5  # seconds between looks at a shard that another builder is at

Runner = Callable[[Sequence[ShardTask]], Iterator[TaskResult]]
Done = Callable[[ShardTask, TaskResult], None]


@dataclass(frozen=True)
class Built:
    """All shards of a dataset.

    Attributes:
        tasks: of the shards 0, 1, ..., in this order.
        results: theirs.
        left_out: people and views that tasks could not use.
    """

    tasks: tuple[ShardTask, ...]
    results: tuple[TaskResult, ...]
    left_out: tuple[LeftOut, ...]


def build_all(tasks: Sequence[ShardTask], run: Runner, done: Done) -> Built:
    """Run tasks until every shard is there, waiting for those that other builders are at.

    A shard of whose people not one can be used would be empty: the last shard's people then take its number.

    Args:
        tasks: of the shards 0, 1, ...
        run: yields the results of tasks, in any order.
        done: called with each result.

    Raises:
        ArtifactError: as `run_task`, or nobody is left.
    """
    slots = list(tasks)
    results: dict[int, TaskResult] = {}
    left_out: list[LeftOut] = []
    waiting = list(tasks)
    while waiting:
        by_number = {task.number: task for task in waiting}
        for result in run(waiting):
            results[result.number] = result
            done(by_number[result.number], result)
        waiting = [task for task in waiting if results[task.number].state == "claimed"]
        if waiting:
            time.sleep(POLL)
            continue
        for number in sorted((n for n, result in results.items() if result.state == "empty"), reverse=True):
            left_out += results.pop(number).left_out
            last = slots.pop()
            if last.number != number:
                slots[number] = replace(last, number=number)
                results.pop(last.number)
                waiting.append(slots[number])
    if not slots:
        problem = "not one of the people can be used: " + "; ".join(map(str, left_out[:3]))
        raise ArtifactError(tasks[0].folder, "identities", problem, "Correct the sources")
    in_order = tuple(results[task.number] for task in slots)
    everything = [*left_out, *(entry for result in in_order for entry in result.left_out)]
    return Built(tuple(slots), in_order, tuple(everything))


def finish(
    built: Built,
    people: People,
    source: Path,
    holdout: Sequence[str],
    seed: int,
    name: str,
) -> Path:
    """Write the page of masks, the data card, the Croissant description, the template and the manifest.

    The template is a copy of the alignment's: whoever is to be fitted by a prior of these shards later has to be
    placed on it.

    Shards of an earlier dataset that are no longer part of it are removed.

    Args:
        built: all shards.
        people: that they were planned for.
        source: the capture, to be named in errors.
        holdout, seed: see `plan.splits`.
        name: of the dataset.

    Raises:
        ArtifactError: a shard is missing or damaged, or the disk refuses.
    """
    folder, configuration = built.tasks[0].folder, built.tasks[0].configuration
    identities = [identity for result in built.results for identity in result.identities]
    divided = splits(identities, holdout, seed, source, persons_of(people.capture))
    choices = built.tasks[0].choices
    left_out = [*people.left_out, *built.left_out]
    settings: dict[str, Any] = {
        "command": "build",
        "name": name,
        "holdout": list(holdout),
        "foreground": {take: {"method": c.method, "reason": c.reason} for take, c in choices.items()},
        "left_out": [vars(entry) for entry in left_out],
    }
    contents = Contents.read(
        folder, name, built.results, divided, {p.identity: p for p in people.people}, settings, configuration
    )
    history = provenance(settings, people.inputs, seed)
    write_mask_page(folder, built, history)
    pages = {"Masks over the photographs, worst first": MASKS_FILE}
    write_bytes(folder / CARD_FILE, data_card(contents, left_out, pages).encode())
    write_bytes(folder / CROISSANT_FILE, croissant(contents).encode())
    write_bytes(folder / TEMPLATE_FILE, people.inputs[TEMPLATE_INPUT].read_bytes())
    manifest = build_manifest(
        folder,
        len(built.tasks),
        divided,
        configuration.content(),
        history,
    )
    remove_others(folder, len(built.tasks))
    return manifest


def write_mask_page(folder: Path, built: Built, history: Mapping[str, Any]) -> Path:
    """Write the page of the dataset's masks, as they are in the shards, those that deserve a look first.

    Raises:
        ArtifactError: a shard is missing or damaged, or the disk refuses.
    """
    figures: list[MaskFigures] = []
    place_of: dict[str, tuple[Path, int, list[str]]] = {}
    for result in built.results:
        path = folder / shard_name(result.number)
        with Shard(path) as shard:
            for place, person in enumerate(shard.people):
                name, cameras = person["identity"], person["cameras"]
                place_of[name] = path, place, cameras
                figures += [mask_figures(name, camera, person["metadata"]) for camera in cameras if camera]

    def load(identity: str, camera: str) -> tuple[np.ndarray, np.ndarray]:
        path, place, cameras = place_of[identity]
        with Shard(path) as shard:
            stored = shard.read_view(place, cameras.index(camera))
            if shard.layout.pixel_order == "permuted":
                stored = stored[permutation(len(stored))[1]]
            pixels = stored.reshape(shard.layout.height, shard.layout.width, 4)
        return pixels[..., :3], pixels[..., 3].astype(np.float32) / 255

    choices = {take: f"{c.method}: {c.reason}" for take, c in built.tasks[0].choices.items()}
    return mask_report(figures, load, choices, history).write(folder / MASKS_FILE)


def remove_others(folder: Path, shards: int) -> None:
    """Remove the shards of an earlier, larger dataset, which no manifest names."""
    for path in sorted(folder.glob("shard-*.safetensors")):
        number = shard_number(path.name)
        if number is not None and number >= shards:
            with claim(folder, number) as mine:
                if mine:
                    path.unlink(missing_ok=True)
            path.with_name(f".{shard_name(number)}.claim").unlink(missing_ok=True)
