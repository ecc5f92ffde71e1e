"""Signals that end a run, so that what it has found is kept however impatient the user is."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

log = logging.getLogger(__name__)

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def held_back() -> Iterator[None]:
    """Hold SIGINT back in this block, to act behind it: an extension module that it meets at its start is a broken one.

    Outside the main thread, where no signal comes, nothing is done.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (signal.SIG_IGN, None):
        yield
        return
    came: list[int] = []
    signal.signal(signal.SIGINT, lambda number, stack: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        signal.raise_signal(signal.SIGINT)


class Interrupts:
    """Takes the signals that end a run, while it is entered; each asks for more than the one before.

    The first one asks for no further frame (`asked`). The second one abandons the current step, too, where the code
    allows it (`leave_at_second`). Elsewhere results are being written, and a message says what the wait is for. The
    third one acts as it would without us. Signals that a parent process has set to be ignored stay ignored (nohup).
    Outside the main thread, where no signal comes, nothing is done.

    - `left`: whether the second one has left something.
    """

    def __init__(self) -> None:
        self.left = False
        self._n = 0
        self._last = 0
        self._may_leave = False
        self._before: dict[int, Any] = {}

    @property
    def asked(self) -> bool:
        """Whether the run is to end."""
        return self._n > 0

    @contextmanager
    def leave_at_second(self) -> Iterator[None]:
        """Let the second signal leave this block, by an exception that is not seen outside."""
        self._may_leave = True
        try:
            yield
        except KeyboardInterrupt:
            if not self.asked:
                raise
            self.left = True
        finally:
            self._may_leave = False

    def act_late(self) -> None:
        """Have the last signal act after all, where it came too late to end the run; to be called when all is left."""
        if self.asked:
            signal.raise_signal(self._last)

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            known = {number: signal.getsignal(number) for number in ENDING}
            # None: by what is not Python, which could not be put back.
            self._before = {number: old for number, old in known.items() if old not in (signal.SIG_IGN, None)}
            for number in self._before:
                signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, old in self._before.items():
            signal.signal(number, old)
        self._before = {}

    def _handle(self, number: int, stack: FrameType | None) -> None:
        self._n, self._last = self._n + 1, number
        if self._n > 2:
            self.__exit__()
            signal.raise_signal(number)
        elif not self._may_leave:
            more = "one more" if self._n == 2 else "two more"
            log.warning("the results are being written; %s of these signals would leave them unfinished", more)
        elif self._n == 2:
            self._may_leave = False
            raise KeyboardInterrupt
