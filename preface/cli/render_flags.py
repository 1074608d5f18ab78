"""Flags of the commands that render: where, ``--quality``, and one for each shortcut of rendering."""

import argparse
import dataclasses
from typing import Any

from preface.cli.field_texts import field_texts
from preface.cli.output import whole_number
from preface.cli.usage import UsageError
from preface.model.rendering.shortcuts import DEFAULT_QUALITY, QUALITIES, Shortcuts


def add_device_flags(group: argparse._ArgumentGroup) -> None:
    """Add ``--device`` and ``--rays-at-a-time``."""
    group.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N (default: cpu)")
    group.add_argument(
        "--rays-at-a-time",
        type=whole_number(1),
        default=4096,
        metavar="N",
        help="memory goes with it (default: %(default)s)",
    )


def add_quality_flags(parser: argparse.ArgumentParser) -> None:
    """Add ``--quality`` and, for each field of `Shortcuts`, a flag of its name that replaces the quality's value."""
    group = parser.add_argument_group(
        "speed for accuracy",
        "measured by tools/measure_tradeoff.py; each flag replaces what --quality chooses",
    )
    group.add_argument(
        "--quality",
        choices=list(QUALITIES),
        default=DEFAULT_QUALITY,
        help="reference: everything evaluated as trained; balanced: a fifth of the time at a loss of less than 0.1 dB; "
        "draft: to look at (default: %(default)s)",
    )
    texts = field_texts(Shortcuts)
    for field in dataclasses.fields(Shortcuts):
        name, words = f"--{field.name.replace('_', '-')}", texts[field.name].replace("%", "%%")
        if isinstance(field.default, bool):
            group.add_argument(name, action=argparse.BooleanOptionalAction, default=None, help=words)
        elif isinstance(field.default, str):
            group.add_argument(name, choices=["fp32", "bf16"], default=None, help=words)
        else:
            kind = type(field.default)
            group.add_argument(name, type=kind, default=None, metavar=kind.__name__.upper()[0], help=words)


def chosen_shortcuts(config: argparse.Namespace) -> Shortcuts:
    """What the flags of `add_quality_flags` ask for.

    Raises:
        UsageError: a value that cannot be.
    """
    given: dict[str, Any] = {
        field.name: getattr(config, field.name) for field in dataclasses.fields(Shortcuts)
    }
    given = {name: value for name, value in given.items() if value is not None}
    try:
        return dataclasses.replace(QUALITIES[config.quality], **given)
    except ValueError as error:
        raise UsageError(f"--{str(error).replace('_', '-', 1)}") from error
