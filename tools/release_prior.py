"""From a trained prior to the one that comes with preface: weights, template, description and model card.

    python tools/release_prior.py prior --shards shards --stages stages.tsv \\
        --metrics evaluation/*/head --baseline evaluation/*/alone --machine "one H200 GPU"

The figures are of heads that were fitted, from the prior and from nothing, to people that it has not seen
(`preface-fit`, then `preface-evaluate`). STAGES has a line per command that led to the prior, NAME, SECONDS and
COMMAND between tabs, as `tools/demo.sh` writes it, with paths below one folder.

Everything is held against everything: the shards are those that the prior was trained on, the heads were fitted from
it, to others than its people. What serves only to go on training is left out, and so is where things lay on the disk.
Prints the path of the card last.
"""

from __future__ import annotations

import hashlib
import re
import shlex
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import tyro

from demo_page.stages import Stage, read_stages
from model_card import Facts, Result, model_card
from preface.artifacts import ArtifactError, load_json, sha256, validate, write_bytes
from preface.cli.folders import make_folder
from preface.cli.output import exit_status, interruptible
from preface.cli.typed_flags import refusing, told_in_a_line
from preface.model.evaluation.metrics_file import read_metrics
from preface.model.pretrained import CARD_FILE, FILES, FOLDER
from preface.model.training.checkpoint import WEIGHTS, write_checkpoint
from preface.model.training.folder import TEMPLATE_FILE
from preface.model.training.prior_files import Prior, prior_payload, read_prior
from preface.plain_words import json_text
from preface.shards.manifest import Manifest, read_manifest

PROGRAM = "release_prior"
MAX_BYTES = 8_000_000  # of all files; a package is not the place for more
OWN_MATERIALS = "--assets"  # of the studio: whatever is under it may not be passed on


@dataclass(frozen=True)
class ReleasePrior:
    """Make the prior that comes with preface."""

    prior: tyro.conf.Positional[Path]
    """Folder of the trained prior, with template.json."""
    shards: Path
    """Folder of the shards that it was trained on; only their manifest is read."""
    stages: Path
    """File of the commands that led to it and their seconds."""
    metrics: tuple[Path, ...]
    """metrics.json, or their folders, of heads that were fitted from it."""
    baseline: tuple[Path, ...] = ()
    """Those of heads that were fitted from nothing."""
    machine: str = ""
    """What it was trained on, in words."""
    output: Path = FOLDER
    """Where the files go; by default into the package."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool: 0 when the files are written, 1 when something is wrong."""
    with told_in_a_line(PROGRAM):
        config = tyro.cli(ReleasePrior, prog=PROGRAM, args=arguments)
    return interruptible(lambda: exit_status(lambda: [str(release(config))], refusing(PROGRAM), config.prior))


def release(config: ReleasePrior) -> Path:
    """Check everything, and then put the files in place; returns the path of the card.

    Raises:
        ArtifactError: an input is not what it must be, belongs to another prior, or the release is too large.
    """
    trained = _finished(config.prior)
    manifest = _shards_of(trained, config.shards)
    stages = _stages(config.stages)
    with tempfile.TemporaryDirectory(prefix="release_prior-") as name:
        made = Path(name)
        prior, parameters = _written(trained, made)
        known = {sha256(trained.path), sha256(prior.path)}
        results = [_result(path, trained, known, True) for path in config.metrics]
        results += [_result(path, trained, known, False) for path in config.baseline]
        if not results or not results[0].from_prior:
            problem, remedy = "there are none", "Evaluate heads that were fitted from the prior"
            raise ArtifactError(config.prior, "--metrics", problem, remedy)
        data = {name: (made / name).read_bytes() for name in FILES if name != CARD_FILE}
        files = {name: (len(d), hashlib.sha256(d).hexdigest()) for name, d in data.items()}
        facts = Facts(
            prior, sha256(trained.path), parameters, manifest, stages, config.machine, results, files
        )
        data[CARD_FILE] = model_card(facts).encode()
    _require_small(config.prior, data)
    return _placed(data, config.output)


# -------------------------------------------------------------------------------------- the inputs


def _finished(folder: Path) -> Prior:
    prior = read_prior(folder)
    if prior.is_head or not prior.finished:
        problem = "is a head" if prior.is_head else f"has {prior.step} of {prior.steps} steps"
        raise ArtifactError(prior.path, "steps", problem, "Give a prior whose training is finished")
    return prior


