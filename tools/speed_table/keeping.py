"""Measurements that stay with the repository: what the benches wrote, without the paths of the machine they ran on.

A kept file is ``tools/measured/<source>-<name>.json``:

    {"source": "calibration", "of": "520 images of 1024x1536 ...", "measured": ...}

`measured` is what the source's script wrote, every number as it was; of paths only the last part is left. A prior's
folder is measured by what it says of itself: `training_summary`.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError, load_json, write_bytes
from preface.model.training.logs import LOG_FILE, read_log
from preface.model.training.prior_files import read_prior

# A path from the root or from home: "/data/studio", but neither "1/2" nor "a / b" nor what follows "https:".
_PATH = re.compile(r"(?<![\w.)/@+-])~?/(?:[\w.@+-]+/)*([\w.@+-]+)/?")
TRAINING = "training"  # the source that is a folder


@dataclass(frozen=True)
class Kept:
    """A measurement that was kept.

    Attributes:
        path: of its file.
        source: what measured it, a key of `stages.SCRIPTS`.
        of: what was measured on which machine, in words.
        measured: as its script wrote it.
    """

    path: Path
    source: str
    of: str
    measured: Any


def keep(source: str, name: str, of: str, given: Path, folder: Path) -> Path:
    """Copy a measurement to where the table is made from.

    Args:
        source: what wrote it.
        name: of this measurement among those of its source, "" for the only one.
        of: what was measured on which machine, in words.
        given: JSON of a bench; the folder of a prior for `TRAINING`.
        folder: of what is kept.

    Returns:
        The file.

    Raises:
        ArtifactError: unreadable, or the disk refuses.
        OSError: of a prior's folder, there is no log.
    """
    measured = training_summary(given) if source == TRAINING else _read(given)
    content = {"source": source, "of": of, "measured": without_paths(measured)}
    path = folder / f"{source}{f'-{name}' if name else ''}.json"
    return write_bytes(path, (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode())


def read_kept(folder: Path) -> list[Kept]:
    """Everything that was kept, by name.

    Raises:
        ArtifactError: a file is not what `keep` writes.
    """
    found = []
    for path in sorted(folder.glob("*.json")):
        content = load_json(path)
        for key in ("source", "of", "measured"):
            if key not in content:
                remedy = "Keep the bench's JSON again by tools/speed_for_accuracy.py keep"
                raise ArtifactError(path, key, "is missing", remedy)
        found.append(Kept(path, content["source"], content["of"], content["measured"]))
    return found


def without_paths(value: Any) -> Any:
    """JSON data of whose absolute paths, in strings and keys, only the last part is left."""
    if isinstance(value, str):
        return _PATH.sub(r"\1", value)
    if isinstance(value, list):
        return [without_paths(item) for item in value]
    if isinstance(value, dict):
        return {without_paths(key): without_paths(item) for key, item in value.items()}
    return value


def training_summary(folder: Path) -> dict[str, Any]:
    """What a prior cost and reached, by its model.json and log.jsonl.

    `seconds` are those of the steps alone: rays over rays per second, summed over the log, whose later lines of a step
    replace earlier ones.

    Raises:
        ArtifactError: no prior.
        OSError: no log.
    """
    prior = read_prior(folder)
    settings = prior.configuration["training"]
    rays = settings["identities"] * settings["views"] * settings["rays"]
    lines = read_log(folder / LOG_FILE, "train")
    rates = {int(line["step"]): float(line["rays_per_second"]) for line in lines}
    seconds, before = 0.0, 0
    for step in sorted(rates):
        seconds += (step - before) * rays / rates[step]
        before = step
    return {
        "preset": prior.configuration["preset"],
        "matmul": prior.model.matmul,
        "steps": prior.step,
        "rays_per_step": rays,
        "people": len(prior.identities),
        "resolution": load_json(prior.path)["resolution"],
        "seconds": seconds,
        "validation": dict(prior.validation),
    }


def _read(path: Path) -> Any:
    """JSON that may be a list, as some benches write it."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ArtifactError.from_os(path, "reading", error) from error
    except ValueError as error:
        raise ArtifactError(path, "file", f"is not JSON: {error}", "Give what a bench wrote") from error
