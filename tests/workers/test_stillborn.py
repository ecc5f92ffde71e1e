"""Workers that end as they start: a script that is not guarded, most often. Said, not tried for ever."""

from __future__ import annotations

import time

import pytest

from dualslam.core.errors import ConfigError
from dualslam.core.jobs import Ended, Handlers, JobKind
from dualslam.core.noise_model import MAX_TRIES
from dualslam.core.types import Failure
from dualslam.workers.desk import Lane, WorkerDesk


def end_at_once() -> Handlers:
    raise SystemExit(7)


def submit_until(desk: WorkerDesk, until_s: float, ended: list[Ended]) -> None:
    while time.monotonic() < until_s:
        desk.submit(JobKind.WALK, len(ended))
        while not (answers := desk.poll(JobKind.WALK)):
            time.sleep(0.01)
        ended += answers


def test_workers_that_end_as_they_start_are_told_of_and_cost_their_jobs() -> None:
    desk = WorkerDesk([Lane("walks", (JobKind.WALK,), end_at_once, 1, 60.0)], 60.0)
    ended: list[Ended] = []
    with pytest.raises(ConfigError, match=r'walks process ends as it starts.*if __name__ == "__main__"'):
        submit_until(desk, time.monotonic() + 120, ended)
    assert len(ended) <= MAX_TRIES
    assert all(isinstance(each.result, Failure) for each in ended)
    desk.submit(JobKind.WALK, "there is no worker left")
    assert not desk.poll(JobKind.WALK)[0].result, "who asks and never waits is answered too"
    desk.submit(JobKind.WALK, "nor for this one")
    began_s = time.monotonic()
    assert not desk.drain(JobKind.WALK)[0].result
    assert time.monotonic() - began_s < 30  # of 60: nobody is waited for
    desk.close()
