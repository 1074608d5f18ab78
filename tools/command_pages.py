"""A page per command, from what its ``--help`` says: ``python tools/command_pages.py`` writes ``docs/commands/``.

The flags and their texts come from `command_flags`, that is from where the command itself has them; this module knows
how a page looks. What no parser knows, what a command reads and writes and how it is called, is in `command_tours`.
A test makes the pages again and compares.
"""

import importlib
import sys
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from command_flags import Command, Flag, Section, default_of_each, of_fields, of_parser
from command_tours import TOURS, Tour
from preface.artifacts import write_bytes
from preface.cli import fit, train
from preface.cli.folders import make_folder
from preface.cli.output import exit_status
from preface.cli.usage import Parser
from preface.model.fitting.configuration import QUALITIES as FIT_QUALITIES
from preface.model.rendering import shortcuts
from preface.model.training.configuration import TRAINING_PRESETS

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "commands"
# Subcommands that are told by their first word, before a parser is made.
UNLISTED = {"preface-build-shards": ("export", "import")}
SOURCE = "This page is made by `python tools/command_pages.py` from what `{} --help` says; change it there."


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the pages; 0 when they are written, 1 when the disk refuses."""
    parser = Parser("command_pages", description="Write a page per command.")
    parser.add_argument("--output", type=Path, default=PAGES, help="folder (default: docs/commands)")
    folder = parser.parse_args(arguments).output

    def run() -> list[str]:
        make_folder(folder)
        for name, text in pages().items():
            write_bytes(folder / name, text.encode())
        return [str(folder)]

    return exit_status(run, parser, folder)


def scripts() -> dict[str, Callable[[list[str]], int]]:
    """The commands by name, as the package installs them."""
    entries = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    return {
        name: getattr(importlib.import_module(module), function)
        for name, (module, function) in ((name, target.split(":")) for name, target in entries.items())
    }


def pages() -> dict[str, str]:
    """The text of every page by its file's name: one per command, and README.md, which lists them."""
    found = scripts()
    texts, rows = {}, []
    for name in TOURS:
        commands = described(name, found[name])
        texts[f"{name}.md"] = _page(commands, TOURS[name])
        rows.append(f"| [`{name}`]({name}.md) | {_inline(commands[0].description[0])} |")
    parts = [
        "# Commands",
        "In the order of the main job; what they read and write is in [data_specs](../../data_specs/README.md).",
        "\n".join(["| command | what it does |", "| --- | --- |", *rows]),
        "The pages are made by `python tools/command_pages.py` from what each command's `--help` says.",
    ]
    return {"README.md": "\n\n".join(parts) + "\n", **texts}


def described(name: str, run: Callable[[list[str]], int]) -> list[Command]:
    """A command, and then its subcommands."""
    if name == "preface-train":
        presets = {preset: train.parse(["SHARDS", "--preset", preset]) for preset in TRAINING_PRESETS}
        return [of_fields(name, presets, train.DEFAULT_PRESET)]
    if name == "preface-fit":
        qualities = {quality: fit.parse(["SHARDS", "--quality", quality]) for quality in FIT_QUALITIES}
        return [of_fields(name, qualities, fit.DEFAULT_QUALITY)]
    whole = of_parser(run, defaults=_defaults_of_shortcuts() if name == "preface-render" else None)
    words = [full.split()[-1] for full, _ in whole.subcommands] or list(UNLISTED.get(name, ()))
    return [whole, *(of_parser(run, [word]) for word in words)]


def _defaults_of_shortcuts() -> dict[str, str]:
    """What each quality of rendering chooses, by the shortcut's name."""
    values = {quality: asdict(chosen) for quality, chosen in shortcuts.QUALITIES.items()}
    first = values[shortcuts.DEFAULT_QUALITY]
    return {
        name: default_of_each(
            {quality: chosen[name] for quality, chosen in values.items()}, shortcuts.DEFAULT_QUALITY
        )
        for name in first
    }


# ---------------------------------------------------------------------------------------------- Markdown


def _page(commands: Sequence[Command], tour: Tour) -> str:
    first, *others = commands
    parts = [f"# {first.name}", SOURCE.format(first.name), *map(_inline, first.description)]
    parts += [f"- Reads: {tour.reads}\n- Writes: {tour.writes}", "For example:", _code(tour.examples)]
    if not others or first.sections:
        parts += _usage(first, "##")
    for other in others:
        parts += [f"## {other.name}", *map(_inline, other.description[:1]), *_usage(other, "###")]
    return "\n\n".join(parts) + "\n"


def _usage(command: Command, heading: str) -> list[str]:
    """How it is called, and its flags."""
    needed, places = [], []
    for flag in (flag for section in command.sections for flag in section.flags):
        if not flag.names:
            places.append(flag.values)
        elif flag.required:
            needed.append(f"{flag.names[0]} {flag.values}")
    usage = " ".join([command.name, *places, *needed, "[FLAGS]"])
    return [_code((usage,)), *(part for section in command.sections for part in _section(section, heading))]


def _section(section: Section, heading: str) -> list[str]:
    title = section.title[:1].upper() + section.title[1:]
    parts = [f"{heading} {f'`{title}`' if title.startswith('--') else _inline(title)}"]
    if section.text:
        parts.append(_inline(section.text[:1].upper() + section.text[1:]))
    defaults = any(flag.default for flag in section.flags)
    head = ["flag", "meaning", "default"] if defaults else ["flag", "meaning"]
    rows = [head, ["---"] * len(head)]
    rows += [[_names(flag), _meaning(flag), _inline(flag.default)][: len(head)] for flag in section.flags]
    return [*parts, "\n".join(f"| {' | '.join(row)} |" for row in rows)]


def _names(flag: Flag) -> str:
    words = ", ".join(flag.names)
    return _span(f"{words} {flag.values}".strip())


def _meaning(flag: Flag) -> str:
    return f"Required. {_inline(flag.text)}" if flag.required else _inline(flag.text)


def _code(lines: Sequence[str]) -> str:
    return "\n".join(["```", *lines, "```"])


def _span(text: str) -> str:
    escaped = text.replace("|", r"\|")
    return f"`{escaped}`"


def _inline(text: str) -> str:
    """Help as Markdown: what is code there stays code, and nothing else becomes markup."""
    parts = text.replace("``", "`").replace("|", r"\|").split("`")
    if len(parts) % 2 == 0:  # a lone backquote is a character like any other
        parts = [r"\`".join(parts)]
    for index in range(0, len(parts), 2):
        for sign in "<*":
            parts[index] = parts[index].replace(sign, f"\\{sign}")
    return "`".join(parts)


if __name__ == "__main__":
    sys.exit(main())
