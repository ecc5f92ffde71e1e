"""The process that starts is none of pytest's: what is tested happens before any of our code runs in it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from multiprocessing.connection import Connection

import pytest

from dualslam.core.resources import hear_interrupts, start_undisturbed


def _wait(pipe: Connection) -> None:
    pipe.recv()
    try:
        hear_interrupts()
    except KeyboardInterrupt:
        pipe.send("came when it was let through")


def test_an_interrupt_while_it_starts_does_not_end_a_process(capfd: pytest.CaptureFixture[str]) -> None:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_wait, args=(theirs,), daemon=True)
    start_undisturbed(process)
    assert process.pid is not None
    for _ in range(10):  # while the interpreter starts
        os.kill(process.pid, signal.SIGINT)
        time.sleep(0.01)
    ours.send(None)
    assert ours.recv() == "came when it was let through"
    process.join()
    assert process.exitcode == 0
    assert capfd.readouterr().err == ""
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
