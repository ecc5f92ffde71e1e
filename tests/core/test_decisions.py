"""Decisions: what a comparison says, and which events tell of one."""

from __future__ import annotations

import math

import pytest

from dualslam.core.decisions import Decision, DecisionKind, Gate, Ruling
from dualslam.core.events import EventKind, EventLog
from dualslam.core.types import Failure, FailureReason

GATE = Gate("inliers", 12, ">=", 20)


@pytest.mark.parametrize(
    ("sign", "below", "equal", "above"),
    [(">", False, False, True), (">=", False, True, True), ("<", True, False, False), ("<=", True, True, False)],
)
def test_a_gate_compares_as_its_sign_says_and_nothing_passes_that_is_no_number(
    sign: str, below: bool, equal: bool, above: bool
) -> None:
    outcomes = [Gate("x", value, sign, 2.0).passed for value in (1.0, 2.0, 3.0, math.nan)]
    assert outcomes == [below, equal, above, False]


def test_a_ruling_is_its_answer() -> None:
    assert Ruling(True)
    assert not Ruling(False, (GATE,))


def test_events_that_tell_of_a_decision_are_passed_on_once_someone_listens() -> None:
    log, heard = EventLog(), list[Decision]()
    log.add(EventKind.LINKED, 3, 0.3, 1, old_submap=0)
    log.decisions.write = heard.append
    log.add(EventKind.ARCHIVED, 4, 0.4, 0, why="track lost")
    log.add(EventKind.RECOVERY_ATTEMPT, 5, 0.5, 1, (GATE,), verdict="the buffer ends", frames=7)
    log.add(EventKind.RECOVERY_ATTEMPT, 6, 0.6, 1, verdict="linked")
    log.add(EventKind.LINK_REFUSED, 7, 0.7, 1, (), reason="scale", verdict="scale known to 4 %", tries=2.0)
    walk, linked, refused = heard
    assert walk == Decision(5, DecisionKind.WALK, False, 1, (GATE,), "", "the buffer ends", {"frames": 7})
    assert (linked.frame, linked.accepted) == (6, True)
    assert refused == Decision(7, DecisionKind.LINK, False, 1, (), "scale", "scale known to 4 %", {"tries": 2.0})


def test_a_failure_is_a_decision_with_its_comparisons() -> None:
    why = Failure(FailureReason.TOO_FEW_INLIERS, "12 agree", {"n": 12.0}, gates=(GATE,))
    told = Decision.refused(9, DecisionKind.FRAME, 2, why).as_dict()
    assert told == {
        "frame": 9,
        "what": "frame",
        "accepted": False,
        "submap": 2,
        "reason": "too_few_inliers",
        "detail": "12 agree",
        "gates": [{"name": "inliers", "value": 12, "sign": ">=", "threshold": 20, "passed": False}],
        "data": {"n": 12.0},
    }
