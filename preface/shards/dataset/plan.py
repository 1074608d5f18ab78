"""Who goes into which shard and which split, how the foreground is found, and what it all will take."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from preface.artifacts import ArtifactError
from preface.capture.foreground import Choice, choose
from preface.capture.preparation import PreparationError, framing_window
from preface.geometry import Camera, GeometryError
from preface.plain_words import suggestion
from preface.shards.dataset.configuration import BuildConfiguration, Framing
from preface.shards.dataset.heads import HeadMaker
from preface.shards.dataset.people import People, Person
from preface.shards.format import CHANNELS, Layout

# A shard is one file to write, verify and resume: of about this size, and never of more people than this, so that
# small datasets too can be built by several processes.
SHARD_BYTES = 256 * 2**20
SHARD_PEOPLE = 16
NOTES_BYTES = 400  # of a view, for estimates: names, digests, remarks

TRAIN, HOLDOUT = "train", "holdout"


@dataclass(frozen=True, eq=False)
class ShardTask:
    """One shard to build: all that a process needs, wherever it runs.

    Attributes:
        folder: of the dataset.
        number: of the shard.
        people: who is in it.
        cameras: names of the V cameras.
        choices: take -> how the foreground is found.
        configuration: of the dataset.
        strict: stop at the first view or person that cannot be used.
    """

    folder: Path
    number: int
    people: tuple[Person, ...]
    cameras: tuple[str, ...]
    choices: Mapping[str, Choice]
    configuration: BuildConfiguration
    strict: bool


@dataclass(frozen=True)
class Estimate:
    """What building will take.

    Attributes:
        people, views, shards: how many.
        dataset_bytes: of all shards.
        free_bytes: on the disk that they go to.
        seconds: on the given number of processes, measured on one view; other programs make it longer.
    """

    people: int
    views: int
    shards: int
    dataset_bytes: int
    free_bytes: int
    seconds: float


def people_per_shard(views: int, width: int, height: int) -> int:
    """How many people a shard holds unless the user says otherwise."""
    return max(1, min(SHARD_PEOPLE, SHARD_BYTES // (views * width * height * CHANNELS)))


def shard_count(people: int, configuration: BuildConfiguration) -> int:
    """How many shards so many people make."""
    return -(-people // configuration.identities_per_shard)


def foreground_choices(people: People, configuration: BuildConfiguration) -> dict[str, Choice]:
    """How the foreground of each take is found.

    Raises:
        ArtifactError: the method that was asked for lacks its masks, plates or model.
    """
    method, model = configuration.foreground, configuration.matting_model
    names = [person.identity for person in people.people]
    takes = dict.fromkeys(person.take for person in people.people)
    return {take: choose(people.capture, take, method, model, names) for take in takes}


def check_framing(lenses: Iterable[Camera], size: tuple[int, int], framing: Framing) -> None:
    """Refuse a resolution or framing that no camera can have, before photographs are looked at.

    Where some cameras can have it, tasks leave the others out.

    Args:
        lenses: of the cameras.
        size: width and height of all views of the dataset, pixels.
        framing: of these.

    Raises:
        PreparationError: what the first camera says.
    """
    if framing == "box":  # depends on the person
        return
    problems = []
    for lens in sorted(set(lenses), key=lambda lens: (lens.width, lens.height)):
        try:
            framing_window(lens, size, framing)
            return
        except PreparationError as error:
            problems.append(error)
    if problems:
        raise problems[0]


def shard_tasks(
    people: People,
    choices: Mapping[str, Choice],
    configuration: BuildConfiguration,
    folder: Path,
    strict: bool,
) -> list[ShardTask]:
    """Cut the people into shards, in their order."""
    each = configuration.identities_per_shard
    groups = [people.people[first : first + each] for first in range(0, len(people.people), each)]
    return [
        ShardTask(folder, number, group, people.cameras, choices, configuration, strict)
        for number, group in enumerate(groups)
    ]


# ----------------------------------------------------------------------------------------- splits


def splits(
    names: Sequence[str], holdout: Sequence[str], seed: int, source: Path, persons: Mapping[str, str]
) -> dict[str, tuple[str, ...]]:
    """Divide identities into those for training and those held out.

    Args:
        names: of all.
        holdout: names; or one number, of how many; or one share such as ``0.1`` or ``10%``. Who is held out by number
            is a function of the seed and the names, and stays so when people join: they are ordered by a hash.
        seed: of that hash.
        source: the capture, to be named in errors.
        persons: identity -> person, where several identities are one person (expressions of an imported dataset).
            Numbers and shares then count persons, so that nobody is on both sides.

    Raises:
        ArtifactError: somebody who is not there, or a number that leaves nobody for training.
    """
    of_name = {name: persons.get(name, name) for name in names}
    everybody = list(dict.fromkeys(of_name.values()))
    count = _count(names, holdout, len(everybody))
    if count is None:
        for name in holdout:
            if name not in names:
                problem = f"there is no '{name}' among the {len(names)} identities of the dataset"
                raise ArtifactError(source, "holdout", problem, suggestion(name, names))
        chosen = set(holdout)
    else:
        ranked = sorted(everybody, key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).digest())
        chosen = {name for name in names if of_name[name] in ranked[:count]}
    if len(chosen) >= len(names):
        problem = f"{len(chosen)} of {len(names)} identities held out leave nobody for training"
        raise ArtifactError(source, "holdout", problem, "Hold out fewer")
    return {
        TRAIN: tuple(name for name in names if name not in chosen),
        HOLDOUT: tuple(name for name in names if name in chosen),
    }


def _count(names: Sequence[str], holdout: Sequence[str], persons: int) -> int | None:
    """How many persons are held out where that is a number or a share; a name of somebody is a name."""
    if not holdout:
        return 0
    text = holdout[0]
    if len(holdout) > 1 or text in names:
        return None
    try:
        if text.isdecimal():
            return int(text)
        share = float(text[:-1]) / 100 if text.endswith("%") else float(text)
    except ValueError:
        return None
    return round(share * persons) if 0 <= share < 1 else persons


# --------------------------------------------------------------------------------------- estimate


def estimate(tasks: Sequence[ShardTask], jobs: int) -> Estimate:
    """What building will take; makes one view twice to know the time.

    Raises:
        ArtifactError: the first shard has not one view that can be used.
    """
    views = [len(person.views) for task in tasks for person in task.people]
    total = 0
    for task in tasks:
        configuration, slots = task.configuration, len(task.cameras)
        notes = NOTES_BYTES * slots * len(task.people)
        layout = Layout(
            len(task.people),
            slots,
            configuration.height,
            configuration.width,
            configuration.pixel_order,
            notes,
        )
        total += layout.file_bytes
    parent = tasks[0].folder.resolve()
    while not parent.exists():
        parent = parent.parent
    seconds = sum(views) * _seconds_per_view(tasks[0]) / min(jobs, len(tasks))
    free = shutil.disk_usage(parent).free
    return Estimate(len(views), sum(views), len(tasks), total, free, seconds)


def _seconds_per_view(task: ShardTask) -> float:
    """What one view costs once its camera's maps are made and the models are loaded: the first that can be used."""
    maker = HeadMaker(task.configuration, task.choices)
    for person in task.people:
        for view in person.views:
            try:
                maker.make_view(person, view)
            except (ArtifactError, PreparationError, GeometryError):
                continue  # left out, with the reason, when the dataset is built
            began = time.perf_counter()
            maker.make_view(person, view)
            return time.perf_counter() - began
    problem = "not one view of its people can be used"
    raise ArtifactError(task.folder, f"shard {task.number}", problem, "Correct the photographs")


def default_jobs() -> int:
    """One process per core that this process may use."""
    return len(os.sched_getaffinity(0))
