"""The paper's ablations on your own shards and prior, beside the paper's tables.

    python tools/ablate.py SHARDS --prior prior/ --output ablation --plan      # which fits, and how long they take
    python tools/ablate.py SHARDS --prior prior/ --output ablation
    python tools/ablate.py SHARDS --prior prior/ --output ablation --only regularisers views --seeds 0 1 2

SHARDS hold the people that the prior was trained on and others, who are fitted. Six tables: where the code starts,
regularisers, 1, 2, 3, 5 and 7 views, frozen latent, number of training identities, resolution of the prior. Every row
differs from the full method (two views, inversion, both regularisers, code optimised, whole prior) in one thing, and is
fitted to several people with several seeds. All are evaluated at the same views, which none is fitted to, and in face
crops. The last two tables need more priors; they are trained here, as the given prior was.

OUTPUT/cells has a file per fit, OUTPUT/heads the heads; ablation.json and ablation.md the tables, with what agrees with
the paper and what does not. The same command goes on where it was interrupted. Initialisation by the nearest and the
furthest person compares colours of renders (`preface-fit --inversion.start`), where the paper compares embeddings of
a face recognition network.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ablation.design import FULL_PRIOR, Base, Table, cells_of, five_views, tables, view_sets
from ablation.paper import PAPER
from ablation.priors import Priors, run_config
from ablation.running import Ablation, StoppedError
from preface.artifacts import ArtifactError, sha256
from preface.cli.output import exit_status, resumable, say, whole_number
from preface.cli.usage import Parser, UsageError
from preface.model.fitting.configuration import QUALITIES, check, defaults
from preface.model.matmul import denormals_flushed, keep_freed_memory
from preface.model.pretrained import prior_flag
from preface.model.training.configuration import TrainingConfigError
from preface.model.training.loop import TrainingError
from preface.model.training.prior_files import Prior, read_prior
from preface.plain_words import suggestion
from preface.shards import Dataset
from preface.shards.manifest import MANIFEST_FILE

SHARES = (1 / 16, 1 / 4, 1 / 2)  # of the prior's people, in the smaller priors
PEOPLE = 3  # fitted unless they are named; the paper's number


def prepare(arguments: argparse.Namespace) -> Ablation:
    """Hold what was asked for against the shards and the prior.

    Raises:
        UsageError: names or numbers that cannot be.
        ArtifactError: unreadable input.
    """
    prior, dataset = read_prior(arguments.prior), Dataset(arguments.shards)
    if prior.is_head or not prior.finished:
        problem = "is a head" if prior.is_head else f"has {prior.step} of {prior.steps} steps"
        raise ArtifactError(prior.path, "steps", problem, "Give a prior whose training is finished")
    people = _people(arguments.identities, dataset, prior)
    names = [n for n in _cameras(dataset, people[0]) if all(n in _cameras(dataset, who) for who in people)]
    views = _views(arguments.views, names, dataset, people[0])
    fitted = {name for chosen in views.values() for name in chosen}
    held_out = [name for name in names if name not in fitted]
    if not held_out:
        raise UsageError(f"--views: all of the {len(names)} cameras are fitted to; leave some to evaluate")
    total = len(prior.identities)
    counts = arguments.prior_identities or sorted({max(1, round(total * share)) for share in SHARES})
    counts = sorted({count for count in counts if count < total})
    every = tables([*counts, total], prior.scene.resolution, tuple(views))
    unknown = [name for name in arguments.only or [] if name not in every]
    if unknown:
        raise UsageError(f"--only {unknown[0]}: {suggestion(unknown[0], every)}")
    chosen = tuple(every[name] for name in (arguments.only or every))
    cells = tuple(cells_of(chosen, people, arguments.seeds))
    if any(cell.variant.prior != FULL_PRIOR for cell in cells):
        _require_training_heads(prior, dataset, every)
    run = run_config(prior.configuration["preset"], arguments.device)
    priors = Priors(prior, dataset, arguments.output / "priors", run)
    ablation = Ablation(
        dataset, prior, chosen, cells, _base(arguments), views, held_out, priors, arguments.output
    )
    for cell in cells:
        check(ablation.fit(cell))
    return ablation


def _require_training_heads(prior: Prior, dataset: Dataset, every: Mapping[str, Table]) -> None:
    """Refuse to train smaller priors on others than the prior's heads, as with `--prior pretrained`.

    Raises:
        ArtifactError: naming a head that is not there, or other shards; and the tables that need no other prior.
    """
    absent = [name for name in prior.identities if name not in dataset.names]
    if absent or not _trained_on(prior, dataset):
        rest = [n for n, t in every.items() if all(row.variant.prior == FULL_PRIOR for row in t.rows)]
        problem = (
            "are not those that the prior was trained on, and smaller priors are trained on the same heads"
        )
        if absent:
            problem = f"'{absent[0]}', whom the prior was trained on, is not there, and smaller priors need them all"
        remedy = f"Give the shards that it was trained on, or --only {' '.join(rest)}"
        raise ArtifactError(dataset.manifest.path, "identities", problem, remedy)


def _base(arguments: argparse.Namespace) -> Base:
    inversion, finetuning, run = defaults(arguments.quality)
    if arguments.inversion_steps is not None:
        inversion = replace(inversion, steps=arguments.inversion_steps)
    if arguments.finetuning_steps is not None:
        finetuning = replace(finetuning, steps=arguments.finetuning_steps)
    if arguments.rays is not None:
        finetuning = replace(finetuning, rays=arguments.rays)
    # Pictures at the end of each phase only: nobody watches.
    run = replace(run, device=arguments.device, preview_every=10**9)
    return Base(arguments.shards, arguments.quality, inversion, finetuning, run)


def _people(asked: Sequence[str] | None, dataset: Dataset, prior: Prior) -> list[str]:
    """Who is fitted: those named, or the first that the prior does not know.

    In other shards than the prior's, its names may be other people's; only who ran the studio knows.
    """
    same = _trained_on(prior, dataset)
    for name in asked or []:
        if name not in dataset.names:
            raise UsageError(f"--identities {name}: {suggestion(name, dataset.names)}")
        if name in prior.identities and same:
            raise UsageError(f"--identities {name}: the prior was trained on this person; name others")
        if name in prior.identities:
            say(
                f"note: the prior knows somebody by the name '{name}', from other shards; taken for another person"
            )
    found = list(asked or [name for name in dataset.names if name not in set(prior.identities)][:PEOPLE])
    if not found and same:
        problem = "everybody was seen by the prior"
        raise ArtifactError(dataset.manifest.path, "identities", problem, "Build shards with --holdout")
    if not found:
        problem = "the prior, which was trained on other shards, knows everybody's name"
        some = " ".join(dataset.names[:PEOPLE])
        remedy = f"If these are other people, name who is fitted, such as --identities {some}"
        raise ArtifactError(dataset.manifest.path, "identities", problem, remedy)
    return found


def _trained_on(prior: Prior, dataset: Dataset) -> bool:
    """Whether these are the shards that a prior was trained on."""
    return bool(prior.provenance["inputs"].get(MANIFEST_FILE) == sha256(dataset.manifest.path))


def _cameras(dataset: Dataset, identity: str) -> dict[str, int]:
    number = dataset.names.index(identity)
    cameras = dataset.manifest.identities[number].cameras
    return {name: view for view, name in enumerate(cameras) if name is not None}


def _views(
    asked: Sequence[str] | None, names: Sequence[str], dataset: Dataset, identity: str
) -> dict[int, tuple[str, ...]]:
    """Names of the views to fit to by their number."""
    cameras = _cameras(dataset, identity)
    if asked is None:
        poses = dataset.tables["canonical_from_camera"][dataset.names.index(identity)]
        centers = np.array([poses[cameras[name], :, 3] for name in names])
        try:
            sets = view_sets(centers)
        except ValueError as error:
            raise UsageError(f"--views: {error}") from error
        return {count: tuple(names[view] for view in views) for count, views in sets.items()}
    for name in asked:
        if name not in names:
            raise UsageError(f"--views {name}: {suggestion(name, names)}")
    if len(set(asked)) not in (5, 7) or len(asked) not in (5, 7):
        raise UsageError(f"--views: {len(asked)} names; give five from one side to the other, or two more")
    chosen = {count: tuple(asked[view] for view in views) for count, views in five_views(range(5)).items()}
    return chosen | ({7: tuple(asked)} if len(asked) == 7 else {})


def parser() -> argparse.ArgumentParser:
    """The command line."""
    found = Parser("ablate.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("shards", type=Path, help="folder of the shards")
    found.add_argument(
        "--prior",
        type=prior_flag,
        required=True,
        help="folder of the full prior; `pretrained` is the one that comes with preface",
    )
    found.add_argument("--output", type=Path, required=True, help="folder to write, or to go on with")
    found.add_argument("--only", nargs="+", metavar="TABLE", help=f"some of {', '.join(PAPER)}")
    found.add_argument(
        "--identities", nargs="+", help=f"who is fitted (default: {PEOPLE} whom the prior does not know)"
    )
    found.add_argument("--seeds", type=whole_number(0), nargs="+", default=[0, 1], help="default: 0 1")
    found.add_argument(
        "--views",
        nargs="+",
        metavar="CAMERA",
        help="five cameras from one side to the other, and two more (default: by their directions)",
    )
    found.add_argument("--quality", choices=list(QUALITIES), default="balanced", help="of the full method")
    found.add_argument(
        "--inversion-steps", type=whole_number(1), metavar="N", help="other than the quality's"
    )
    found.add_argument("--finetuning-steps", type=whole_number(1), metavar="N", help="likewise")
    found.add_argument("--rays", type=whole_number(1), metavar="N", help="per step of finetuning, likewise")
    found.add_argument(
        "--prior-identities",
        type=whole_number(1),
        nargs="+",
        metavar="N",
        help="up to three numbers of people to train smaller priors on (default: 1/16, 1/4 and 1/2)",
    )
    found.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    found.add_argument("--plan", action="store_true", help="say what would be done and how long it takes")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    line = parser()
    config = line.parse_args(arguments)
    if config.prior_identities and len(config.prior_identities) > len(SHARES):
        line.error(
            f"--prior-identities: {len(config.prior_identities)} numbers; the paper has three below all"
        )

    def run() -> Sequence[str]:
        ablation = prepare(config)
        if config.plan:
            return ablation.plan()
        keep_freed_memory()
        with denormals_flushed():
            return ablation.run()

    try:
        reasons = (TrainingError, TrainingConfigError)
        return resumable(lambda: exit_status(run, line, line.prog, lambda: reasons))
    except StoppedError as stopped:
        print(stopped, file=sys.stderr)
        return stopped.status


if __name__ == "__main__":
    sys.exit(main())
