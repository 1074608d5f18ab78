"""What the commands share: printing their result, and the types of their flags."""

import argparse
import os
import re
import sys
from collections.abc import Callable, Sequence

from preface.artifacts import ArtifactError
from preface.cli.usage import UsageError


def exit_status(
    run: Callable[[], Sequence[str]],
    parser: argparse.ArgumentParser,
    subject: object,
    reasons: Callable[[], tuple[type[Exception], ...]],
) -> int:
    """Run a command's work and print its result, or what is wrong; returns the exit status.

    Args:
        run: the work; returns the lines to print, the path of what was written last.
        parser: ends the process with status 2 for wrong usage that only the work can see.
        subject: what errors without a file are about.
        reasons: the errors besides `ArtifactError` that tell a user what to do, asked for once the work is done;
            anything else is a defect of this program.
    """
    try:
        lines = run()
    except UsageError as error:
        parser.error(str(error))
    except ArtifactError as error:
        print(error, file=sys.stderr)
        return 1
    except Exception as error:
        if not isinstance(error, reasons()):
            raise
        print(f"{subject}: {error}", file=sys.stderr)
        return 1
    return print_lines(lines)


def resumable(command: Callable[[], int]) -> int:
    """Run a command that goes on where it was interrupted, and say so to who interrupts it."""
    try:
        return command()
    except KeyboardInterrupt:
        print("interrupted; run the same command again to resume", file=sys.stderr)
        return 130  # 128 + SIGINT, as shells report it


def print_lines(lines: Sequence[str]) -> int:
    """Print a command's result; returns its exit status.

    A reader that has gone away (``head``) does not undo what was written; a full disk does.
    """
    try:
        print(*lines, sep="\n", flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(ArtifactError.from_os("standard output", "writing", error), file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def say(words: str) -> None:
    """Tell a person what is going on; programs read standard output."""
    print(words, file=sys.stderr, flush=True)


def whole_number(smallest: int) -> Callable[[str], int]:
    """The type of a flag that takes a whole number of at least ``smallest``."""

    def number(text: str) -> int:
        if not text.isdecimal() or int(text) < smallest:
            raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of at least {smallest}")
        return int(text)

    return number


def size(text: str) -> tuple[int, int]:
    """The type of a flag that takes WIDTHxHEIGHT, pixels."""
    match = re.fullmatch(r"([1-9]\d{0,4})[xX]([1-9]\d{0,4})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"'{text}' is not WIDTHxHEIGHT, such as 512x768")
    return int(match[1]), int(match[2])
