"""The prior that comes with preface: its files lie in this folder, and commands know it as ``pretrained``.

    prior = read_prior("pretrained")

MODEL_CARD.md beside this file says which people it was trained on, how, what it reaches and what it must not be used
for. ``tools/release_prior.py`` makes the files from a prior that was trained. Nothing here imports torch.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from preface.artifacts import ArtifactError

PRETRAINED: Final = "pretrained"
FOLDER = Path(__file__).parent
CARD_FILE = "MODEL_CARD.md"
# model.json is what a reader looks for, so that it is put in place last.
FILES = ("model.safetensors", "template.json", CARD_FILE, "model.json")


def pretrained_folder() -> Path:
    """The folder of the prior that comes with preface.

    Raises:
        ArtifactError: this preface was installed without it, or with a part of it.
    """
    missing = [name for name in FILES if not (FOLDER / name).is_file()]
    if missing:
        problem = f"this preface was installed without it ({', '.join(missing)} missing)"
        remedy = "Install one that has them, or give the folder of a prior that preface-train wrote"
        remedy += ", or --prior none to preface-fit"
        raise ArtifactError(FOLDER, PRETRAINED, problem, remedy)
    return FOLDER


def prior_path(given: str | os.PathLike[str]) -> Path:
    """The path that is meant: the text `pretrained` is the prior that comes with preface, all else is itself.

    A folder of one's own that has this name is ``./pretrained``, or any `Path`.

    Raises:
        ArtifactError: as `pretrained_folder`.
    """
    return pretrained_folder() if given == PRETRAINED else Path(given)


def prior_flag(text: str) -> str | Path:
    """The type of a flag that takes a prior; the word `pretrained` stays one until the prior is read."""
    return text if text == PRETRAINED else Path(text)


def flag_word(given: object) -> str:
    """What to write where a command reads it by `prior_flag`, so that a path stays one whatever its name is."""
    return f"./{given}" if given == Path(PRETRAINED) else str(given)
