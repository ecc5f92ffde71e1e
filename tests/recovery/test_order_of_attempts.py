"""Which attempts are made, and when one ends that poses what others have not recognised."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from dualslam.core.config.settings import HealthConfig
from dualslam.core.jobs import result_of
from dualslam.core.types import Failure, FailureReason
from dualslam.recovery.job import Attempt, RecoveryJob, RecoveryResult
from dualslam.recovery.reverse_tracking import recover_in_steps, track_in_reverse
from dualslam.recovery.schedule import LinkTries
from dualslam.recovery.walk import Walk

BLANK, UNKNOWN = Failure(FailureReason.NO_TEXTURE), Failure(FailureReason.DEGENERATE)
LOOSE, LOST = Failure(FailureReason.SCALE), Failure(FailureReason.SCALE_LOST)


def recover(monkeypatch: pytest.MonkeyPatch, seen: dict[str, list[Failure]], first_alone: bool = False) -> list[str]:
    """Return which of the attempts `first` and `follower` are made; `seen`: of each, the frames without a pose."""
    made: list[str] = []

    def walk(job: RecoveryJob, parts: Any, attempt: Attempt, tries: LinkTries) -> Any:
        made.append(attempt.name)
        walked = Walk(job, attempt.name, job.submap, tries)
        for failure in seen[attempt.name]:
            if failure in (BLANK, UNKNOWN):
                walked.note_unusable(failure)
            else:
                walked.note_refused(failure)
        yield None
        return walked

    monkeypatch.setattr("dualslam.recovery.reverse_tracking._walk", walk)
    new: Any = SimpleNamespace
    attempts = Attempt("first", new), Attempt("follower", new, max_unrecognised=5)
    submap: Any = SimpleNamespace(copy=lambda: None)
    job = RecoveryJob(submap, 9, {0: submap}, {}, (), (), new(), None, first_alone=first_alone)
    parts: Any = SimpleNamespace(attempts=attempts, max_scale_sigma=0.025)
    result = result_of(recover_in_steps(job, parts))
    assert isinstance(result, RecoveryResult)
    stopped = all({BLANK.reason, UNKNOWN.reason} >= {failure.reason for failure in seen[name]} for name in made)
    assert result.stopped_at == (9 if stopped and all(seen[name] for name in made) else None)
    return made


@pytest.mark.parametrize(
    ("first", "first_alone", "made"),
    [
        ([BLANK, UNKNOWN], False, ["first", "follower"]),
        ([BLANK, BLANK], False, ["first"]),
        ([], False, ["first"]),
        ([BLANK, UNKNOWN], True, ["first"]),
        ([BLANK, LOOSE], False, ["first", "follower"]),
        ([BLANK, LOST], False, ["first"]),
        ([UNKNOWN, LOST], False, ["first", "follower"]),
    ],
    ids=["not recognised", "nothing to see", "all posed", "first alone", "loose", "scale lost", "skipped, scale lost"],
)
def test_a_follower_is_made_once_if_it_may_do_better(
    monkeypatch: pytest.MonkeyPatch, first: list[Failure], first_alone: bool, made: list[str]
) -> None:
    assert recover(monkeypatch, {"first": first, "follower": [UNKNOWN]}, first_alone) == made


@pytest.mark.parametrize(
    ("limit", "failures", "n_steps"),
    [(None, [UNKNOWN] * 9, 7), (3, [UNKNOWN] * 9, 3), (3, [BLANK, UNKNOWN] * 5, 6), (3, [BLANK] * 9, 7)],
)
def test_it_ends_where_it_does_not_recognise_what_it_sees(
    limit: int | None, failures: list[Failure], n_steps: int
) -> None:
    left = iter(failures)
    tracker: Any = SimpleNamespace(track=lambda view: next(left))
    views: Any = [SimpleNamespace(index=i) for i in range(len(failures))]
    assert len(list(track_in_reverse(tracker, views, HealthConfig(), set(), 6, limit))) == n_steps
