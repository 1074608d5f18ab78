"""Wrong usage: how every command says so, in one line, and what only shows once the input has been looked at."""

import argparse
from typing import NoReturn


class UsageError(ValueError):
    """Flags that contradict each other or the capture; a command then ends with exit status 2."""


class Parser(argparse.ArgumentParser):
    """A parser, and its subcommands', that says what is wrong and where flags are explained, without listing them."""

    def error(self, message: str) -> NoReturn:
        """End the process with status 2."""
        self.exit(2, f"{self.prog}: error: {message}; see {self.prog} --help\n")