def _shards_of(prior: Prior, shards: Path) -> Manifest:
    manifest = read_manifest(shards)
    theirs, ours = prior.provenance["inputs"].get("manifest.json"), sha256(manifest.path)
    if theirs != ours:
        problem = f"has the SHA-256 {ours}, and {prior.path} was trained on shards with {theirs}"
        raise ArtifactError(manifest.path, "sha256", problem, "Give the shards that it was trained on")
    return manifest


def _stages(path: Path) -> Sequence[Stage]:
    """The commands; refused where they name places of a disk, or materials that may not be passed on."""
    stages = read_stages(path)
    if not stages:
        raise ArtifactError(path, "file", "is empty", "Write a line per command: NAME, SECONDS, COMMAND")
    for stage in stages:
        try:
            words = shlex.split(stage.command)
        except ValueError as error:
            raise ArtifactError(path, stage.name, f"is no command ({error})", "Correct the quotes") from error
        if OWN_MATERIALS in {word.partition("=")[0] for word in words}:
            problem = f"{OWN_MATERIALS}: these materials may not be passed on, nor what was learned from them"
            raise ArtifactError(path, stage.name, problem, "Train on heads of the studio's own materials")
        for word in words:
            if _is_absolute(word.partition("=")[2] or word):
                problem = f"'{word}' says where things lay on a disk"
                raise ArtifactError(path, stage.name, problem, "Write paths below one folder")
    return stages


def _result(path: Path, prior: Prior, known: set[str], from_prior: bool) -> Result:
    """The figures of a head, once they are known to be of this prior and of nobody that it knows."""
    content = read_metrics(path)
    fit = content.get("fit")
    if fit is None:
        raise ArtifactError(path, "fit", "is not of a head", "Evaluate heads that were fitted by preface-fit")
    identity = content["identity"]
    if from_prior and fit["prior"] not in known:
        problem = f"'{identity}' was fitted from another prior, or from none"
        raise ArtifactError(path, "fit.prior", problem, f"Fit it from {prior.path.parent}")
    if not from_prior and fit["prior"] is not None:
        problem = f"'{identity}' was fitted from a prior"
        raise ArtifactError(path, "fit.prior", problem, "Fit it with --prior none, or give it by --metrics")
    same_shards = fit["shards"]["manifest"] == prior.provenance["inputs"]["manifest.json"]
    if same_shards and identity in prior.identities:  # of other shards, a name says nothing
        problem = f"'{identity}' is one of the prior's own people"
        raise ArtifactError(path, "identity", problem, "Measure on people that it has not seen")
    if any(view["fitted"] for view in content["views"]):
        raise ArtifactError(
            path, "views", f"some were fitted to '{identity}'", "Measure on views that were kept away"
        )
    views, count = tuple(fit["views"]), len(content["views"])
    return Result(identity, views, fit["quality"], count, content["mean"], from_prior)


# -------------------------------------------------------------------------------------- the outputs


def _written(trained: Prior, folder: Path) -> tuple[Prior, int]:
    """Write weights, description and template as they are released; returns the prior and its number of parameters.

    Whatever it was trained with, it multiplies in float32, as its weights are: bfloat16 is slow on many processors.
    """
    model = trained.load_model()
    plain = replace(
        trained,
        model=replace(trained.model, matmul="fp32"),
        configuration=without_places(trained.configuration),
        provenance=without_places(trained.provenance),
    )
    write_checkpoint(folder, prior_payload(plain), {WEIGHTS: model.state_dict()})
    source = trained.path.parent / TEMPLATE_FILE
    template = without_places(load_json(source))
    validate(template, source, "preface/template")
    write_bytes(folder / TEMPLATE_FILE, f"{json_text(template)}\n".encode())
    return read_prior(folder), sum(parameter.numel() for parameter in model.parameters())


def without_places(value: Any) -> Any:
    """JSON data whose absolute paths are reduced to their last part."""
    if isinstance(value, Mapping):
        return {key: without_places(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_places(item) for item in value]
    if isinstance(value, str) and _is_absolute(value):
        return re.split(r"[\\/]", value.rstrip("\\/"))[-1]
    return value


def _is_absolute(text: str) -> bool:
    return PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute() or text.startswith("~")


def _require_small(prior: Path, data: Mapping[str, bytes]) -> None:
    total = sum(map(len, data.values()))
    if total > MAX_BYTES:
        problem = f"come to {total:,} bytes, and a release has at most {MAX_BYTES:,}"
        raise ArtifactError(prior, "files", problem, "Train a smaller model, such as --preset small")


def _placed(data: Mapping[str, bytes], output: Path) -> Path:
    """Put files in place, what readers look for last."""
    make_folder(output)
    for name in FILES:
        write_bytes(output / name, data[name])
    return output / CARD_FILE


if __name__ == "__main__":
    sys.exit(main())
