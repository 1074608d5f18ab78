"""Which identities and views of a dataset are exported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from preface.artifacts import ArtifactError
from preface.plain_words import suggestion
from preface.shards.reader import Dataset


@dataclass(frozen=True)
class Person:
    """An identity and its views.

    Attributes:
        number, name: of the identity.
        views: numbers of the views, at least one.
        cameras: their names.
    """

    number: int
    name: str
    views: tuple[int, ...]
    cameras: tuple[str, ...]


@dataclass(frozen=True)
class Selection:
    """What is exported.

    Attributes:
        people: in the order of the dataset, at least one.
        width, height: of every view, pixels.
        notes: for the user: views that were asked for and do not exist.
    """

    people: tuple[Person, ...]
    width: int
    height: int
    notes: tuple[str, ...]

    @property
    def view_count(self) -> int:
        """Views of all people."""
        return sum(len(person.views) for person in self.people)

    @property
    def rays(self) -> int:
        """Pixels of all views."""
        return self.view_count * self.width * self.height


def select(
    dataset: Dataset, identities: Sequence[str] | None = None, cameras: Sequence[str] | None = None
) -> Selection:
    """Choose identities and views by name.

    Args:
        dataset: opened.
        identities: names; None for all.
        cameras: names; None for all.

    Raises:
        ArtifactError: a name that the dataset does not have, or nothing that is left.
    """
    entries = dataset.manifest.identities
    known = list(dict.fromkeys(name for entry in entries for name in entry.cameras if name is not None))
    for field, names, have in (("identities", identities, dataset.names), ("views", cameras, known)):
        for name in names or ():
            if name not in have:
                raise ArtifactError(
                    dataset.manifest.path, field, f"there is no '{name}'", suggestion(name, have)
                )
    people, notes = [], []
    for number, entry in enumerate(entries):
        if identities is not None and entry.identity not in identities:
            continue
        there = [(view, name) for view, name in enumerate(entry.cameras) if name is not None]
        chosen = [(view, name) for view, name in there if cameras is None or name in cameras]
        missing = sorted(set(cameras or ()) - {name for _, name in chosen})
        if missing:
            notes.append(f"{entry.identity} has no view {', '.join(missing)}")
        if chosen:
            views, names = zip(*chosen, strict=True)
            people.append(Person(number, entry.identity, views, names))
    if not people:
        problem = "none of the identities has one of these views"
        raise ArtifactError(dataset.manifest.path, "views", problem, "Choose other identities or views")
    return Selection(tuple(people), dataset.manifest.width, dataset.manifest.height, tuple(notes))
