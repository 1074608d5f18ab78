"""``preface-build-shards CAPTURE``: plan, build every shard, write the dataset's papers and its manifest."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path

from tqdm import tqdm

from preface.artifacts import ArtifactError
from preface.capture.foreground import make_segmenter
from preface.capture.manifest import Capture
from preface.capture.rig import Rig
from preface.cli.align_inputs import rigs_of_takes
from preface.cli.folders import make_folder, require_own, require_writable
from preface.cli.output import say
from preface.cli.usage import UsageError
from preface.plain_words import counted, disk_space, duration
from preface.progress import Progress
from preface.shards.dataset.configuration import HEAD_BOX, BuildConfiguration
from preface.shards.dataset.finishing import Built, Runner, build_all, finish
from preface.shards.dataset.people import (
    Candidates,
    LeftOut,
    People,
    find_candidates,
    find_people,
    is_capture,
    persons_of,
)
from preface.shards.dataset.plan import (
    HOLDOUT,
    ShardTask,
    check_framing,
    default_jobs,
    estimate,
    foreground_choices,
    people_per_shard,
    shard_count,
    shard_tasks,
    splits,
)
from preface.shards.dataset.schedulers import dask_cluster, run_local
from preface.shards.dataset.tasks import TaskResult, run_task, strict_error, use_one_thread
from preface.shards.format import shard_name
from preface.shards.manifest import MANIFEST_FILE

MAX_NAMED = 20  # remarks on standard error; the data card has more and the manifest all
WITH_MODEL = ("onnx", "selfie")  # methods that find the foreground by a model
Rigs = Mapping[str, tuple[Path, Rig]]  # take -> its file, and what that says


def run(config: argparse.Namespace) -> list[str]:
    """Build, or say what building would take; returns the lines to print.

    What flags can be wrong about is refused first: people are looked at, file by file, only after that.
    """
    _check_usage(config)
    require_own(config.output, "a dataset", (MANIFEST_FILE, "shard-*", ".shard-*"))
    if not config.dry_run:
        require_writable(config.output)
    _check_model(config)
    if config.scheduler == "dask":  # its workers may have another working directory
        for path in ("source", "output", "matting_model", "masks"):
            setattr(config, path, getattr(config, path) and getattr(config, path).resolve())
    candidates, rigs = _candidates(config)
    if config.dry_run:
        return _dry_run(config, *_plan(config, candidates, rigs))
    if config.shard is not None:
        _, tasks = _plan(config, candidates, rigs)
        return _one(config, tasks)
    with _runner(config) as runner:
        people, tasks = _plan(config, candidates, rigs)
        return _all(config, people, tasks, runner)


def _check_usage(config: argparse.Namespace) -> None:
    chosen = [flag for flag in ("dry_run", "finish") if getattr(config, flag)]
    chosen += ["shard"] if config.shard is not None else []
    if len(chosen) > 1:
        flags = " and ".join("--" + flag.replace("_", "-") for flag in chosen)
        raise UsageError(f"{flags} exclude each other")
    if config.dask_address and config.scheduler != "dask":
        raise UsageError("--dask-address is for --scheduler dask")
    if config.foreground == "onnx" and config.matting_model is None:
        raise UsageError("--foreground onnx needs --matting-model")
    if config.matting_model is not None and config.foreground not in ("auto", "onnx"):
        raise UsageError(f"--matting-model is not used by --foreground {config.foreground}")
    if config.masks is not None and is_capture(config.source):
        raise UsageError(
            "--masks is for a folder of photographs; those of a capture lie in its own folder masks"
        )
    if config.box and not all(low < high for low, high in zip(config.box[:3], config.box[3:], strict=True)):
        raise UsageError("--box: each of X1 Y1 Z1 must be greater than its X0 Y0 Z0")


def _check_model(config: argparse.Namespace) -> None:
    """Load the model that was asked for, so that what is missing is not found out view by view.

    Raises:
        ForegroundError: its file is no model, or what runs it is not installed.
    """
    method = config.foreground if config.matting_model is None else "onnx"
    if method in WITH_MODEL and config.dask_address is None:  # workers of a cluster elsewhere load it there
        make_segmenter(method, config.matting_model)


# ---------------------------------------------------------------------------------------- the plan


def _candidates(config: argparse.Namespace) -> tuple[Candidates, Rigs]:
    """Who may be in the dataset, and the rig of every take; refuses what neither people nor cameras allow.

    Raises:
        UsageError, ArtifactError, PreparationError: a flag that asks for what is not there.
    """
    candidates = find_candidates(config.source, config.alignment, config.only, config.masks)
    takes = list(dict.fromkeys(entry.take for entry in candidates.index.aligned))
    found, notes = rigs_of_takes(config.rig, takes)
    for note in notes:
        say(f"note: {note}")
    aligned, cameras = candidates.aligned, candidates.cameras
    if aligned:
        _check_counts(config, list(aligned), cameras, candidates.capture)
    used = [found[take].rig.cameras for take in dict.fromkeys(entry.take for entry in aligned.values())]
    lenses = [rig[camera].camera for rig in used for camera in cameras if camera in rig]
    check_framing(lenses, config.resolution, config.framing)
    return candidates, {take: (entry.path, entry.rig) for take, entry in found.items()}


def _plan(config: argparse.Namespace, candidates: Candidates, rigs: Rigs) -> tuple[People, list[ShardTask]]:
    """Everybody, and one task per shard; says who is left out and how the foreground is found.

    Raises:
        ArtifactError: nobody is left, or, with --strict, somebody is left out.
    """
    people = find_people(candidates, rigs, config.max_pixels)
    named = _Named()
    for entry in people.left_out:
        named(str(entry))
    named.end()
    if not people.people:
        problem = f"not one of the people can be used: {'; '.join(map(str, people.left_out[:3]))}"
        raise ArtifactError(config.source, "subjects", problem, "Correct the capture or the alignment")
    if config.strict and people.left_out:
        raise strict_error(config.source, people.left_out[0])
    names = [person.identity for person in people.people]
    if people.left_out:  # of those who are there, the flags may ask too much
        _check_counts(config, names, people.cameras, people.capture)
    configuration = _configuration(config, len(people.cameras))
    if config.finish:
        _require_all(config.output, shard_count(len(names), configuration))
    choices = foreground_choices(people, configuration)
    for take, choice in choices.items():
        say(f"take {take}: foreground by '{choice.method}', because {choice.reason}")
    return people, shard_tasks(people, choices, configuration, config.output, config.strict)


def _check_counts(
    config: argparse.Namespace, names: Sequence[str], cameras: Sequence[str], capture: Capture
) -> None:
    """Refuse to hold out, or to build a shard of, people who are not there.

    Raises:
        UsageError, ArtifactError: see `_check_holdout` and `splits`; or there is no such shard.
    """
    _check_holdout(config.holdout, names)
    held_out = splits(names, config.holdout, config.seed, config.source, persons_of(capture))[HOLDOUT]
    if config.holdout and not held_out:
        raise UsageError(
            f"--holdout: '{config.holdout[0]}' of {len(names)} identities is nobody: hold out more, or leave it out"
        )
    shards = shard_count(len(names), _configuration(config, len(cameras)))
    if config.shard is not None and config.shard >= shards:
        problem = f"there is no shard {config.shard}, only 0 to {shards - 1}"
        raise ArtifactError(config.output, "shard", problem, "Correct --shard")


def _check_holdout(holdout: Sequence[str], names: Sequence[str]) -> None:
    """Refuse what reads as a number and is no part of a whole; whether it can be so many, or these, `splits` says."""
    if len(holdout) != 1 or holdout[0] in names or holdout[0].isdecimal():
        return
    text = holdout[0]
    try:
        share = float(text[:-1]) / 100 if text.endswith("%") else float(text)
    except ValueError:
        return  # a name
    if not 0 < share < 1:
        raise UsageError(
            f"--holdout: '{text}' is neither a number of identities, a share between 0 and 1 (0.1 or 10%), nor a name"
        )


def _configuration(config: argparse.Namespace, views: int) -> BuildConfiguration:
    width, height = config.resolution
    return BuildConfiguration(
        width=width,
        height=height,
        framing=config.framing,
        box=tuple(config.box or HEAD_BOX),
        filter=config.filter,
        light=config.light,
        undistort=config.undistort,
        white=config.white,
        foreground=config.foreground,
        matting_model=config.matting_model,
        pixel_order=config.pixel_order,
        identities_per_shard=config.identities_per_shard or people_per_shard(views, width, height),
        max_pixels=config.max_pixels,
    )


def _dry_run(config: argparse.Namespace, people: People, tasks: list[ShardTask]) -> list[str]:
    found = estimate(tasks, config.jobs or default_jobs())
    enough = "" if found.dataset_bytes < found.free_bytes else ", which is NOT enough"
    return [
        f"{counted(found.people, 'identity', 'identities')}, {counted(found.views, 'view', 'views')}, "
        f"{len(people.left_out)} people or views left out",
        f"{counted(found.shards, 'shard', 'shards')} (0 to {found.shards - 1}) of {disk_space(found.dataset_bytes)} in "
        f"all; {disk_space(found.free_bytes)} are free at {config.output}{enough}",
        f"about {duration(found.seconds)} in {counted(config.jobs or default_jobs(), 'process', 'processes')}, by the "
        "time of one view",
        "nothing was written",
    ]


# ---------------------------------------------------------------------------------------- building


def _runner(config: argparse.Namespace) -> AbstractContextManager[Runner]:
    """Who runs the tasks; a cluster that does not answer says so when the context is entered."""
    jobs = config.jobs or default_jobs()
    if config.scheduler == "dask":
        return dask_cluster(config.dask_address, jobs)
    return nullcontext(partial(run_local, jobs=jobs))


def _all(config: argparse.Namespace, people: People, tasks: list[ShardTask], run_tasks: Runner) -> list[str]:
    """Build every shard, and write the papers and the manifest."""
    make_folder(config.output)
    use_one_thread()
    named = _Named()
    with Progress(sum(len(task.people) for task in tasks), "heads") as progress:

        def done(task: ShardTask, result: TaskResult) -> None:
            if result.state != "claimed":
                progress.add(len(task.people) if result.state != "empty" else 0)
            for entry in result.left_out:
                named(str(entry))

        built = build_all(tasks, run_tasks, done)
    named.end()
    manifest = finish(built, people, config.source, config.holdout, config.seed, config.name)
    return [*_summary(built, people), str(manifest)]


def _one(config: argparse.Namespace, tasks: list[ShardTask]) -> list[str]:
    """Build one shard of many."""
    make_folder(config.output)
    use_one_thread()
    result = run_task(tasks[config.shard])
    for entry in result.left_out:
        say(str(entry))
    words = {
        "built": "built",
        "kept": "finished before, verified and kept",
        "claimed": "being built by another process",
        "empty": "not written: not one of its people can be used",
    }
    path = config.output / shard_name(config.shard)
    return [f"shard {config.shard} of {len(tasks)}: {words[result.state]}", str(path)]


def _require_all(folder: Path, shards: int) -> None:
    missing = [number for number in range(shards) if not (folder / shard_name(number)).is_file()]
    if missing:
        some = ", ".join(map(str, missing[:10])) + (", ..." if len(missing) > 10 else "")
        problem = f"{len(missing)} of {shards} shards are missing: {some}"
        remedy = "Build them with --shard, or run without --finish to build what is missing here"
        raise ArtifactError(folder, "shards", problem, remedy)


def _summary(built: Built, people: People) -> list[str]:
    identities = sum(len(result.identities) for result in built.results)
    kept = sum(result.state == "kept" for result in built.results)
    left_out: list[LeftOut] = [*people.left_out, *built.left_out]
    return [
        f"{counted(identities, 'identity', 'identities')} in {counted(len(built.results), 'shard', 'shards')}, {kept} "
        "of them finished before and kept",
        f"{len(left_out)} people or views left out" + ("; the data card says why" if left_out else ""),
    ]


class _Named:
    """Says the first remarks, and how many there were at the end."""

    def __init__(self) -> None:
        self._count = 0

    def __call__(self, words: str) -> None:
        self._count += 1
        if self._count <= MAX_NAMED:
            tqdm.write(words, file=sys.stderr)

    def end(self) -> None:
        if self._count > MAX_NAMED:
            say(f"... and {self._count - MAX_NAMED} more; the data card says why")
