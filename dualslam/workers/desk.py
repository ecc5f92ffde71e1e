"""Work beside the tracking in processes of their own: warm, fed with jobs, asked for results without ever waiting.

A process, because GTSAM holds the interpreter's lock while it solves. A worker that dies, or takes longer than its
time, costs the job that it was busy with: the job ends as a `Failure`, and a fresh worker takes the place.

Workers stand in lanes. One is for what the live map asks for all the time, so that no walk back of 20 s stands before
its graph; one is for walks and whatever else may take long. Where cores are short, the system's scheduler gives way to
the tracking first, then to the live map's lane (`Lane.niceness`). A lane's queue is bounded, and its most urgent kind
goes first.

Workers are spawned, so a script of one's own that asks for them must be importable: what it runs stands under
``if __name__ == "__main__":``.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import Any

from dualslam.core.errors import ConfigError
from dualslam.core.memory import keep_freed_memory, peak_rss_mb
from dualslam.core.processes import start_undisturbed
from dualslam.core.types import Failure, FailureReason
from dualslam.workers.jobs import Ended, Handlers, JobKind, result_of
from dualslam.workers.transport import Channel

log = logging.getLogger(__name__)

MakeHandlers = Callable[[], Handlers]
"""Makes, in the process, what does the work. It is pickled: a function of a module, or a `partial` of one."""

STOP_S = 2.0
"""How long a worker that is idle may take to end by itself; its exit takes tens of milliseconds."""
START_S = 60.0
"""How long a run in real time waits for its workers at most: seconds on a free machine."""
PAUSE_S = 0.01
"""Between two looks at whether the last jobs have ended, when nothing else is left to do."""
MAX_STILLBORN = 3
"""Workers in a row that may end before they were ready: memory may be short for a moment; a script stays wrong."""
MAX_WAITING = 8
"""Jobs of a kind that may wait: more are nothing but a back end that is behind, and hold their snapshots in memory."""


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    result: Any | Failure
    cpu_s: float = 0.0
    peak_rss_mb: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _News:
    """How far a job has come: the newest counts, and one that is lost matters to nobody."""

    told: Any


class Worker:
    """A process that does one job after the other. It has imported all that it needs before the first comes.

    Parameters
    ----------
    make_handlers : callable
        See `MakeHandlers`.
    niceness : int
        By so much it stands behind the process that tracks.
    name : str
    """

    def __init__(self, make_handlers: MakeHandlers, niceness: int = 0, name: str = "worker") -> None:
        context = multiprocessing.get_context("spawn")
        self._name = name
        self._connection, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, make_handlers, niceness), name=name, daemon=True)
        self._process = process
        start_undisturbed(process)
        theirs.close()
        self._jobs: SimpleQueue[tuple[JobKind, Any] | None] = SimpleQueue()
        self._results: SimpleQueue[_Answer] = SimpleQueue()
        self._news: Any = None  # of the job in hand: the newest
        self._ready = Event()
        # Pipes block, and a job is tens of megabytes: a thread of its own waits for them.
        self._carrier = Thread(target=self._carry, name=name, daemon=True)
        self._carrier.start()

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return self._process.pid

    def give(self, kind: JobKind, work: Any) -> None:
        """Hand over a job; one at a time."""
        self._jobs.put((kind, work))

    def news(self) -> Any:
        """Return what the job in hand has told since the last call, the newest of it; None where nothing."""
        news, self._news = self._news, None
        return news

    def result(self, wait_s: float = 0.0) -> _Answer | None:
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
        """Carry jobs to the process and results back, until told to stop or the process is gone."""
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
                self._results.put(_Answer(Failure(FailureReason.WORKER, detail)))


def serve(connection: Connection, make_handlers: MakeHandlers, niceness: int = 0) -> None:
    """Do jobs until the other end of the pipe is closed: what a worker process does."""
    if niceness:
        os.nice(niceness)
    keep_freed_memory()
    handlers, channel = make_handlers(), Channel(connection, gives=False)

    def tell(news: Any) -> None:
        with suppress(BrokenPipeError):  # the result will meet it too
            channel.send_in_passing(_News(news))

    try:
        channel.send(None)
    except BrokenPipeError:
        return
    while True:
        try:
            kind, work = channel.receive()
        except EOFError:
            return
        began_s = time.process_time()
        result = handlers[kind](work)
        if isinstance(result, Generator):
            result = result_of(result, tell)
        try:
            channel.send(_Answer(result, time.process_time() - began_s, peak_rss_mb()))
        except BrokenPipeError:  # nobody waits for it any more
            return
        del work, result  # as they go with the next job, what they held may go


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """Processes for some kinds of jobs.

    Attributes
    ----------
    name : str
    kinds : sequence of JobKind
        The most urgent first: where several jobs wait, one of it goes first.
    make_handlers : callable
    n_workers : int
        Jobs that run at the same time; further ones wait their turn.
    time_limit_s : float
        How long a job may take before its worker counts as hung.
    niceness : int
        See `Worker`.
    max_waiting : int
        Jobs of a kind that may wait for a worker.
    """

    name: str
    kinds: Sequence[JobKind]
    make_handlers: MakeHandlers
    n_workers: int
    time_limit_s: float
    niceness: int = 0
    max_waiting: int = MAX_WAITING


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    kind: JobKind
    work: Any
    submitted_s: float


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    job: _Job
    worker: Worker
    began_s: float


@dataclass(slots=True, eq=False)
class _Queue:
    """A lane at work."""

    lane: Lane
    idle: list[Worker]
    busy: list[_Task] = field(default_factory=list)
    waiting: list[_Job] = field(default_factory=list)
    n_stillborn: int = 0

    def replaced(self, worker: Worker) -> Worker:
        """Return a new worker for one that is lost.

        Raises
        ------
        ConfigError
            If several in a row have ended before they were ready.
        """
        self.n_stillborn = 0 if worker.was_ready else self.n_stillborn + 1
        worker.stop()
        if self.n_stillborn > MAX_STILLBORN:
            raise ConfigError(
                f"the {self.lane.name} process ends as it starts, {self.n_stillborn} times in a row. A script that "
                'uses workers runs its code below `if __name__ == "__main__":`, as every process imports it; or set '
                "recovery.workers to 0."
            )
        return _worker(self.lane)


@dataclass(slots=True)
class QueueStatistics:
    """Statistics of the jobs of a kind.

    Attributes
    ----------
    n_done, n_failed : int
        Jobs that have ended; and those of them whose worker died or hung, or that were one too many.
    max_waiting : int
        Jobs that waited at the same time.
    longest_s : float
        From when a job was submitted to its end.
    wall_s : float
        The same, all jobs together.
    cpu_s : float
        Of the processes.
    peak_rss_mb : float
        Highest resident memory that a process had had when it ended one: all that is done in a lane is in it.
    """

    n_done: int = 0
    n_failed: int = 0
    max_waiting: int = 0
    longest_s: float = 0.0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_rss_mb: float = 0.0


class WorkerDesk:
    """The `dualslam.workers.jobs.Desk` whose jobs run in processes of their own.

    Parameters
    ----------
    lanes : sequence of Lane
        No kind stands in two of them.
    finish_wait_s : float
        How long the end of the run waits for what is under way.
    on_start : callable, optional
        Called with each job that a process begins (kind and work), and the process's id: where the failure lab takes
        hold.
    on_news : callable, optional
        Called, where a job's result is asked for, with what its process has told of it meanwhile.
    """

    def __init__(
        self,
        lanes: Sequence[Lane],
        finish_wait_s: float,
        on_start: Callable[[JobKind, Any, int | None], None] | None = None,
        on_news: Callable[[Any], None] | None = None,
    ) -> None:
        self.on_start = on_start
        self.on_news = on_news
        self.statistics: defaultdict[JobKind, QueueStatistics] = defaultdict(QueueStatistics)
        self._finish_wait_s = finish_wait_s
        self._queues: list[_Queue] = []
        self._by_kind: dict[JobKind, _Queue] = {}
        self._ended: defaultdict[JobKind, list[Ended]] = defaultdict(list)
        for lane in lanes:
            self.open(lane)

    @property
    def pids(self) -> list[int | None]:
        """Process ids of the workers, lane by lane, the busy ones first."""
        return [w.pid for queue in self._queues for w in [*(task.worker for task in queue.busy), *queue.idle]]

    def wait_until_ready(self) -> bool:
        """Wait, for a limited time, until all workers are warm: once the clock runs, it does not wait for imports."""
        return all(worker.wait_until_ready(START_S) for queue in self._queues for worker in queue.idle)

    def open(self, lane: Lane) -> None:
        """Start the processes of one more lane."""
        queue = _Queue(lane, [_worker(lane) for _ in range(lane.n_workers)])
        self._queues.append(queue)
        self._by_kind |= dict.fromkeys(lane.kinds, queue)

    def ask(self, kind: JobKind, work: Any) -> Ended:
        """Have a job done and wait for it, for as long as the lane allows. For one thread, which alone asks for it."""
        self.submit(kind, work)
        queue = self._by_kind[kind]
        while not (ended := self._ended.pop(kind, [])):
            if not queue.busy:
                return Ended(work, Failure(FailureReason.WORKER, "the processes were told to end"))
            self._look(queue, wait=True)
        return ended[0]

    def submit(self, kind: JobKind, work: Any) -> None:
        """Give the job to an idle worker, or let it wait for one."""
        queue = self._by_kind[kind]
        n_waiting = sum(job.kind is kind for job in queue.waiting)
        if n_waiting >= queue.lane.max_waiting:
            self._end(kind, Ended(work, Failure(FailureReason.BUSY, f"{n_waiting} jobs wait for a {kind} already")))
            return
        queue.waiting.append(_Job(kind, work, time.monotonic()))
        self._hand_out(queue)
        statistics = self.statistics[kind]
        statistics.max_waiting = max(statistics.max_waiting, sum(job.kind is kind for job in queue.waiting))

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what has ended since the last call; never wait."""
        self._look(self._by_kind[kind])
        return self._ended.pop(kind, [])

    def n_open(self, kind: JobKind) -> int:
        """Count the jobs of a kind that wait or run."""
        queue = self._by_kind.get(kind)
        if queue is None:
            return 0
        return sum(job.kind is kind for job in [*queue.waiting, *(task.job for task in queue.busy)])

    def drain(self, kind: JobKind) -> list[Ended]:
        """Wait, for a limited time, for what is under way; what has not ended by then ends as a `Failure`."""
        queue, ended, began_s = self._by_kind[kind], self.poll(kind), time.monotonic()
        while self.n_open(kind) and time.monotonic() - began_s < self._finish_wait_s:
            time.sleep(PAUSE_S)
            ended += self.poll(kind)
        late = Failure(FailureReason.TIMEOUT, f"the run ended, and {self._finish_wait_s:g} s later its {kind} had not")
        open_jobs = [*(task.job for task in queue.busy if task.job.kind is kind), *queue.waiting]
        ended += [Ended(job.work, late) for job in open_jobs if job.kind is kind]
        queue.waiting = [job for job in queue.waiting if job.kind is not kind]
        for task in [task for task in queue.busy if task.job.kind is kind]:
            queue.busy.remove(task)
            task.worker.stop()
        return ended

    def close(self) -> None:
        """End the workers."""
        for queue in self._queues:
            for task in queue.busy:
                task.worker.stop()
            for worker in queue.idle:
                worker.stop(STOP_S)
            queue.busy, queue.idle, queue.waiting = [], [], []

    def _look(self, queue: _Queue, wait: bool = False) -> None:
        """See what has ended in a lane, and give its idle workers what waits; `wait`: for as long as a job may take."""
        for task in list(queue.busy):
            limit_s = queue.lane.time_limit_s
            if self.on_news is not None and (news := task.worker.news()) is not None:
                self.on_news(news)
            answer = task.worker.result(limit_s if wait else 0.0)
            if answer is None and time.monotonic() - task.began_s > limit_s:
                answer = _Answer(Failure(FailureReason.TIMEOUT, f"the {task.job.kind} took longer than {limit_s:g} s"))
            if answer is None:
                continue
            queue.busy.remove(task)
            wall_s = time.monotonic() - task.job.submitted_s
            self._end(task.job.kind, Ended(task.job.work, answer.result, answer.cpu_s, wall_s))
            statistics = self.statistics[task.job.kind]
            statistics.peak_rss_mb = max(statistics.peak_rss_mb, answer.peak_rss_mb)
            queue.idle.append(queue.replaced(task.worker) if _is_lost(answer.result) else task.worker)
        self._hand_out(queue)

    def _end(self, kind: JobKind, ended: Ended) -> None:
        statistics = self.statistics[kind]
        statistics.n_done += 1
        statistics.n_failed += _is_lost(ended.result)
        statistics.longest_s = max(statistics.longest_s, ended.wall_s)
        statistics.wall_s += ended.wall_s
        statistics.cpu_s += ended.cpu_s
        self._ended[kind].append(ended)

    def _hand_out(self, queue: _Queue) -> None:
        while queue.waiting and queue.idle:
            worker = queue.idle.pop(0)
            if not worker.alive:
                log.warning("a %s process had ended while idle; starting another one", queue.lane.name)
                worker = queue.replaced(worker)
            job = min(queue.waiting, key=lambda job: queue.lane.kinds.index(job.kind))  # the first of equals
            queue.waiting.remove(job)
            worker.give(job.kind, job.work)
            queue.busy.append(_Task(job, worker, time.monotonic()))
            if self.on_start is not None:
                self.on_start(job.kind, job.work, worker.pid)


def _is_lost(result: Any) -> bool:
    """Whether it was no answer, but the end of a worker, or of the patience with one."""
    reasons = (FailureReason.WORKER, FailureReason.TIMEOUT, FailureReason.BUSY)
    return isinstance(result, Failure) and result.reason in reasons


def _worker(lane: Lane) -> Worker:
    return Worker(lane.make_handlers, lane.niceness, f"dualslam {lane.name}")
