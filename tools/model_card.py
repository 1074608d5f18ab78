"""The model card of the prior that comes with preface, as Markdown: its people, how it was made, how far to trust it.

`tools/release_prior.py` finds the facts and holds them against each other; here they become words. What a reader has to
be told whatever was trained (the source of the heads, limits, uses that are ruled out) is written here.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import metadata, version
from statistics import fmean

from demo_page.stages import Stage
from preface.model.training.prior_files import Prior
from preface.shards.manifest import Manifest

# Of metrics.json: what the table shows, where all heads have it.
FIGURES = {
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
    "lpips": "LPIPS (VGG)",
    "psnr_face": "face PSNR, dB",
    "ssim_face": "face SSIM",
    "lpips_face": "face LPIPS (VGG)",
}

_INTRODUCTION = """\
A model of synthetic heads, from which `preface-fit` starts (`--prior pretrained`, its default): a Mip-NeRF 360 with a
code per head, trained on pictures of heads that do not exist. It is here so that one to seven photographs can become a
head without training anything first, and so that results can be compared. It is not a model of any population."""

# Of anny's licences its package says nothing that a program can read; its repository does.
_HEADS = """\
Every head is made by the synthetic studio of this repository (`tools/synthetic_studio`). Nobody was photographed.

- Shapes: anny {anny}, a parametric human (code Apache-2.0, data CC0), its phenotypes and face controls drawn at random.
- Skin, brows, lashes, facial hair, hair and eyes: made by the studio's own code, {license}. None of the MakeHuman
  materials that the studio can use from a user's disk (`--assets`) were used, since these may not be passed on.
- Light: one soft studio light. Faces are close to neutral.
- Cameras, alignment and masks are what `preface-calibrate`, `preface-align` and `preface-build-shards` found in the
  pictures, with their errors; the studio's truth was not used.

The weights, like the code, are under {license}; see LICENSE."""

_LIMITS = """\
- Synthetic faces only. Real skin, hair and eyes are finer and more varied than anything it has seen; finetuning adds
  what the photographs show, and only there. What no photograph shows comes from these heads, and is invented.
- Faces close to neutral, in one light, without glasses, hats or hands. The photographs' light is baked into a head.
- Ages, body types and ancestries are those of anny's phenotypes, which simplify, with hairstyles and colours that the
  studio draws by chances of its own. Who looks unlike them is fitted worse, and the figures above do not say by how
  much: they are of synthetic people, too.
- It knows no more of the backs of heads than its cameras saw, and nothing finer than the pixels it was trained on.
- Geometry is a by-product. Look at `preface-evaluate` and at `trust.html` of a fit before measuring anything on it."""

_RULED_OUT = """\
- Identifying or verifying people, or finding them in pictures; surveillance of any kind. The code of a fit must not
  serve as a face embedding.
- Impersonation: showing real people doing or saying what they did not, or passing off a head as a photograph.
- Making heads of people who have not agreed to it.
- Inferring ancestry, ethnicity, sex, age, health, emotions, character, orientation or beliefs from faces, or deciding
  anything about people by them.
