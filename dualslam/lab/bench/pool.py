"""Trials in processes of this machine: long-lived workers, and one that dies takes nothing but its trial with it."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from threading import Thread

from dualslam.core.resources import hear_interrupts, limit_threads, start_undisturbed
from dualslam.lab.bench.plan import Trial
from dualslam.lab.bench.record import TrialOutcome, TrialRecord, blank_record

RunTrial = Callable[[Trial], TrialRecord]

# A trial ends itself when its time is over, after the frame in hand; a worker that hangs in a frame is ended at last.
_HANG_FACTOR, _HANG_MARGIN_S = 1.5, 60.0


@dataclass(eq=False)
class _Worker:
    process: BaseProcess
    pipe: Connection
    trial: Trial | None = None
    since: float = 0.0

    def give(self, trial: Trial) -> None:
        self.trial, self.since = trial, time.monotonic()
        self.pipe.send(trial)

    def overdue(self) -> bool:
        limit_s = self.trial.timeout_s if self.trial is not None else None
        return limit_s is not None and time.monotonic() - self.since > _HANG_FACTOR * limit_s + _HANG_MARGIN_S


def run_in_processes(run_trial: RunTrial, trials: Iterable[Trial], n_processes: int) -> Iterator[TrialRecord]:
    """Run trials in spawned processes, and yield each one's record when it is over, in whatever order that happens.

    Parameters
    ----------
    run_trial : callable
        At the top level of its module, as it is found by name in the other process.
    trials : iterable of Trial
    n_processes : int
    """
    limit_threads()  # spawned processes inherit the environment
    waiting = list(trials)[::-1]
    workers: list[_Worker] = []
    try:
        while waiting or any(worker.trial for worker in workers):
            busy = [worker for worker in workers if worker.trial is not None]
            idle = [worker for worker in workers if worker.trial is None and worker.process.is_alive()]
            while waiting and len(busy) < n_processes:
                worker = idle.pop() if idle else _start(run_trial, workers)
                worker.give(waiting.pop())
                busy.append(worker)
            ready = wait([w.pipe for w in busy], timeout=1.0)
            for worker in busy:
                if worker.pipe in ready:
                    yield _collect(worker, workers)
                elif worker.overdue():
                    worker.process.kill()
    finally:
        for worker in workers:
            worker.pipe.close()
            worker.process.terminate()
        for worker in workers:
            worker.process.join()


def _start(run_trial: RunTrial, workers: list[_Worker]) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    # Not a daemon: a trial may have a recovery process of its own.
    process = context.Process(target=_serve, args=(run_trial, theirs), name="dualslam-trial")
    start_undisturbed(process)
    theirs.close()
    workers.append(_Worker(process, ours))
    return workers[-1]


def _collect(worker: _Worker, workers: list[_Worker]) -> TrialRecord:
    trial, seconds = worker.trial, time.monotonic() - worker.since
    assert trial is not None
    overdue = worker.overdue()
    worker.trial = None
    try:
        record: TrialRecord = worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join()
        worker.pipe.close()
        workers.remove(worker)
        if overdue:
            return blank_record(trial, TrialOutcome.TIMED_OUT, "the process hung and was ended", seconds)
        code = worker.process.exitcode
        return blank_record(trial, TrialOutcome.CRASHED, f"the process died with exit code {code}", seconds)
    return record


def _serve(run_trial: RunTrial, pipe: Connection) -> None:
    """Run trials until the other end of the pipe is closed, or someone interrupts."""
    Thread(target=_end_with_the_bench, daemon=True).start()
    with suppress(EOFError, BrokenPipeError, KeyboardInterrupt):
        hear_interrupts()  # a trial ends by itself
        while True:
            pipe.send(run_trial(pipe.recv()))


def _end_with_the_bench() -> None:
    """End this process when the bench's is gone: a bench that goes on would find its trials' folders in use."""
    bench = multiprocessing.parent_process()
    assert bench is not None
    wait([bench.sentinel])
    os._exit(1)
