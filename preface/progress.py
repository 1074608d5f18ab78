"""How far long work is: a bar on a terminal, and anywhere else a plain line now and then.

What is redirected to a file, a pipe or a job's log shows no bar, and nothing at all would look like a program that
hangs. Lines come every half minute at first and later the more seldom the longer the work takes, so that a night of it
leaves a hundred of them.
"""

from __future__ import annotations

import sys
from time import monotonic
from types import TracebackType
from typing import Self

from tqdm import tqdm

from preface.plain_words import duration

SECONDS_BETWEEN = 30.0  # two lines, at first
SHARE_BETWEEN = 0.05  # of the time that has passed, later
BAR = "{l_bar}{bar}| {elapsed}<{remaining}"


class Progress:
    """Tells on standard error how much of some work is done and how long the rest may take; a context manager.

    Args:
        count: how many things are to be done; 0 where that is not known.
        things: what they are called, such as "images".
        work: in all, in any unit, for things of which some take longer than others; each counts 1 without it.
    """

    def __init__(self, count: int, things: str, work: float | None = None):
        self._count, self._things = count, things
        self._all = float(count if work is None else work)
        self._things_done, self._work_done = 0, 0.0
        self._began = self._said = monotonic()
        self._bar = tqdm(total=self._all or None, disable=None, smoothing=0.05, bar_format=BAR)
        self._tell(0.0)

    def add(self, things: int, work: float | None = None) -> None:
        """So many more things are done, and so much more of the work; may be called with none to keep lines coming."""
        step = float(things if work is None else work)
        self._things_done += things
        self._work_done += step
        self._tell(step)

    def _tell(self, step: float) -> None:
        if not self._bar.disable:
            self._bar.set_description_str(self._done, refresh=False)
            self._bar.update(step)
            return
        now = monotonic()
        if now - self._said >= max(SECONDS_BETWEEN, SHARE_BETWEEN * (now - self._began)):
            self._say(now)

    def _say(self, now: float) -> None:
        self._said, passed = now, now - self._began
        left = ""
        if 0 < self._work_done < self._all:
            left = f", about {duration(passed / self._work_done * (self._all - self._work_done))} left"
        print(f"{self._done}, {duration(passed)}{left}", file=sys.stderr, flush=True)

    @property
    def _done(self) -> str:
        of = f" of {self._count:,}" if self._count else ""
        return f"{self._things_done:,}{of} {self._things}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar.disable and error is None:
            self._say(monotonic())
        self._bar.close()
