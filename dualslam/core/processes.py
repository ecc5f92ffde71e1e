"""Processes that a run starts for itself, and what an interrupt at the terminal does to them."""

from __future__ import annotations

import signal
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess


def start_undisturbed(process: BaseProcess) -> None:
    """Start a spawned process in which SIGINT is held back from its first instruction on.

    An interrupt at the terminal reaches all processes of a run, and the first one's decides. A process that only
    ignored it in its own code would die with a stack trace while it still imports.
    """
    resource_tracker.ensure_running()  # starting a process would do that, and lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def hear_interrupts() -> None:
    """Let SIGINT through, in a process of `start_undisturbed`; one that came before comes now."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
