"""A walk's leap is held against the lost map's camera in one unit, whatever units the two maps have."""

from __future__ import annotations

from types import SimpleNamespace as Fake

import numpy as np
import pytest

from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose
from dualslam.core.config.settings import RecoveryConfig
from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import sim3
from dualslam.core.jobs import Ended
from dualslam.core.types import FailureReason, FloatArray, FrameStatus
from dualslam.map.frame_records import FrameRow
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.recovery.job import FoundLink, RecoveredFrame, RecoveryJob, RecoveryResult
from dualslam.recovery.manager import Recoveries, _UnderWay
from dualslam.testing.point_world import CAMERA
from tests.linking.test_motion import way, without
from tests.recovery.test_earlier_runs import book, enter, pose_frames

FIRST = 1000
FOUND_AFTER = 80  # frames of the lost map that the new one has not seen


def walk(unit: float, off: FloatArray, seed: int) -> tuple[Record, Recoveries, RecoveryResult]:
    """Make a walk that has linked to a lost map over ten missing frames, and came out `off`, in the new map's units."""
    record, lost = book()
    new = lost.copy()
    new.id = 1
    record.atlas.add(new)
    t, p = way(200, seed)
    old = range(FIRST, FIRST + 100)
    pose_frames(record, old, t[:100], unit * p[:100], 0)
    enter(record, old, 0)
    t_new, p_new = without(t[FOUND_AFTER:], p[FOUND_AFTER:], 30, 10)
    p_new[:30] += off
    frames = []
    for i, (time_s, centre) in enumerate(zip(t_new, p_new, strict=True)):
        T = np.eye(4)
        T[:3, 3] = centre
        frames.append(RecoveredFrame(FramePose(FIRST + FOUND_AFTER + i, float(time_s), 1, 0, T), 90, 80))
    S, agreeing = sim3.from_parts(unit, np.eye(3), np.zeros(3)), np.array([FIRST + 85])
    link = FoundLink(0, Fake(S_old_new=S, agreeing_keyframes=agreeing, covariance=1e-8 * np.eye(7)), "live")  # type: ignore[arg-type]
    attempt = Event(EventKind.RECOVERY_ATTEMPT, FIRST + FOUND_AFTER, float(t_new[0]), 1, {"attempt": "live"})
    job = RecoveryJob(new, 0, {0: lost}, {0: FIRST + 99}, (), (), CAMERA, None)
    result = RecoveryResult(new, tuple(frames), link, (attempt,), 0.1, 0.1)
    desk = Fake(poll=lambda kind: [Ended(job, result)])
    parts = (desk, None, Fake(camera=CAMERA, covariance=None), None)
    recoveries = Recoveries(record, FrameBuffer(10.0, 100.0), *parts, RecoveryConfig(), list)  # type: ignore[arg-type]
    return record, recoveries, result


@pytest.mark.parametrize("unit", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_right_walk_is_believed_and_one_that_is_a_period_off_is_not(unit: float, seed: int) -> None:
    _, recoveries, right = walk(unit, np.zeros(3), seed)
    assert right.link
    assert recoveries._refuse_motion(right, right.link) is None
    _, recoveries, wrong = walk(unit, np.array([-1.5, 0.0, 0.0]), seed)
    assert wrong.link
    assert getattr(recoveries._refuse_motion(wrong, wrong.link), "reason", None) is FailureReason.LEAP


def test_a_link_that_is_refused_for_its_leap_says_so_beside_what_the_walk_tried() -> None:
    record, recoveries, _ = walk(1.0, np.array([-1.5, 0.0, 0.0]), 0)
    recoveries._under_way[1] = _UnderWay(0.0, 5, again=False)
    recoveries.collect(None, FrameRow(FIRST + 120, 4.0, FrameStatus.TRACKED, 1))
    (refused,) = record.events.of_kind(EventKind.LINK_REFUSED)
    assert refused.data["old_submap"] == 0
    assert refused.data["reason"] == "leap"
    assert refused.data["leap_off"] > refused.data["leap_usual"]
    assert [e.data["attempt"] for e in record.events.of_kind(EventKind.RECOVERY_ATTEMPT)] == ["live"]
    assert record.events.of_kind(EventKind.RECOVERY_FAILED)[0].data["reason"] == "leap"
    assert not record.events.of_kind(EventKind.LINKED)
    assert all(pose.submap_id == 0 for pose in record.poses.values())
