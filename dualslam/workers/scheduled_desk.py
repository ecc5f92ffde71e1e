"""The desk of a system: jobs are done by an executor, and their answers are given out as a schedule says.

An executor does the work, in this process (`InlineDesk`) or in others (`WorkerDesk`), and knows nothing of frames. The
schedule (`dualslam/core/schedule.py`) says in which frame an answer is used, whichever executor does the work. In real
time answers are used in the first frame that begins after they are there, and recorded.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

from dualslam.core.jobs import MAX_WAITING, PAUSE_S, Ended, Executor, JobKind, Limit
from dualslam.core.schedule import (
    AT_END,
    AT_ONCE,
    OK,
    OPEN,
    WITHDRAWN,
    AnswerRecord,
    Lateness,
    Policy,
    Recorded,
    Request,
    When,
)
from dualslam.core.types import Failure, FailureReason

UNANSWERED = frozenset({JobKind.FORESIGHT})
"""Kinds whose results stay where they were made: they only save time."""


class ScheduledDesk:
    """The `dualslam.core.jobs.Desk` whose answers come by a schedule.

    - `policy`: when answers are given out, where nobody's clock goes on.
    - `finish_wait_s`: how long the end of a run that was interrupted waits for what is under way.
    - `budget_s`: time after which a job that can stop early must, in real time.

    - `on_record`: called with each line of the schedule as soon as it is known.
    """

    def __init__(
        self, executor: Executor, policy: Policy = AT_ONCE, finish_wait_s: float = 0.0, budget_s: float | None = None
    ) -> None:
        self.executor = executor
        self.on_record: Callable[[dict[str, Any]], None] | None = None
        self.policy = policy
        self._finish_wait_s = finish_wait_s
        self._budget_s = budget_s
        self._step = 0
        self._frame: When = None
        self._is_live = False  # in real time: nothing is waited for
        self._is_brief = False  # the end is waited for only so long
        self._is_draining = False
        self._n = 0
        self._open: dict[int, Request] = {}
        self._arrived: dict[int, Ended] = {}  # by request, not given out yet
        self._given: defaultdict[JobKind, list[Ended]] = defaultdict(list)

    @property
    def recorded(self) -> Recorded | None:
        """The schedule that is repeated; None where there is none."""
        return self.policy if isinstance(self.policy, Recorded) else None

    # --- time

    def begin_frame(self, frame: int, in_real_time: bool = False) -> None:
        """Give out what is due by this frame (its index in the source)."""
        self._step += 1
        self._frame = frame
        self._is_live = in_real_time and self.recorded is None
        self._give_out()

    def begin_end(self, interrupted: bool = False) -> None:
        """Say that no frame comes any more; `interrupted`: someone is waiting."""
        self._frame = AT_END
        self._is_brief = interrupted and self.recorded is None

    def recorded_lateness(self, frame: int) -> Lateness | None:
        """Return how late a frame was in the run that is repeated; None where there is none, or no clock."""
        return None if self.recorded is None else self.recorded.lateness.get(frame)

    def lateness(self, frame: int, late_s: float, held_s: float) -> Lateness:
        """Record how late a frame is, in real time; return it as it is, or was in the run that is repeated."""
        if (recorded := self.recorded_lateness(frame)) is not None:
            late_s, held_s = recorded.late_s, recorded.held_s
        self._record({"frame": frame, "late_s": late_s, "held_s": held_s})
        return Lateness(late_s, held_s)

    # --- jobs

    def submit(self, kind: JobKind, work: Any, of: int | None = None) -> None:
        """Take a job on; one too many ends at once, as a `Failure`. `of`: see `Desk`."""
        if kind in UNANSWERED:
            self.executor.submit(kind, work)
            return
        request = Request(self._n, kind, of, self._step, self._frame, work)
        self._n += 1
        self._open[request.number] = request
        self._begin(request)
        if not self._is_live:
            self._give_out()

    def _begin(self, request: Request) -> None:
        recorded = self.recorded
        record = None if recorded is None else recorded.record_of(request)
        if record is not None and record.is_lost:
            self._arrived[request.number] = Ended(request.work, record.failure())
            self.executor.lose(request.kind)
        elif self.n_open(request.kind) > MAX_WAITING:
            detail = f"{MAX_WAITING} jobs of the kind {request.kind} are open already"
            self._give(request, Ended(request.work, Failure(FailureReason.BUSY, detail)))
        else:
            limit = Limit(after_s=self._budget_s) if self._is_live else Limit()
            self.executor.submit(
                request.kind, request.work, request.submap, limit if recorded is None else recorded.limit_of(request)
            )

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what has been given out of a kind since the last call, in the order of the requests."""
        if kind in UNANSWERED:
            self.executor.poll(kind)
            return []
        return self._given.pop(kind, [])

    def n_open(self, kind: JobKind, of: int | None = None) -> int:
        """Count the requests of a kind whose answers are still to come; `of`: of one submap."""
        return sum(r.kind is kind and of in (None, r.submap) for r in self._open.values())

    def withdraw(self, of: int) -> None:
        """Drop the requests of a submap that is no longer live: their answers are never given out."""
        for request in [r for r in self._open.values() if r.submap == of]:
            del self._open[request.number]
            self._arrived.pop(request.number, None)
            self._note(request, None, WITHDRAWN)
        self.executor.withdraw(of)

    def drain(self, kind: JobKind) -> list[Ended]:
        """Give out the answers of a kind now, due or not; wait for them, after an interruption for a limited time."""
        requests = [r for r in self._open.values() if r.kind is kind]
        self._is_draining = True
        if self._is_brief:
            self._wait_briefly(requests)
        else:
            self._hand_over(requests)
        self._is_draining = False
        return self.poll(kind)

    def close(self) -> None:
        """End the processes, and what they do."""
        for request in self._open.values():
            self._note(request, None, OPEN)
        self._open.clear()
        self.executor.close()
        if self.recorded is not None and self._frame == AT_END:
            self.recorded.note_end(self._n)

    # --- answers

    def _give_out(self) -> None:
        """Give out what is due: wait for it, or take what is there."""
        if self._is_live:
            self._look({r.kind for r in self._open.values()})
            self._hand_over([r for r in self._open.values() if r.number in self._arrived])
        else:
            self._hand_over([r for r in self._open.values() if self.policy.is_due(r, self._step, self._frame)])

    def _hand_over(self, requests: list[Request]) -> None:
        for request in requests:
            while request.number not in self._arrived:
                self._look([request.kind])
                if request.number not in self._arrived:
                    time.sleep(PAUSE_S)
            self._give(request, self._arrived.pop(request.number))

    def _wait_briefly(self, requests: list[Request]) -> None:
        kinds, began_s = {r.kind for r in requests}, time.monotonic()
        self._look(kinds)
        while any(r.number not in self._arrived for r in requests) and time.monotonic() - began_s < self._finish_wait_s:
            time.sleep(PAUSE_S)
            self._look(kinds)
        late = [r for r in requests if r.number not in self._arrived]
        for kind in {r.kind for r in late}:
            self._take(self.executor.drain(kind, 0.0))
        self._hand_over(requests)

    def _look(self, kinds: Iterable[JobKind]) -> None:
        for kind in kinds:
            self._take(self.executor.poll(kind))

    def _take(self, ended: Iterable[Ended]) -> None:
        for each in ended:
            same = [r for r in self._open.values() if r.work is each.work and r.number not in self._arrived]
            if same:  # else it was withdrawn
                self._arrived[same[0].number] = each

    def _give(self, request: Request, ended: Ended) -> None:
        del self._open[request.number]
        failure = ended.result if isinstance(ended.result, Failure) else None
        recorded = self.recorded
        record = None if recorded is None else recorded.record_of(request)
        if recorded is not None and record is not None:
            was = OK if failure is None else str(failure.reason)
            if record.outcome not in (was, OPEN) and failure is None:
                # The process had lost its state, which only it knew.
                self.executor.lose(request.kind)
                ended = Ended(request.work, failure := record.failure())
            elif record.outcome not in (was, OPEN):
                recorded.depart(self._frame, f"{request.kind} ends as {was}, and did as {record.outcome}")
        outcome, detail = (OK, "") if failure is None else (str(failure.reason), failure.detail)
        self._note(request, self._frame, outcome, detail, ended.stopped_after)
        self._given[request.kind].append(ended)

    def _note(self, request: Request, used: When, outcome: str, detail: str = "", steps: int | None = None) -> None:
        record = AnswerRecord(
            request.number, request.kind, request.submap, request.frame, used, outcome, detail, steps, self._is_draining
        )
        self._record(record.as_row())

    def _record(self, row: dict[str, Any]) -> None:
        if self.on_record is not None:
            self.on_record(row)
