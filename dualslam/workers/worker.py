"""A process that does jobs: warm, fed through a pipe, and asked for results without ever waiting."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import Any

from dualslam.core.jobs import Handlers, JobKind, Limit, result_of
from dualslam.core.resources import keep_freed_memory, peak_rss_mb, start_undisturbed
from dualslam.core.types import Failure, FailureReason
from dualslam.workers.transport import Channel

MakeHandlers = Callable[[], Handlers]
"""Makes, in the process, what does the work. It is pickled: a function of a module, or a `partial` of one."""
STOP_S = 2.0
"""How long a worker that is idle may take to end by itself; its exit takes tens of milliseconds."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Result and cost of a job."""

    result: Any | Failure
    cpu_s: float = 0.0
    peak_rss_mb: float = 0.0
    stopped_after: int | None = None  # steps, if it was stopped early


@dataclass(frozen=True, slots=True, eq=False)
class _News:
    """How far a job has come: the newest counts, and one that is lost matters to nobody."""

    told: Any


class Worker:
    """A process that does one job after the other. It has imported all that it needs before the first comes.

    - `make_handlers`: see `MakeHandlers`.
    - `niceness`: by so much it stands behind the process that tracks.
    """

    def __init__(self, make_handlers: MakeHandlers, niceness: int = 0, name: str = "worker") -> None:
        context = multiprocessing.get_context("spawn")
        self._name = name
        self._connection, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, make_handlers, niceness), name=name, daemon=True)
        self._process = process
        start_undisturbed(process)
        theirs.close()
        self._jobs: SimpleQueue[tuple[JobKind, Any, Limit | None] | None] = SimpleQueue()
        self._results: SimpleQueue[Answer] = SimpleQueue()
        self._news: Any = None  # of the job in hand: the newest
        self._ready = Event()
        # Pipes block, and a job is tens of megabytes: a thread of its own waits for them.
        self._carrier = Thread(target=self._carry, name=name, daemon=True)
        self._carrier.start()

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return self._process.pid

    def give(self, kind: JobKind, work: Any, limit: Limit | None = None) -> None:
        """Hand over a job; one at a time."""
        self._jobs.put((kind, work, limit))

    def news(self) -> Any:
        """Return the newest report of the current job since the last call, or None."""
        news, self._news = self._news, None
        return news

    def result(self, wait_s: float = 0.0) -> Answer | None:
        """Return the outcome of the job, or None while it runs. A worker that has died says so by a `Failure`."""
        try:
            return self._results.get(block=wait_s > 0, timeout=wait_s)
        except Empty:
            return None

    @property
    def alive(self) -> bool:
        """Whether the process is there to take a job."""
        return self._process.is_alive()

    @property
    def was_ready(self) -> bool:
        """Whether the process was ever ready to take a job."""
        return self._ready.is_set()

    def wait_until_ready(self, limit_s: float) -> bool:
        """Wait until the process has imported what it needs; return whether it has."""
        return self._ready.wait(limit_s)

    def stop(self, patience_s: float = 0.0) -> None:
        """End the process: by itself if it is idle and takes no longer than `patience_s`, else by force."""
        self._jobs.put(None)
        self._process.join(patience_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._carrier.join()

    def _carry(self) -> None:
        """Carry jobs to the process and results back, until it is stopped or the process is gone."""
        with self._connection:
            channel = Channel(self._connection, gives=True)
            try:
                channel.receive()  # that it is ready
                self._ready.set()
                while (job := self._jobs.get()) is not None:
                    channel.send(job)
                    while isinstance(answer := channel.receive(), _News):
                        self._news = answer.told
                    self._news = None
                    self._results.put(answer)
            except (EOFError, OSError, LookupError):
                # LookupError: it names what is gone here, which is a mistake of ours, and costs no more than a job.
                self._process.join(STOP_S)
                self._process.kill()
                self._process.join()
                detail = f"the {self._name} process ended with exit code {self._process.exitcode}"
                self._results.put(Answer(Failure(FailureReason.WORKER, detail)))


def serve(connection: Connection, make_handlers: MakeHandlers, niceness: int = 0) -> None:
    """Do jobs until the other end of the pipe is closed: what a worker process does."""
    if niceness:
        os.nice(niceness)
    keep_freed_memory()
    handlers, channel = make_handlers(), Channel(connection, gives=False)

    def tell(news: Any) -> None:
        with suppress(ConnectionError):  # the result will meet it too
            channel.send_in_passing(_News(news))

    try:
        channel.send(None)
    except ConnectionError:
        return
    while True:
        try:
            kind, work, limit = channel.receive()
        except (EOFError, ConnectionError):
            return
        began_s = time.process_time()
        result = handlers[kind](work)
        if isinstance(result, Generator):
            result = result_of(result, tell, limit)
        stopped = None if limit is None else limit.steps
        try:
            channel.send(Answer(result, time.process_time() - began_s, peak_rss_mb(), stopped))
        except ConnectionError:  # nobody waits for it any more
            return
        del work, result  # as they go with the next job, what they held may go
