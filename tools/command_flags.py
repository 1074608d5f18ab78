"""What a command's ``--help`` says, as data: the parser that prints it, or the fields that its flags are made from.

`tools/command_pages.py` makes a page per command of it.
"""

import argparse
import contextlib
import dataclasses
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints
from unittest import mock

import tyro

from preface.cli.field_texts import field_texts


@dataclasses.dataclass(frozen=True)
class Flag:
    """A flag or a positional argument.

    Attributes:
        names: with their dashes; a positional argument has none.
        values: what is written after it, such as "WIDTHxHEIGHT"; empty for a switch.
        text: its help.
        default: where the text does not say it; empty where there is none.
        required: whether the command ends without it.
    """

    names: tuple[str, ...]
    values: str
    text: str
    default: str
    required: bool


@dataclasses.dataclass(frozen=True)
class Section:
    """Flags that belong together, in the order of the help."""

    title: str
    text: str
    flags: tuple[Flag, ...]


@dataclasses.dataclass(frozen=True)
class Command:
    """A command, or one of its subcommands.

    Attributes:
        name: as it is called, such as "preface-align studio".
        description: paragraphs.
        sections: of flags; none of them is empty.
        subcommands: name and description.
    """

    name: str
    description: tuple[str, ...]
    sections: tuple[Section, ...]
    subcommands: tuple[tuple[str, str], ...] = ()


# ------------------------------------------------------------------------- commands that use argparse


def of_parser(
    main: Callable[[list[str]], int], words: Sequence[str] = (), defaults: Mapping[str, str] | None = None
) -> Command:
    """What ``command WORDS --help`` says.

    Args:
        main: of a command that uses argparse.
        words: a subcommand, or nothing.
        defaults: of flags whose default the parser does not know, by the name of the attribute that they set.
    """
    parser = parser_of(main, words)
    groups = [(group, [a for a in group._group_actions if _shown(a)]) for group in parser._action_groups]
    known = defaults or {}
    sections = tuple(
        Section(group.title or "", group.description or "", tuple(_flag(parser, a, known) for a in actions))
        for group, actions in groups
        if actions
    )
    subcommands = [
        (f"{parser.prog} {choice.dest}", choice.help or "")
        for group, _ in groups
        for action in group._group_actions
        if isinstance(action, argparse._SubParsersAction)
        for choice in action._choices_actions
    ]
    paragraphs = tuple(text for text in (parser.description, parser.epilog) if text)
    return Command(parser.prog, paragraphs, sections, tuple(subcommands))


def _shown(action: argparse.Action) -> bool:
    hidden = isinstance(action, argparse._HelpAction | argparse._SubParsersAction)
    return not hidden and action.help != argparse.SUPPRESS


