"""The verdict is that of its gravest reason, and names the frames that a reason is about."""

from __future__ import annotations

from dualslam.system.audit.verdict import Level, Reason, ReasonCode, Verdict

UNPOSED = Reason(ReasonCode.UNPOSED, Level.USABLE, "Frames are missing.", 40, 90)
JUMP = Reason(ReasonCode.JUMP, Level.DOUBTFUL, "It jumps.", 50, 51)


def test_a_run_without_a_reason_is_good() -> None:
    verdict = Verdict.of([])
    assert verdict == Verdict(Level.GOOD)
    assert verdict.as_dict() == {"level": "good", "reasons": [], "scores": {}}
    assert str(verdict) == "good"


def test_a_remark_leaves_a_run_good_and_its_frames_undoubted() -> None:
    verdict = Verdict.of([Reason(ReasonCode.CLOCK, Level.GOOD, "Check the clock.", 0, 9)], {"jump": 3.0})
    assert str(verdict) == "good: Check the clock."
    assert verdict.doubt_about(5) == ""
    assert verdict.as_dict()["scores"] == {"jump": 3.0}


def test_the_gravest_reason_comes_first_and_gives_the_level() -> None:
    verdict = Verdict.of([UNPOSED, JUMP])
    assert verdict.level is Level.DOUBTFUL
    assert verdict.as_dict()["reasons"] == [
        {"code": "jump", "text": "It jumps.", "first_frame": 50, "last_frame": 51},
        {"code": "unposed", "text": "Frames are missing.", "first_frame": 40, "last_frame": 90},
    ]
    assert Verdict.of([UNPOSED]).level is Level.USABLE


def test_a_frame_has_the_gravest_reason_that_is_about_it() -> None:
    verdict = Verdict.of([UNPOSED, JUMP])
    assert [verdict.doubt_about(i) for i in (39, 40, 50, 90, 91)] == ["", "unposed", "jump", "unposed", ""]


def test_three_reasons_are_told() -> None:
    reasons = [Reason(code, Level.USABLE, "", 0, 1) for code in ReasonCode]
    assert [reason.code for reason in Verdict.of(reasons).reasons] == list(ReasonCode)[:3]
