"""When answers are given out: as stated, whichever executor does the work, and as recorded."""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.core.jobs import MAX_WAITING, Executor, InlineDesk, JobKind, Limit
from dualslam.core.schedule import AT_ONCE, After, Policy, Recorded, header_of
from dualslam.core.types import Failure, FailureReason
from dualslam.testing.desk_work import handlers, lane
from dualslam.testing.lossy import Lossy
from dualslam.testing.waiting import wait_until
from dualslam.workers.desk import WorkerDesk
from dualslam.workers.scheduled_desk import ScheduledDesk

GRAPH, CALIBRATION, WALK = JobKind.GRAPH, JobKind.CALIBRATION, JobKind.WALK


class Sum:
    """Keeps a sum from job to job, as the toys' graph does, and can lose it."""

    def __init__(self) -> None:
        self.total = 0.0

    def __call__(self, number: float) -> float:
        self.total += number
        return self.total

    def forget(self) -> None:
        self.total = 0.0


def in_process() -> InlineDesk:
    return InlineDesk(handlers() | {GRAPH: Sum()})


def ask(desk: ScheduledDesk, n: int = 12, in_real_time: bool = False) -> Iterator[tuple[Any, ...]]:
    """Ask for a sum at each frame, for a double at every third, of one map and then of another; tell what comes."""
    for frame in range(n):
        desk.begin_frame(frame, in_real_time)
        yield frame, [ended.result for ended in desk.poll(GRAPH)], desk.n_open(CALIBRATION)
        desk.submit(GRAPH, float(frame))
        if frame == n // 2:
            desk.withdraw(0)
        if frame % 3 == 0:
            desk.submit(CALIBRATION, np.full(2, float(frame)), of=int(frame > n // 2))
        yield "late", [_told(ended.result) for kind in (GRAPH, CALIBRATION) for ended in desk.poll(kind)]
    desk.begin_end()
    desk.submit(GRAPH, 0.5)
    yield "end", [_told(ended.result) for kind in (CALIBRATION, GRAPH) for ended in desk.drain(kind)]
    desk.close()


def _told(result: Any) -> Any:
    return str(result.reason) if isinstance(result, Failure) else np.asarray(result).tolist()


def recorded(executor: Executor, policy: Policy = AT_ONCE, in_real_time: bool = False) -> tuple[list[Any], Recorded]:
    """What came of a run, and its record as it is read again."""
    rows: list[dict[str, Any]] = [header_of(policy, in_real_time)]
    desk = ScheduledDesk(executor, policy, finish_wait_s=60.0)
    desk.on_record = rows.append
    told = list(ask(desk, in_real_time=in_real_time))
    return told, Recorded.of(json.loads(json.dumps(rows, allow_nan=False)))


def test_at_once_is_where_it_was_asked_for() -> None:
    desk = ScheduledDesk(in_process())
    desk.begin_frame(0)
    desk.submit(CALIBRATION, np.ones(1))
    assert desk.n_open(CALIBRATION) == 0
    assert desk.poll(CALIBRATION)[0].result == 2


@pytest.mark.parametrize("delay", [1, 5])
def test_an_answer_comes_so_many_frames_after_its_question_and_not_before(delay: int) -> None:
    desk, came = ScheduledDesk(in_process(), After({CALIBRATION: delay})), {}
    for frame in range(0, 40, 2):  # of a source of which every second frame is taken
        desk.begin_frame(frame)
        for ended in desk.poll(CALIBRATION):
            came[int(ended.result[0]) // 2] = frame
        if frame < 20:
            desk.submit(CALIBRATION, np.full(1, float(frame)))
    assert came == {frame: frame + 2 * delay for frame in range(0, 20, 2)}


def test_what_never_comes_comes_at_the_end() -> None:
    desk = ScheduledDesk(in_process(), After({CALIBRATION: math.inf}))
    for frame in range(50):
        desk.begin_frame(frame)
        if frame == 3:
            desk.submit(CALIBRATION, np.ones(1))
        assert desk.poll(CALIBRATION) == []
    assert [ended.result.tolist() for ended in desk.drain(CALIBRATION)] == [[2]]


@pytest.mark.parametrize("delays", [{}, {GRAPH: 2, CALIBRATION: 4}, {CALIBRATION: math.inf}])
def test_processes_and_one_process_give_the_same_under_a_schedule(delays: dict[JobKind, float]) -> None:
    policy = After(delays)
    here, record = recorded(in_process(), policy)
    there, other = recorded(WorkerDesk([lane(GRAPH), lane(CALIBRATION, WALK)], 60.0), policy)
    assert here == there
    assert record.answers == other.answers
    assert recorded(in_process(), record)[0] == here
    assert not record.departure


def test_a_run_by_the_clock_is_repeated_from_its_record() -> None:
    """Answers come when they come; what is repeated in one process comes in the same frames."""

    class Slow(InlineDesk):
        """Holds each answer back for some looks."""

        def __init__(self) -> None:
            super().__init__(handlers() | {GRAPH: Sum()})
            self.looks: Counter[JobKind] = Counter()

        def poll(self, kind: JobKind) -> list[Any]:
            self.looks[kind] += 1
            return super().poll(kind) if self.looks[kind] % 7 == 0 else []

    told, record = recorded(Slow(), in_real_time=True)
    assert told != recorded(in_process())[0]
    assert {answer.outcome for answer in record.answers.values()} == {"ok", "withdrawn"}
    again, record_again = recorded(in_process(), record)
    assert again == told
    assert record_again.answers == record.answers
    assert not record.departure


@pytest.mark.parametrize("reason", [FailureReason.WORKER, FailureReason.TIMEOUT])
@pytest.mark.parametrize("policy", [AT_ONCE, After({GRAPH: 3, CALIBRATION: 1})])
def test_lost_jobs_are_lost_again_with_what_their_process_knew(reason: FailureReason, policy: After) -> None:
    lossy = Lossy([GRAPH, CALIBRATION], every=4, reason=reason)
    told, record = recorded(lossy.around(in_process()), policy)
    assert lossy.n_lost > 2
    assert any(str(reason) in each for _, each, *_ in told)
    assert recorded(in_process(), record)[0] == told
    assert not record.departure


def test_one_job_too_many_ends_at_once_and_does_again() -> None:
    def run(policy: Policy) -> tuple[list[Any], Recorded]:
        rows = [header_of(policy, False)]
        desk = ScheduledDesk(in_process(), policy)
        desk.on_record = rows.append
        desk.begin_frame(0)
        for number in range(MAX_WAITING + 2):
            desk.submit(GRAPH, float(number))
        told = [_told(ended.result) for ended in (*desk.poll(GRAPH), *desk.drain(GRAPH))]
        return told, Recorded.of(rows)

    told, record = run(After({GRAPH: 5}))
    assert told[:2] == ["busy"] * 2
    assert len(told) == MAX_WAITING + 2
    assert run(record)[0] == told


def test_a_job_in_steps_stops_after_as_many_as_it_did() -> None:
    def count(n: int) -> Iterator[None]:
        done = 0
        for _ in range(n):
            time.sleep(1e-3)
            if (yield None):
                break
            done += 1
        return done  # type: ignore[return-value]

    rows = [header_of(After(), True)]
    desk = ScheduledDesk(InlineDesk({WALK: count}), After(), budget_s=0.02)
    desk.on_record = rows.append
    desk.begin_frame(0, in_real_time=True)
    desk.submit(WALK, 10_000)
    desk.begin_frame(1, in_real_time=True)
    (ended,) = desk.poll(WALK)
    assert 0 < ended.result < 30
    again = ScheduledDesk(InlineDesk({WALK: count}), Recorded.of(rows), budget_s=0.02)
    again.begin_frame(0)
    again.submit(WALK, 10_000)
    again.begin_frame(1)
    assert again.poll(WALK)[0].result == ended.result
    assert Limit(after_steps=0).is_over(0, 0.0)


def test_a_repetition_that_asks_for_something_else_says_where_and_goes_on() -> None:
    _, record = recorded(in_process(), After({GRAPH: 2}))
    desk = ScheduledDesk(in_process(), record)
    for frame in range(4):
        desk.begin_frame(frame)
        desk.submit(GRAPH, 1.0)
        if frame != 2:
            desk.submit(CALIBRATION, np.ones(1), of=0)
    assert "frame 1: it asks for calibration of submap 0 at 1; the record has graph at 2" in record.departure
    assert desk.drain(CALIBRATION)[0].result == 2


def test_a_repetition_that_asks_for_less_says_so() -> None:
    _, record = recorded(in_process())
    desk = ScheduledDesk(in_process(), record)
    desk.begin_frame(0)
    desk.begin_end()
    desk.close()
    assert "it has asked for 0 jobs" in record.departure


def test_a_run_in_real_time_does_not_wait() -> None:
    desk = ScheduledDesk(WorkerDesk([lane(WALK)], 60.0), finish_wait_s=0.2)
    desk.begin_frame(0, in_real_time=True)
    desk.submit(WALK, ("sleep", 0.0))
    desk.submit(WALK, ("sleep", 600.0))
    ended: list[Any] = []

    def comes() -> bool:
        desk.begin_frame(1, in_real_time=True)
        ended.extend(desk.poll(WALK))
        return bool(ended)

    wait_until(comes)
    assert desk.n_open(WALK) == 1
    desk.begin_end(interrupted=True)
    (late,) = desk.drain(WALK)
    assert late.result.reason is FailureReason.TIMEOUT
    desk.close()


def test_the_end_of_a_run_in_real_time_waits_for_what_is_under_way() -> None:
    desk = ScheduledDesk(WorkerDesk([lane(WALK)], 0.0), finish_wait_s=0.0)
    desk.begin_frame(0, in_real_time=True)
    desk.submit(WALK, ("sleep", 0.3))
    desk.begin_end()
    (ended,) = desk.drain(WALK)
    assert not isinstance(ended.result, Failure)
    desk.close()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "No such file"),
        ('{"schedule": 99}\n', "no schedule of version 1"),
        ('{"schedule": 1}\nnonsense\n{"dropped": 1}\n', "line 2"),
        ('{"schedule": 1}\n{"number": 1}\n', "no schedule of version 1"),
    ],
)
def test_a_file_that_is_no_schedule_is_named(tmp_path: Path, text: str | None, says: str) -> None:
    path = tmp_path / "schedule.jsonl"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        Recorded.read(path)
    assert str(path) in str(caught.value)


def test_a_schedule_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "schedule.jsonl"
    path.write_text('{"schedule": 1, "realtime": true}\n{"dropped": 7}\n{"frame": 8, "late_s"')
    record = Recorded.read(path)
    assert record.dropped == {7}
    assert record.last_frame is None
