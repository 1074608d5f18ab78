"""The dataset's README: what it holds, how it was made, what was left out, and how to read it, for a person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from preface.plain_words import counted, disk_space
from preface.shards.dataset.configuration import BuildConfiguration
from preface.shards.dataset.people import LeftOut, Person
from preface.shards.dataset.tasks import TaskResult
from preface.shards.format import BACKGROUND_KINDS, shard_name
from preface.shards.shard import Shard

CARD_FILE = "README.md"
MAX_LISTED = 100  # left out views and remarks; the manifest has all of them

_READING = """```python
from preface.shards import Dataset, Loader, PaperPattern

dataset = Dataset("{name}")                                   # this folder
sampler = PaperPattern(dataset.index("train"), seed=0)
loader = Loader(dataset, sampler, device="cpu", scale=dataset.manifest.scene_scale)
for step, batch in loader.batches(start=0, stop=1000):
    batch.origins, batch.directions, batch.rgb, batch.alpha, batch.identity      # float32 [n, 3], ...
```

Any safetensors library reads the files too: `pixels` is uint8 [K, V, H, W, 4] (sRGB and foreground share), the cameras
are `intrinsics` and `canonical_from_camera`. `preface-inspect .` verifies every byte."""


@dataclass(frozen=True)
class Entry:
    """One identity: its names, split and number of views, the file it is in, what is odd (camera -> sentences)."""

    identity: str
    take: str
    split: str
    views: int
    file: str
    backgrounds: tuple[str, ...]
    methods: tuple[str, ...]
    remarks: Mapping[str, Sequence[str]]


@dataclass(frozen=True, eq=False)
class Contents:
    """What the papers of a dataset tell.

    Attributes:
        name: of the dataset.
        entries: the identities in the dataset's order.
        files: shard -> bytes and SHA-256.
        settings: of the command.
        configuration: of the dataset.
        size: width, height, pixels.
    """

    name: str
    entries: tuple[Entry, ...]
    files: Mapping[str, tuple[int, str]]
    settings: Mapping[str, Any]
    configuration: BuildConfiguration

    @staticmethod
    def read(
        folder: Path,
        name: str,
        results: Sequence[TaskResult],
        splits: Mapping[str, Sequence[str]],
        people: Mapping[str, Person],
        settings: Mapping[str, Any],
        configuration: BuildConfiguration,
    ) -> Contents:
        """Collect it from finished shards.

        Raises:
            ArtifactError: a shard is missing or damaged.
        """
        split_of = {identity: split for split, names in splits.items() for identity in names}
        entries, files = [], {}
        for result in results:
            path = folder / shard_name(result.number)
            with Shard(path) as shard:
                files[path.name] = shard.layout.file_bytes, result.sha256
                for place, person in enumerate(shard.people):
                    valid = shard.tables["view_valid"][place] == 1
                    kinds = shard.tables["background_kind"][place][valid]
                    identity, metadata = person["identity"], person["metadata"]
                    entries.append(
                        Entry(
                            identity,
                            person["take"],
                            split_of[identity],
                            int(valid.sum()),
                            path.name,
                            tuple(BACKGROUND_KINDS[kind] for kind in kinds),
                            tuple(mask["method"] for mask in metadata["masks"].values()),
                            metadata.get("remarks", {}),
                        )
                    )
        return Contents(name, tuple(entries), files, settings, configuration)

    @property
    def bytes(self) -> int:
        """Of all shards."""
        return sum(size for size, _ in self.files.values())

    @property
    def views(self) -> int:
        """Of all identities."""
        return sum(entry.views for entry in self.entries)


def data_card(contents: Contents, left_out: Sequence[LeftOut], pages: Mapping[str, str]) -> str:
    """The README, Markdown with the front matter that dataset hubs read.

    Args:
        contents: of the dataset.
        left_out: people and views that are not in it.
        pages: title -> file of further pages.
    """
    chosen = contents.configuration
    splits = Counter(entry.split for entry in contents.entries)
    lines = [
        "---",
        f"pretty_name: {contents.name}",
        "license: other",
        "task_categories: [image-to-3d]",
        "tags: [nerf, multi-view, faces, croissant]",
        "---",
        "",
        f"# {contents.name}",
        "",
        f"{counted(len(contents.entries), 'head', 'heads')} in {counted(contents.views, 'posed view', 'posed views')} "
        f"of {chosen.width}x{chosen.height} pixels, {counted(len(contents.files), 'shard', 'shards')}, "
        f"{disk_space(contents.bytes)}. Made by `preface-build-shards`; the format is described in "
        "`data_specs/shards.md` of preface.",
        "",
        "The pictures show people. Whoever passes this dataset on answers for their consent and for the terms of the "
        "capture that it was made from; nothing in this folder grants a licence.",
        "",
        "## What is in it",
        "",
        "| | |",
        "|---|---|",
        *(f"| identities in split `{split}` | {count} |" for split, count in sorted(splits.items())),
        *_counts("views with background", (kind for entry in contents.entries for kind in entry.backgrounds)),
        *_counts("views with foreground by", (m for entry in contents.entries for m in entry.methods)),
        f"| views per identity | {_range([entry.views for entry in contents.entries])} |",
        f"| bytes per ray | {contents.bytes / max(1, contents.views * chosen.width * chosen.height):.4f} |",
        f"| box of a head, canonical metres | {_corner(chosen.box[:3])} to {_corner(chosen.box[3:])} |",
        "",
        "## How it was made",
        "",
        f"- Framing `{chosen.framing}`, filter `{chosen.filter}` in `{chosen.light}` light, undistortion "
        f"`{chosen.undistort}`, pixel order `{chosen.pixel_order}`, white of linear images {chosen.white:g}.",
        *(
            f"- Foreground of take `{take}`: `{found['method']}`, because {found['reason']}."
            for take, found in contents.settings["foreground"].items()
        ),
        *(f"- {title}: [{file}]({file})." for title, file in pages.items()),
        "- `manifest.json` has the configuration, the versions of all packages, and the SHA-256 of every source and "
        "shard.",
        "",
        "## What was left out",
        "",
        *_listed([_safe(str(entry)) for entry in left_out], "Nothing."),
        "",
        "## What is odd",
        "",
        *_listed(
            [
                _safe(f"{entry.identity}/{camera}: {'; '.join(words)}")
                for entry in contents.entries
                for camera, words in entry.remarks.items()
            ],
            "Nothing that was noticed.",
        ),
        "",
        "## Reading it",
        "",
        _READING.format(name="."),
    ]
    return "\n".join(lines) + "\n"


def _counts(words: str, values: Any) -> list[str]:
    return [f"| {words} `{value}` | {count} |" for value, count in sorted(Counter(values).items())]


def _range(numbers: Sequence[int]) -> str:
    low, high = min(numbers), max(numbers)
    return str(low) if low == high else f"{low} to {high}"


def _corner(numbers: Sequence[float]) -> str:
    return "(" + ", ".join(f"{number:g}" for number in numbers) + ")"


def _listed(lines: Sequence[str], otherwise: str) -> list[str]:
    if not lines:
        return [otherwise]
    more = len(lines) - MAX_LISTED
    rest = [f"- ... and {more} more; `manifest.json` has all."] if more > 0 else []
    return [f"- {line}" for line in lines[:MAX_LISTED]] + rest


def _safe(text: str) -> str:
    """Text that Markdown shows as it is."""
    clean = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    for sign in "\\`*_[]<>|":
        clean = clean.replace(sign, "\\" + sign)
    return clean
