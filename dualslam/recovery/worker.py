"""Recovery beside the tracking: warm worker processes, fed with jobs and asked for results without ever waiting.

A process, because GTSAM holds the interpreter's lock while it solves. A worker that dies, or takes longer than its
time, costs the recovery that it was busy with: the job ends as a `Failure`, and a fresh worker takes the place.

Workers are spawned, so a script of one's own that asks for them must be importable: what it runs stands under
``if __name__ == "__main__":``.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue
from threading import Thread

from dualslam.core.memory import keep_freed_memory
from dualslam.core.types import Failure, FailureReason
from dualslam.recovery.direction import recover
from dualslam.recovery.executor import Outcome
from dualslam.recovery.reverse_tracking import RecoveryJob, RecoveryParts, RecoveryResult

log = logging.getLogger(__name__)

MakeParts = Callable[[], RecoveryParts]

STOP_S = 2.0
"""How long a worker that is idle may take to end by itself; its exit takes tens of milliseconds."""
PAUSE_S = 0.01
"""Between two looks at whether the last recoveries have ended, when nothing else is left to do."""


class Worker:
    """A process that runs one job after the other. It has imported all that it needs before the first comes.

    Parameters
    ----------
    make_parts : callable
        Makes, in the process, what a walk is made of. It is pickled: a function of a module, or a `partial` of one.
    """

    def __init__(self, make_parts: MakeParts) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, make_parts), name="dualslam recovery", daemon=True)
        self._process.start()
        theirs.close()
        self._jobs: SimpleQueue[RecoveryJob | None] = SimpleQueue()
        self._results: SimpleQueue[RecoveryResult | Failure] = SimpleQueue()
        # Pipes block, and a job is tens of megabytes: a thread of its own waits for them.
        self._carrier = Thread(target=self._carry, name="dualslam recovery", daemon=True)
        self._carrier.start()

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return self._process.pid

    def give(self, job: RecoveryJob) -> None:
        """Hand over a job; one at a time."""
        self._jobs.put(job)

    def result(self) -> RecoveryResult | Failure | None:
        """Return what came of the job, or None while it runs. A worker that has died says so by a `Failure`."""
        try:
            return self._results.get_nowait()
        except Empty:
            return None

    @property
    def alive(self) -> bool:
        """Whether the process is there to take a job."""
        return self._process.is_alive()

    def stop(self, patience_s: float = 0.0) -> None:
        """End the process: by itself if it is idle and takes no longer than `patience_s`, else by force."""
        self._jobs.put(None)
        self._process.join(patience_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._carrier.join()

    def _carry(self) -> None:
        """Carry jobs to the process and results back, until told to stop or the process is gone."""
        with self._connection:
            try:
                while (job := self._jobs.get()) is not None:
                    _send(self._connection, job)
                    self._results.put(self._connection.recv())
            except (EOFError, OSError):
                self._process.join()
                detail = f"the recovery process ended with exit code {self._process.exitcode}"
                self._results.put(Failure(FailureReason.WORKER, detail))


def serve(connection: Connection, make_parts: MakeParts) -> None:
    """Run jobs until the other end of the pipe is closed: what a worker process does."""
    # An interrupt at the terminal reaches all processes; what becomes of the run is the first one's affair.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_freed_memory()
    parts = make_parts()
    while True:
        try:
            job = _receive(connection)
        except EOFError:
            return
        result = recover(job, parts)
        try:
            connection.send(result)
        except BrokenPipeError:  # nobody waits for it any more
            return


def _send(connection: Connection, job: RecoveryJob) -> None:
    # One by one: pickling holds the interpreter's lock, and all images at once would stop the tracking meanwhile.
    connection.send((replace(job, views=()), len(job.views)))
    for view in job.views:
        connection.send(view)


def _receive(connection: Connection) -> RecoveryJob:
    job: RecoveryJob
    job, n_views = connection.recv()
    return replace(job, views=tuple(connection.recv() for _ in range(n_views)))


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    job: RecoveryJob
    worker: Worker
    began_s: float


class WorkerExecutor:
    """The `dualslam.recovery.executor.RecoveryExecutor` whose jobs run in processes of their own.

    Parameters
    ----------
    make_parts : callable
        As for `Worker`.
    n_workers : int
        Jobs that run at the same time; further ones wait their turn.
    time_limit_s : float
        How long a job may take before its worker counts as hung.
    finish_wait_s : float
        How long the end of the run waits for what is under way.
    on_start : callable, optional
        Called with each job that a process begins, and the process's id: where the failure lab takes hold.
    """

    def __init__(
        self,
        make_parts: MakeParts,
        n_workers: int,
        time_limit_s: float,
        finish_wait_s: float,
        on_start: Callable[[RecoveryJob, int | None], None] | None = None,
    ) -> None:
        self._make_parts = make_parts
        self._time_limit_s = time_limit_s
        self._finish_wait_s = finish_wait_s
        self._on_start = on_start
        self._idle = [Worker(make_parts) for _ in range(n_workers)]
        self._busy: list[_Task] = []
        self._waiting: deque[RecoveryJob] = deque()

    @property
    def pids(self) -> list[int | None]:
        """Process ids of the workers, the busy ones first."""
        return [worker.pid for worker in [*(task.worker for task in self._busy), *self._idle]]

    def submit(self, job: RecoveryJob) -> None:
        """Give the job to an idle worker, or let it wait for one."""
        self._waiting.append(job)
        self._hand_out()

    def poll(self) -> list[Outcome]:
        """Return what has ended since the last call; never wait."""
        ended: list[Outcome] = []
        for task in list(self._busy):
            result = task.worker.result()
            if result is None and time.monotonic() - task.began_s > self._time_limit_s:
                result = Failure(FailureReason.TIMEOUT, f"the recovery took longer than {self._time_limit_s:g} s")
            if result is None:
                continue
            self._busy.remove(task)
            lost = isinstance(result, Failure) and result.reason in (FailureReason.WORKER, FailureReason.TIMEOUT)
            self._idle.append(self._replaced(task.worker) if lost else task.worker)
            ended.append((task.job, result))
        self._hand_out()
        return ended

    def finish(self) -> list[Outcome]:
        """Wait for what is under way, for so long and no longer, end the workers, and return what has come of it."""
        ended, began_s = self.poll(), time.monotonic()
        while self._busy and time.monotonic() - began_s < self._finish_wait_s:
            time.sleep(PAUSE_S)
            ended += self.poll()
        late = Failure(
            FailureReason.TIMEOUT, f"the run ended, and {self._finish_wait_s:g} s later its recovery had not"
        )
        ended += [(job, late) for job in [*(task.job for task in self._busy), *self._waiting]]
        for task in self._busy:
            task.worker.stop()
        for worker in self._idle:
            worker.stop(STOP_S)
        self._busy, self._idle, self._waiting = [], [], deque()
        return ended

    def _hand_out(self) -> None:
        while self._waiting and self._idle:
            worker = self._idle.pop(0)
            if not worker.alive:
                log.warning("a recovery process had ended while idle; starting another one")
                worker = self._replaced(worker)
            job = self._waiting.popleft()
            worker.give(job)
            self._busy.append(_Task(job, worker, time.monotonic()))
            if self._on_start is not None:
                self._on_start(job, worker.pid)

    def _replaced(self, worker: Worker) -> Worker:
        worker.stop()
        return Worker(self._make_parts)
