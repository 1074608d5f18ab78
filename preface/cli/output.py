"""What the commands share: printing their result, and the types of their flags."""

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

from preface.artifacts import ArtifactError
from preface.cli.usage import UsageError

INTERRUPTED = 130  # 128 + SIGINT, as shells report it


def exit_status(
    run: Callable[[], Sequence[str]],
    parser: argparse.ArgumentParser,
    subject: object,
    reasons: Callable[[], tuple[type[Exception], ...]] = lambda: (),
) -> int:
    """Run a command's work and print its result, or what is wrong; returns the exit status.

    Args:
        run: the work; returns the lines to print, the path of what was written last.
        parser: ends the process with status 2 for wrong usage that only the work can see.
        subject: what errors without a file are about: the file or folder that the command was given.
        reasons: the errors besides `ArtifactError` that tell a user what to do, asked for once the work is done;
            anything else is a defect of this program.
    """
    return complaining(lambda: print_lines(run()), parser, subject, reasons)


def complaining(
    work: Callable[[], int],
    parser: argparse.ArgumentParser,
    subject: object,
    reasons: Callable[[], tuple[type[Exception], ...]] = lambda: (),
) -> int:
    """The same for work that has an exit status of its own, and prints its result itself."""
    try:
        return work()
    except UsageError as error:
        parser.error(str(error))
    except ArtifactError as error:
        say(str(error))
    except Exception as error:
        if not isinstance(error, reasons()):
            raise
        say(f"{subject}: {error}")
    return 1


def resumable(command: Callable[[], int]) -> int:
    """Run a command that goes on where it was interrupted, and say so to who interrupts it."""
    return _until_interrupted(command, "interrupted; run the same command again to resume")


def interruptible(command: Callable[[], int]) -> int:
    """Run a command that begins anew when it is run again; who interrupts it need not see where it was."""
    return _until_interrupted(command, "interrupted")


def _until_interrupted(command: Callable[[], int], words: str) -> int:
    try:
        return command()
    except KeyboardInterrupt:
        say(words)
        return INTERRUPTED


def print_lines(lines: Sequence[str]) -> int:
    """Print a command's result; returns its exit status.

    A reader that has gone away (``head``) does not undo what was written; a full disk does.
    """
    try:
        print(*(printable(line, sys.stdout) for line in lines), sep="\n", flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        say(str(ArtifactError.from_os("standard output", "writing", error)))
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def printable(text: str, stream: Any) -> str:
    """A text with control codes, and characters that the stream's encoding lacks, as escapes: names may hold them."""
    clean = "".join(c if c == "\n" or c.isprintable() else repr(c)[1:-1] for c in text)
    encoding = stream.encoding or "utf-8"
    return clean.encode(encoding, "backslashreplace").decode(encoding)


def say(words: str) -> None:
    """Tell a person what is going on; programs read standard output."""
    print(words, file=sys.stderr, flush=True)


# --------------------------------------------------------------------------------- types of flags


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


def number(low: float, high: float) -> Callable[[str], float]:
    """The type of a flag that takes a number within limits, which belong to it."""

    def within(text: str) -> float:
        value = _finite(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"'{text}' is not a number from {low:g} to {high:g}")
        return value

    return within


def positive(text: str) -> float:
    """The type of a flag that takes a number greater than 0."""
    value = _finite(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def length(text: str) -> float:
    """The type of a flag that takes a length."""
    value = _finite(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a length in metres; write for example 0.022")
    return value


def known_distance(words: Sequence[str] | None) -> tuple[str, str, float] | None:
    """What ``--known-distance A B METRES`` says: two names, and how far apart they are.

    Raises:
        UsageError: the third word is no length.
    """
    if words is None:
        return None
    first, second, metres = words
    try:
        return first, second, length(metres)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"--known-distance: {error}") from error


def _finite(text: str) -> float:
    """A number; NaN, which lies within no limits, for a text that is none, and for infinity."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan
