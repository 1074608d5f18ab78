"""Flags from the fields of a frozen dataclass, by tyro, without a tenth of a second of ``--help``.

tyro holds each default against the type of its field, and for types such as ``str | None`` and ``tuple[int, ...]`` it
imports typeguard for that, which takes as long as tyro itself. What a user writes is not checked by it. The types of
our own defaults are mypy's business, so that a stand-in that agrees to all of them is there while tyro reads flags.

What is wrong with the flags is said in the one line of all commands; tyro draws a box with the help of what is near.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import sys
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any, TypeVar

import tyro

from preface.cli.usage import Parser

Config = TypeVar("Config")


def parse_flags(kind: type[Config], prog: str, arguments: Sequence[str], default: Config) -> Config:
    """The configuration that arguments ask for; ends the process for help and for wrong usage.

    Args:
        kind: the dataclass; the texts under its fields are the help.
        prog: the command's name.
        arguments: its words.
        default: what is not said; `tyro.MISSING` where it must be.
    """
    with _defaults_unchecked(), told_in_a_line(prog):
        return tyro.cli(kind, prog=prog, args=list(arguments), default=default)


def refusing(prog: str) -> argparse.ArgumentParser:
    """What says of a command with typed flags, as argparse does for all others, what only its work can see to be wrong.

    For `preface.cli.output.exit_status`.
    """
    return Parser(prog)


@contextlib.contextmanager
def told_in_a_line(prog: str) -> Iterator[None]:
    """While tyro reads flags: wrong usage is told as `Parser` tells it, and the process ends with status 2."""
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            yield
    except SystemExit as end:
        if end.code == 2:
            refusing(prog).error(_line(told.getvalue()))
        raise


def _line(box: str) -> str:
    """What a box of tyro's says is wrong: all above its first rule, and for unknown flags those that are similar."""
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in box.splitlines()]
    inside = [line.strip("│")[1:].rstrip() for line in lines if line.startswith("│")]
    inside = inside or [line[2:].rstrip() for line in lines if line.startswith("  ")]  # no UTF-8, no sides
    rules = [number for number, line in enumerate(inside) if line and not line.strip("─-")]
    first = rules[0] if rules else len(inside)
    said = " ".join(line.strip() for line in inside[:first]) or box.strip()
    near = [match[1] for line in inside[first:] if (match := re.match(r" {4}(--[\w.-]+)", line))]
    if said.startswith("Unrecognized options") and near:
        said += f"; perhaps {' or '.join(dict.fromkeys(near))} was meant"
    return said[:1].lower() + said[1:].rstrip(".")


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