def parser_of(main: Callable[[list[str]], int], words: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The parser that prints what ``command WORDS --help`` says; see `of_parser`."""
    found: list[argparse.ArgumentParser] = []

    def print_help(self: argparse.ArgumentParser, file: Any = None) -> None:
        found.append(self)

    with (
        mock.patch.object(argparse.ArgumentParser, "print_help", print_help),
        contextlib.suppress(SystemExit),
    ):
        main([*words, "--help"])
    (parser,) = found
    return parser


def _flag(parser: argparse.ArgumentParser, action: argparse.Action, defaults: Mapping[str, str]) -> Flag:
    formatter = parser._get_formatter()
    text = formatter._expand_help(action) if action.help else ""
    if action.option_strings:
        metavar = formatter._get_default_metavar_for_optional(action)
    else:
        metavar = formatter._get_default_metavar_for_positional(action)
    known = isinstance(action.default, str | int | float | Path) and action.default is not False
    default = str(action.default) if known and action.default != argparse.SUPPRESS else ""
    said = "default" in text or not action.option_strings
    return Flag(
        tuple(action.option_strings),
        "" if action.nargs == 0 else formatter._format_args(action, metavar),
        text,
        "" if said else defaults.get(action.dest, default),
        action.required and bool(action.option_strings),
    )


# ------------------------------------------------------- commands whose flags are fields of a dataclass


def of_fields(name: str, configurations: Mapping[str, Any], chosen: str) -> Command:
    """The flags of a dataclass that tyro reads.

    Args:
        name: as it is called.
        configurations: the defaults, by the name of the preset that has them; all of one dataclass.
        chosen: the preset that is taken where none is named.
    """
    kind = type(configurations[chosen])
    sections = tuple(_sections(kind, "", configurations, chosen, "options", ""))
    paragraphs = tuple(" ".join(part.split()) for part in (kind.__doc__ or "").split("\n\n"))
    return Command(name, paragraphs, sections)


def _sections(
    kind: type, prefix: str, values: Mapping[str, Any], chosen: str, title: str, text: str
) -> Iterator[Section]:
    """The flags of a dataclass, and then those of the dataclasses in it."""
    hints, texts = get_type_hints(kind, include_extras=True), field_texts(kind)
    flags, within = [], []
    for one in dataclasses.fields(kind):
        hint, extras = _stripped(hints[one.name])
        inner = {preset: getattr(value, one.name) for preset, value in values.items()}
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            place = "" if _has_no_name(extras) else f"{prefix}{_dashed(one.name)}."
            words = texts.get(one.name) or " ".join((hint.__doc__ or "").split("\n\n")[0].split())
            first, _, rest = words.partition(". ")
            heading, words = (f"--{place}*", words) if place else (first.rstrip("."), rest)
            within.append((hint, place, inner, heading, words))
        else:
            positional = tyro.conf.Positional in extras
            flags.append(_typed_flag(prefix, one.name, hint, texts[one.name], inner, chosen, positional))
    yield Section(title, text, tuple(flags))
    for hint, place, inner, heading, words in within:
        yield from _sections(hint, place, inner, chosen, heading, words)


def _typed_flag(
    prefix: str, name: str, hint: Any, text: str, values: Mapping[str, Any], chosen: str, positional: bool
) -> Flag:
    if positional:
        return Flag((), name.upper(), text, "", False)
    dashed = _dashed(name)
    switch = hint is bool
    names = (f"--{prefix}{dashed}", f"--{prefix}no-{dashed}") if switch else (f"--{prefix}{dashed}",)
    return Flag(names, "" if switch else _values(hint), text, default_of_each(values, chosen), False)


def default_of_each(values: Mapping[str, Any], chosen: str) -> str:
    """The default as it is written, or that of each preset where they differ.

    Args:
        values: by preset.
        chosen: the preset that is taken where none is named.
    """
    texts = {preset: _written(value) for preset, value in values.items()}
    if all(text == preset for preset, text in texts.items()):  # the choice of the preset itself
        return texts[chosen]
    if len(set(texts.values())) == 1:
        return texts[chosen]
    return ", ".join(f"{preset} {text or 'none'}" for preset, text in texts.items())


def _written(value: Any) -> str:
    """A value as it is written on the command line; a switch is on or off."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return str(value)


def _values(hint: Any) -> str:
    """What is written after a flag of a type, in the words of tyro's help."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "{" + ",".join(map(str, arguments)) + "}"
    if origin in (Union, types.UnionType):
        return "|".join(_values(one) for one in arguments if one is not type(None))
    if origin is tuple:
        return f"[{_values(arguments[0])} ...]"
    return {Path: "PATH", int: "INT", float: "FLOAT", str: "STR"}[hint]


def _stripped(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its annotations, and these."""
    if get_origin(hint) is not Annotated:
        return hint, ()
    bare, *extras = get_args(hint)
    return bare, tuple(extras)


def _has_no_name(extras: tuple[Any, ...]) -> bool:
    return any(getattr(extra, "name", None) == "" for extra in extras)


def _dashed(name: str) -> str:
    return name.replace("_", "-")
