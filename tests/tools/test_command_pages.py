"""The pages of the commands: current, complete, and with examples that the commands accept."""

import contextlib
import io
import re
import shlex
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import command_flags
import command_pages
from command_tours import TOURS
from preface.cli import fit, train

SCRIPTS = command_pages.scripts()
SUBCOMMANDS = [
    *((name, ()) for name in SCRIPTS),
    *(("preface-align", (word,)) for word in ("studio", "photos")),
    *(("preface-calibrate", (word,)) for word in ("board", "photos", "import", "export")),
    *(("preface-build-shards", (word,)) for word in ("export", "import")),
]


def printed_help(name, words):
    """What a command's help prints."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit) as ended:
        SCRIPTS[name]([*words, "--help"])
    assert ended.value.code == 0
    return out.getvalue()


def part_of_page(name, words):
    """The part of a page that is about a subcommand, or about what has none."""
    parts = (command_pages.PAGES / f"{name}.md").read_text().split("\n## preface-")
    if not words:
        return parts[0]
    (part,) = [part for part in parts[1:] if f"preface-{part}".startswith(f"{name} {words[0]}\n")]
    return part


def test_the_pages_are_what_the_commands_say_now():
    """Where this fails, run: python tools/command_pages.py."""
    there = {path.name: path.read_text() for path in command_pages.PAGES.iterdir()}
    assert there == command_pages.pages()


def test_every_installed_command_has_a_page():
    assert set(TOURS) == set(SCRIPTS)


@pytest.mark.parametrize(
    ("name", "words"), SUBCOMMANDS, ids=[" ".join([name, *words]) for name, words in SUBCOMMANDS]
)
def test_every_flag_of_the_help_is_on_the_page_and_no_other(name, words, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    # Deeper than this are only their texts.
    flags = re.findall(
        r"^(?:  |│ )(--[a-z][\w.-]*)(?:, (--[a-z][\w.-]*))?", printed_help(name, words), re.MULTILINE
    )
    rows = re.findall(
        r"^\| `(--[a-z][\w.-]*)(?:, (--[a-z][\w.-]*))?", part_of_page(name, words), re.MULTILINE
    )
    assert sorted(rows) == sorted(flags)
    assert rows or words == () or name == "preface-calibrate"


@pytest.mark.parametrize(
    ("name", "words"),
    [(name, words) for name, words in SUBCOMMANDS if name not in ("preface-fit", "preface-train")],
)
def test_the_help_itself_says_every_default(name, words):
    """tyro writes those of the others."""
    sections = command_flags.of_parser(SCRIPTS[name], words).sections
    assert [flag.names for section in sections for flag in section.flags if flag.default] == []


@pytest.mark.parametrize("example", [line for tour in TOURS.values() for line in tour.examples])
def test_the_command_accepts_its_example(example):
    name, *words = shlex.split(example)
    if name in ("preface-fit", "preface-train"):
        parse = fit.parse if name == "preface-fit" else train.parse
        assert str(parse(words).shards) == words[0]
        return
    subcommand = [word for word in words[:1] if word in command_pages.UNLISTED.get(name, ())]
    parser = command_flags.parser_of(SCRIPTS[name], subcommand)
    assert vars(parser.parse_args(words[len(subcommand) :]))


def test_every_link_leads_to_a_file():
    for page in command_pages.PAGES.iterdir():
        for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
            assert (page.parent / link).is_file(), f"{page.name}: {link}"


def test_the_pages_can_be_written_elsewhere(tmp_path, capsys):
    assert command_pages.main(["--output", str(tmp_path / "pages")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "pages")
    assert {path.name: path.read_text() for path in (tmp_path / "pages").iterdir()} == command_pages.pages()


def test_a_folder_that_cannot_be_written_is_named(tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    assert command_pages.main(["--output", str(tmp_path / "file" / "pages")]) == 1
    assert "file" in capsys.readouterr().err


def test_a_default_that_differs_by_preset_is_given_for_each():
    values = {"draft": 40, "balanced": 80}
    assert command_flags.default_of_each(values, "balanced") == "draft 40, balanced 80"
    assert command_flags.default_of_each({"draft": 1e-3, "balanced": 1e-3}, "draft") == "0.001"
    assert command_flags.default_of_each({"draft": "draft", "balanced": "balanced"}, "balanced") == "balanced"
    assert (
        command_flags.default_of_each({"draft": None, "balanced": True}, "draft") == "draft none, balanced on"
    )
