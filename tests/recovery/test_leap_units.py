"""A walk's leap is held against the lost map's camera in one unit, whatever units the two maps have."""

from __future__ import annotations

from types import SimpleNamespace as Fake

import numpy as np
import pytest

from dualslam.config.settings import RecoveryConfig
from dualslam.core.geometry import sim3
from dualslam.core.types import FailureReason, FloatArray
from dualslam.map.trajectory import FramePose
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.recovery.job import RecoveredFrame
from dualslam.recovery.manager import Recoveries
from dualslam.testing.point_world import CAMERA
from tests.recovery.test_earlier_runs import book, enter, pose_frames
from tests.recovery.test_leaps import way, without

FIRST = 1000
FOUND_AFTER = 80  # frames of the lost map that the new one has not seen


def judged(unit: float, off: FloatArray, seed: int) -> object:
    """Return what is said of a walk over ten missing frames that came out `off`, in units of the new map."""
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
    parts = (Fake(), None, Fake(camera=CAMERA, covariance=None), None)
    recoveries = Recoveries(record, FrameBuffer(10.0, 100.0), *parts, RecoveryConfig())  # type: ignore[arg-type]
    link = Fake(old_id=0, estimate=Fake(S_old_new=sim3.from_parts(unit, np.eye(3), np.zeros(3))))
    return recoveries._refuse_leaps(Fake(submap=new, frames=frames, link=link))  # type: ignore[arg-type]


@pytest.mark.parametrize("unit", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_right_walk_is_believed_and_one_that_is_a_period_off_is_not(unit: float, seed: int) -> None:
    assert judged(unit, np.zeros(3), seed) is None
    refused = judged(unit, np.array([-1.5, 0.0, 0.0]), seed)
    assert getattr(refused, "reason", None) is FailureReason.LEAP
