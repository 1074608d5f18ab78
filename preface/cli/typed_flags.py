"""Flags from the fields of a frozen dataclass, by tyro, without a tenth of a second of ``--help``.

tyro holds each default against the type of its field, and for types such as ``str | None`` and ``tuple[int, ...]`` it
imports typeguard for that, which takes as long as tyro itself. What a user writes is not checked by it. The types of
our own defaults are mypy's business, so that a stand-in that agrees to all of them is there while tyro reads flags.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any, TypeVar

import tyro

Config = TypeVar("Config")


def parse_flags(kind: type[Config], prog: str, arguments: Sequence[str], default: Config) -> Config:
    """The configuration that arguments ask for; ends the process for help and for wrong usage.

    Args:
        kind: the dataclass; the texts under its fields are the help.
        prog: the command's name.
        arguments: its words.
        default: what is not said; `tyro.MISSING` where it must be.
    """
    with _defaults_unchecked():
        return tyro.cli(kind, prog=prog, args=list(arguments), default=default)


@contextlib.contextmanager
def _defaults_unchecked() -> Iterator[None]:
    """A stand-in for typeguard; where that is loaded already, it costs nothing more and stays."""
    if "typeguard" in sys.modules:
        yield
        return
    stand_in: Any = ModuleType("typeguard")
    stand_in.check_type = lambda value, kind: value
    stand_in.TypeCheckError = TypeError
    sys.modules["typeguard"] = stand_in
    try:
        yield
    finally:
        del sys.modules["typeguard"]