- Medical, forensic or safety-critical measurement."""


@dataclass(frozen=True)
class Result:
    """A person whom the prior has not seen: fitted to some views, measured on others.

    Attributes:
        identity: who.
        views: the cameras that were fitted to.
        quality: of `preface-fit`.
        measured: views that were measured, none of them fitted to.
        mean: figure -> mean over these.
        from_prior: whether the head was fitted from the prior, or from random weights.
    """

    identity: str
    views: tuple[str, ...]
    quality: str
    measured: int
    mean: Mapping[str, float]
    from_prior: bool


@dataclass(frozen=True, eq=False)
class Facts:
    """What was found out about a prior.

    Attributes:
        prior: as it is released.
        trained: SHA-256 of model.json as it was trained.
        parameters: numbers in the weights, codes among them.
        manifest: of the shards that it was trained on.
        stages: the commands, in order, with the seconds that each took.
        machine: that they ran on, in words.
        results: on people that it has not seen.
        files: name -> bytes and SHA-256, of the other files of the release.
    """

    prior: Prior
    trained: str
    parameters: int
    manifest: Manifest
    stages: Sequence[Stage]
    machine: str
    results: Sequence[Result]
    files: Mapping[str, tuple[int, str]]


def model_card(facts: Facts) -> str:
    """The card."""
    prior = facts.prior
    width, height = prior.scene.resolution
    code_license = str(metadata("preface")["License-Expression"])
    parts = [
        f"---\nlicense: {code_license.lower()}\ntags: [nerf, faces, synthetic]\n---",
        "# The prior that comes with preface",
        _INTRODUCTION,
        f"{len(prior.identities)} heads, {facts.parameters:,} parameters, views of {width}x{height} pixels, within "
        f"a box of {_box(prior)} m about the face. Format: `data_specs/prior.md`. `preface-inspect pretrained` checks "
        "and summarises it.",
        "## What it was trained on",
        _HEADS.format(anny=version("anny"), license=code_license),
        _dataset(facts),
        "## How it was trained",
        _training(facts),
        "## What it reaches",
        _figures(facts),
        "## Limits",
        _LIMITS,
        "## What it must not be used for",
        _RULED_OUT,
        "## Files",
        _files(facts),
    ]
    return "\n\n".join(parts) + "\n"


def _box(prior: Prior) -> str:
    return " x ".join(f"{side:g}" for side in (prior.scene.box[1] - prior.scene.box[0]).round(6))


def _dataset(facts: Facts) -> str:
    """The shards, from their manifest."""
    manifest, known = facts.manifest, set(facts.prior.identities)
    views = sum(name is not None for entry in manifest.identities for name in entry.cameras)
    splits = ", ".join(f"{len(names)} in split `{name}`" for name, names in manifest.splits.items())
    apart = sum(len(names) for name, names in facts.prior.held_out.items() if name in known)
    settings = manifest.provenance["config"]
    masks = sorted({found["method"] for found in settings.get("foreground", {}).values()})
    lines = [
        f"The shards hold {len(manifest.identities)} heads ({splits}) in {views:,} views of "
        f"{manifest.width}x{manifest.height} pixels; {len(known)} heads were trained on, less {apart} views that were "
        "kept away to measure on.",
        f"SHA-256 of their manifest: `{facts.prior.provenance['inputs']['manifest.json']}`.",
    ]
    if masks:
        lines.insert(1, f"Masks: {', '.join(masks)}.")
    return " ".join(lines)


def _training(facts: Facts) -> str:
    prior, trained = facts.prior, facts.prior.configuration["model"]["matmul"]
    rows = [(s.name, _time(s.seconds), f"`{shlex.join(shlex.split(s.command))}`") for s in facts.stages]
    where = f", on {facts.machine}" if facts.machine else ""
    lines = [
        f"Preset `{prior.configuration.get('preset')}`, seed {prior.provenance['seed']}, {prior.steps:,} steps{where}. "
        f"`model.json` has every setting and the versions of all packages. Its products were {trained}; released, it "
        f"multiplies in {prior.model.matmul}. From nothing:",
        "\n".join(
            ["| stage | time | command |", "|---|---|---|", *(f"| {' | '.join(row)} |" for row in rows)]
        ),
    ]
    return "\n\n".join(lines)


def _time(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _figures(facts: Facts) -> str:
    """Own held-out views, then people that it has not seen, with the prior and without."""
    parts = []
    found = facts.prior.validation
    if found:
        parts.append(
            f"Views of its own people that it was not trained on: {found['psnr']:.2f} dB where rays meet the box, "
            f"{found['psnr_foreground']:.2f} dB on the heads ({found['views']} views)."
        )
    people = sorted({result.identity for result in facts.results})
    parts.append(
        f"People that it has not seen ({', '.join(people)}), fitted by `preface-fit` and measured by "
        "`preface-evaluate` on views that were kept away; means over people:"
    )
    shown = [name for name in FIGURES if all(name in result.mean for result in facts.results)]
    head = ["fitted to", "quality", "from", "people", "views measured", *(FIGURES[name] for name in shown)]
    rows = [head, ["---"] * len(head)]
    groups: dict[tuple[int, str, bool], list[Result]] = {}
    for result in facts.results:
        groups.setdefault((len(result.views), result.quality, not result.from_prior), []).append(result)
    for (views, quality, alone), group in sorted(groups.items()):
        means = [_number(fmean(result.mean[name] for result in group)) for name in shown]
        count = f"{views} view{'s' if views > 1 else ''}"
        start = "nothing" if alone else "this prior"
        rows.append([count, quality, start, str(len(group)), str(sum(r.measured for r in group)), *means])
    parts.append("\n".join(f"| {' | '.join(row)} |" for row in rows))
    return "\n\n".join(parts)


def _number(value: float) -> str:
    """Decibels to two decimals, what lies between 0 and 1 to four."""
    return f"{value:.2f}" if value >= 1 else f"{value:.4f}"


def _files(facts: Facts) -> str:
    rows = [f"| `{name}` | {size:,} | `{digest}` |" for name, (size, digest) in facts.files.items()]
    return (
        "| file | bytes | SHA-256 |\n|---|---|---|\n"
        + "\n".join(rows)
        + f"\n\nMade by `tools/release_prior.py` from a prior whose `model.json` had the SHA-256 `{facts.trained}`."
    )
