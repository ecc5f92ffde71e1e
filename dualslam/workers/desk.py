"""Background work in processes of its own: warm, fed with jobs, and polled for results without waiting.

A process, because GTSAM holds the interpreter's lock while it solves. A worker that dies, or takes longer than its
time, costs the job that it was busy with: the job ends as a `Failure`, and a fresh worker takes the place.

Workers stand in lanes. One is for the live map's constant requests, so that no reverse tracking of 20 s stands before
its graph. One is for reverse tracking and other long jobs. Where cores are short, the system's scheduler gives way to
the tracking first, then to the live map's lane (`Lane.niceness`). A lane's queue is bounded, and its most urgent kind
goes first.

Workers are spawned, so a script of one's own that asks for them must be importable: what it runs stands under
``if __name__ == "__main__":``.
"""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from dualslam.core.errors import ConfigError
from dualslam.core.jobs import MAX_WAITING, PAUSE_S, Ended, JobKind, Limit
from dualslam.core.noise_model import MAX_TRIES
from dualslam.core.types import Failure, FailureReason
from dualslam.workers.worker import STOP_S, Answer, MakeHandlers, Worker

STOPPED = Failure(FailureReason.WORKER, "the processes have been stopped")
log = logging.getLogger(__name__)


START_S = 60.0
"""How long a run in real time waits for its workers at most: seconds on a free machine."""


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """Processes for some kinds of jobs."""

    name: str
    kinds: Sequence[JobKind]  # the most urgent first: where several jobs wait, one of it goes first
    make_handlers: MakeHandlers
    n_workers: int  # jobs that run at the same time; further ones wait their turn
    time_limit_s: float  # how long a job may take before its worker counts as hung
    niceness: int = 0  # see `Worker`
    max_waiting: int = MAX_WAITING  # jobs of a kind that may wait for a worker


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    kind: JobKind
    work: Any
    submitted_s: float
    of: int | None
    limit: Limit | None


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

        Raises `ConfigError` if several in a row have ended before they were ready.
        """
        self.n_stillborn = 0 if worker.was_ready else self.n_stillborn + 1
        worker.stop()
        if self.n_stillborn > MAX_TRIES:
            raise ConfigError(
                f"the {self.lane.name} process ends as it starts, {self.n_stillborn} times in a row. A script that "
                'uses workers runs its code below `if __name__ == "__main__":`, as every process imports it; or set '
                "recovery.workers to 0."
            )
        return _worker(self.lane)


@dataclass(slots=True)
class QueueStatistics:
    """Statistics of the jobs of a kind."""

    # Jobs that have ended; and those of them whose worker died or hung, or that were one too many.
    n_done: int = 0
    n_failed: int = 0
    max_waiting: int = 0  # jobs that waited at the same time
    longest_s: float = 0.0  # from when a job was submitted to its end
    wall_s: float = 0.0  # the same, all jobs together
    cpu_s: float = 0.0  # of the processes
    peak_rss_mb: float = 0.0
    """Highest resident memory that a process had had when it ended one: all that is done in a lane is in it."""


class WorkerDesk:
    """The executor whose jobs run in processes of their own.

    - `lanes`: no kind stands in two of them.
    - `finish_wait_s`: how long the end of the run waits for what is under way.
    - `on_start`: called with each job that a process begins (kind and work), and the process's id: where the failure
      lab takes hold.
    - `on_news`: called with the job's progress reports, when its result is asked for.
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
            if not queue.busy:  # another thread has closed the desk
                return Ended(work, STOPPED)
            self._look(queue, wait=True)
        return ended[0]

    def submit(self, kind: JobKind, work: Any, of: int | None = None, limit: Limit | None = None) -> None:
        """Give the job to an idle worker, or let it wait for one."""
        queue = self._by_kind[kind]
        n_waiting = sum(job.kind is kind for job in queue.waiting)
        if n_waiting >= queue.lane.max_waiting:
            self._end(kind, Ended(work, Failure(FailureReason.BUSY, f"{n_waiting} jobs wait for a {kind} already")))
            return
        queue.waiting.append(_Job(kind, work, time.monotonic(), of, limit))
        self._hand_out(queue)
        statistics = self.statistics[kind]
        statistics.max_waiting = max(statistics.max_waiting, sum(job.kind is kind for job in queue.waiting))

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what has ended since the last call; never wait."""
        self._look(self._by_kind[kind])
        return self._ended.pop(kind, [])

    def n_open(self, kind: JobKind, of: int | None = None) -> int:
        """Count the jobs of a kind that wait or run; `of`: those that are of use to this submap alone."""
        queue = self._by_kind.get(kind)
        if queue is None:
            return 0
        jobs = [*queue.waiting, *(task.job for task in queue.busy)]
        return sum(job.kind is kind and of in (None, job.of) for job in jobs)

    def withdraw(self, of: int) -> None:
        """Drop the jobs that wait and are of use to this submap alone."""
        for queue in self._queues:
            queue.waiting = [job for job in queue.waiting if job.of != of]

    def drain(self, kind: JobKind, wait_s: float | None = None) -> list[Ended]:
        """Wait, for a limited time, for what is under way; what has not ended by then ends as a `Failure`.

        Other workers take the places of those that were busy with it, for what else waits or is still to come.
        """
        wait_s = self._finish_wait_s if wait_s is None else wait_s
        queue, ended, began_s = self._by_kind[kind], self.poll(kind), time.monotonic()
        while self.n_open(kind) and (queue.busy or queue.idle) and time.monotonic() - began_s < wait_s:
            time.sleep(PAUSE_S)
            ended += self.poll(kind)
        late = Failure(FailureReason.TIMEOUT, f"the run ended, and {wait_s:g} s later its {kind} had not")
        open_jobs = [*(task.job for task in queue.busy if task.job.kind is kind), *queue.waiting]
        ended += [Ended(job.work, late) for job in open_jobs if job.kind is kind]
        queue.waiting = [job for job in queue.waiting if job.kind is not kind]
        for task in [task for task in queue.busy if task.job.kind is kind]:
            queue.busy.remove(task)
            queue.idle.append(queue.replaced(task.worker))
        self._hand_out(queue)
        return ended

    def lose(self, kind: JobKind) -> None:
        """Do nothing: a process that ends loses what it keeps by itself."""

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
                answer = Answer(Failure(FailureReason.TIMEOUT, f"the {task.job.kind} took longer than {limit_s:g} s"))
            if answer is None:
                continue
            queue.busy.remove(task)
            wall_s = time.monotonic() - task.job.submitted_s
            ended = Ended(task.job.work, answer.result, answer.cpu_s, wall_s, answer.stopped_after)
            self._end(task.job.kind, ended)
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
        while queue.waiting and not (queue.idle or queue.busy):  # no process could be started: nobody would do them
            job = queue.waiting.pop(0)
            self._end(job.kind, Ended(job.work, STOPPED))
        while queue.waiting and queue.idle:
            worker = queue.idle.pop(0)
            if not worker.alive:
                log.warning("a %s process had ended while idle; starting another one", queue.lane.name)
                worker = queue.replaced(worker)
            job = min(queue.waiting, key=lambda job: queue.lane.kinds.index(job.kind))  # the first of equals
            queue.waiting.remove(job)
            worker.give(job.kind, job.work, job.limit)
            queue.busy.append(_Task(job, worker, time.monotonic()))
            if self.on_start is not None:
                self.on_start(job.kind, job.work, worker.pid)


def _is_lost(result: Any) -> bool:
    """Whether it was no answer, but the end of a worker, or of the patience with one."""
    reasons = (FailureReason.WORKER, FailureReason.TIMEOUT, FailureReason.BUSY)
    return isinstance(result, Failure) and result.reason in reasons


def _worker(lane: Lane) -> Worker:
    return Worker(lane.make_handlers, lane.niceness, f"dualslam {lane.name}")
