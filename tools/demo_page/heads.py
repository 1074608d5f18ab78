"""The heads that the demo made of one new person, best prior first: their fits, figures, priors and words.

`tools/demo.sh` fits the same two photographs from the prior that was trained in the demo, from the one that comes with
preface, and from no prior; with ``--pretrained`` from the latter two alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, load_json, sha256
from preface.model.pretrained import pretrained_folder
from preface.model.training.prior_files import MODEL_FILE, Prior, read_prior

HEAD, BASELINE, FROM_THE_BOX = (
    "head",
    "head-without-prior",
    "head-pretrained",
)  # folders, names in evaluations
# Of what has folders of its own for the head from the box, since that stands in the canonical frame of its prior.
SUFFIX = "-pretrained"
BOX, OWN, NONE = "the prior in the box", "this demo's prior", "no prior"


@dataclass(frozen=True)
class Head:
    """A head, and where the demo put what belongs to it.

    Attributes:
        demo: the folder that tools/demo.sh filled.
        name: of its folder, and in evaluations.
        start: what it was fitted from, in words.
    """

    demo: Path
    name: str
    start: str

    @cached_property
    def model(self) -> Prior:
        """What its model.json says."""
        return read_prior(self.demo / self.name)

    @property
    def fit(self) -> Mapping[str, Any]:
        """What it was fitted to and how (data_specs/prior.md)."""
        if self.model.fit is None:
            raise ArtifactError(self.model.path, "fit", "is not a head", "Run tools/demo.sh")
        return self.model.fit

    @property
    def steps(self) -> int:
        """Of inversion and finetuning."""
        return self.model.steps

    @property
    def suffix(self) -> str:
        """That of the folders which only this head has."""
        return SUFFIX if self.name == FROM_THE_BOX else ""

    @property
    def evaluation(self) -> Path:
        """Its folder of the evaluation."""
        return self.demo / f"evaluation{self.suffix}" / self.name

    @cached_property
    def metrics(self) -> Mapping[str, Any]:
        """Its metrics.json."""
        return load_json(self.evaluation / "metrics.json")

    @cached_property
    def geometry(self) -> Mapping[str, Any] | None:
        """Its errors against the studio's truth by view, as tools/bench/head_truth.py wrote them, if it did."""
        file = self.demo / f"geometry{self.suffix}.json"
        if not file.exists():
            return None
        found = [head for head in load_json(file)["heads"] if Path(head["head"]).name == self.name]
        if not found:
            raise ArtifactError(file, "heads", f"there is no '{self.name}'", "Run tools/demo.sh again")
        return dict(found[0])

    @property
    def pictures_of_geometry(self) -> Path:
        """The folder of the pictures to `geometry`."""
        return self.demo / "geometry" / self.name

    @property
    def renders(self) -> Path:
        """The folder of its orbit; the baseline has none."""
        return self.demo / f"renders{self.suffix}"


def heads_of(folder: Path) -> list[Head]:
    """The heads of a demo, from the prior of the most people to none.

    Raises:
        ArtifactError: the first is missing, or is no head.
    """
    own = (folder / "prior" / MODEL_FILE).exists()
    found = [Head(folder, HEAD, OWN if own else BOX), Head(folder, BASELINE, NONE)]
    if (folder / FROM_THE_BOX / MODEL_FILE).exists():
        found.insert(0, Head(folder, FROM_THE_BOX, BOX))
    for head in found:
        _ = head.fit
    return found


def prior_of(head: Head) -> Prior:
    """The prior that a head was fitted from.

    Raises:
        ArtifactError: it has changed since.
    """
    prior = read_prior(head.demo / "prior" if head.start == OWN else pretrained_folder())
    if sha256(prior.path) != head.fit["prior"]:
        problem, remedy = f"is not that of {prior.path}", "Delete the folder, and run tools/demo.sh again"
        raise ArtifactError(head.demo / head.name, "fit.prior", problem, remedy)
    return prior


def words_about(prior: Prior, start: str) -> str:
    """A prior in a sentence: who it was trained on, for how long, and what it reaches on views of these people."""
    whence = "was trained here" if start == OWN else "comes with preface and was trained"
    words = f"{start[0].upper()}{start[1:]} {whence} on {len(prior.identities)} people who do not exist"
    reached = prior.validation.get("psnr_foreground")
    of_them = "" if reached is None else f"; in views kept away it shows their heads at {reached:.1f} dB"
    return f"{words}, for {prior.steps:,} steps{of_them}."


def same_views(heads: Sequence[Head]) -> list[str]:
    """Names of the views that all heads were measured at, in the order of the evaluation.

    Raises:
        ArtifactError: there is none.
    """
    measured = [[view["name"] for view in head.metrics["views"]] for head in heads]
    names = [name for name in measured[0] if all(name in others for others in measured)]
    if not names:
        raise ArtifactError(heads[0].evaluation, "views", "no view has all heads", "Run tools/demo.sh again")
    return names
