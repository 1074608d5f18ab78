"""What the commands share: printing their result, and the types of their flags."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence

from preface.artifacts import ArtifactError


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
