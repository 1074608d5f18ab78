"""Ctrl-C and a scheduler's SIGTERM: the step that runs is finished and saved, then the run ends."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Within this context a first signal is only noted; a second one of Ctrl-C raises KeyboardInterrupt.

    To be entered in the main thread.

    Attributes:
        signal: the number of the signal that came, 0 if none did.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        self._before = {number: signal.signal(number, self._note) for number in _SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.signal and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = self.signal or number

    @property
    def exit_status(self) -> int:
        """As shells report a process that a signal ended: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signal
