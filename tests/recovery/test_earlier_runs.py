"""In a saved map lie frames of earlier runs, whose clocks began at zero as well: no time leads from theirs to now."""

from __future__ import annotations

from types import SimpleNamespace as Fake

import numpy as np
import pytest

from dualslam.atlas.endings import archive
from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose
from dualslam.core.config.settings import RecoveryConfig
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.types import Failure, FailureReason, FloatArray, FrameStatus, View
from dualslam.map.frame_records import FrameRow
from dualslam.map.submap import Submap
from dualslam.places.plausibility import reachable
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.recovery.fusion import drop_corrupted
from dualslam.recovery.job import RecoveryJob
from dualslam.recovery.manager import Recoveries
from dualslam.system.motion_watch import MotionWatch
from dualslam.testing.graph_scene import guessed_submap, make_scene
from dualslam.testing.point_world import CAMERA, random_features
from tests.linking.test_motion import RATE_HZ, way

N_EARLIER, FIRST = 80, 1000


def book() -> tuple[Record, Submap]:
    """A map of which an earlier run has left all keyframes, and its frames of 4 s."""
    submap = guessed_submap(make_scene(6), pose_noise=0.0)
    record = Record()
    record.atlas.add(submap)
    times_s, places = way(N_EARLIER, 3)
    pose_frames(record, range(N_EARLIER), times_s, places, 0)
    return record, submap


def pose_frames(record: Record, indices: range, times_s: FloatArray, places: FloatArray, submap_id: int) -> None:
    """Pose frames relative to keyframe 0, which stands at the origin."""
    T = np.tile(np.eye(4), (len(indices), 1, 1))
    T[:, :3, 3] = places
    for i, t, T_kf_cam in zip(indices, times_s, T, strict=True):
        record.poses[i] = FramePose(i, float(t), submap_id, 0, T_kf_cam)


def enter(record: Record, indices: range, submap_id: int = 0) -> None:
    """Let frames be this run's own."""
    record.rows.update({i: FrameRow(i, record.poses[i].timestamp_s, FrameStatus.TRACKED, submap_id) for i in indices})


@pytest.mark.parametrize("earlier", [True, False])
def test_what_an_earlier_run_saw_at_this_time_of_its_clock_makes_no_leap(earlier: bool) -> None:
    record, submap = book()
    if not earlier:
        enter(record, range(N_EARLIER))
    times_s, places = way(20, 3)
    now, watch, said = range(FIRST, FIRST + 20), MotionWatch(), []
    watch.begin(View(FIRST, 4.5, random_features(np.random.default_rng(0), 1)))
    for n, i in enumerate(now):
        pose_frames(record, range(i, i + 1), 4.5 + times_s[n : n + 1], places[n : n + 1] - [5, 0, 0], 0)
        enter(record, range(i, i + 1))
        said.append(watch.judge(record.rows[i], False, record, submap))
    assert watch._first_beyond is None, "it has come to an end"
    assert any(verdict is not None for verdict in said) is not earlier


@pytest.mark.parametrize("earlier", [True, False])
def test_a_map_of_this_run_may_show_what_an_earlier_one_saw_moments_before_by_its_clock(earlier: bool) -> None:
    record, submap = book()
    newer = submap.copy()
    newer.id = 1
    record.atlas.add(newer)
    times_s, places = way(60, 3)
    now = range(FIRST, FIRST + 60)
    pose_frames(record, now, 4.5 + times_s, places + [0, 0.05, 0], 1)
    enter(record, now, 1)
    if not earlier:
        enter(record, range(N_EARLIER))
    match = Fake(place=(0, 3), query=(1, 3), S_place_query=np.eye(4), covariance=np.zeros((7, 7)))
    answer: object = reachable(record, match)  # type: ignore[arg-type]
    if earlier:
        assert answer is match
    else:
        assert isinstance(answer, Failure)
        assert answer.reason is FailureReason.LEAP


def lost_and_begun_anew() -> tuple[Recoveries, list[RecoveryJob], Submap, View]:
    """Return recoveries after a loss, the list of what they submit, the new submap, and its newest frame."""
    record, lost = book()
    live = lost.copy()
    live.id = 1
    record.atlas.add(live)
    times_s, places = way(30, 4)
    for m, first in ((0, FIRST), (1, FIRST + 100)):
        pose_frames(record, range(first, first + 30), (first - FIRST) / RATE_HZ + times_s, places, m)
        enter(record, range(first, first + 30), m)
    pose_frames(record, range(500, 530), times_s, places, 1)  # of an earlier run as well
    buffer = FrameBuffer(10.0, 100.0)
    view = View(FIRST + 129, 6.45, random_features(np.random.default_rng(0), 1))
    buffer.append(view)
    jobs: list[RecoveryJob] = []
    parts = (Fake(submit=lambda kind, job: jobs.append(job)), None, Fake(camera=CAMERA, covariance=None), None)
    recoveries = Recoveries(record, buffer, *parts, RecoveryConfig(), list)  # type: ignore[arg-type]
    recoveries.declare_lost(0, FIRST + 28, "inliers", FIRST + 30)
    return recoveries, jobs, live, view


def test_reverse_tracking_is_told_the_ways_of_this_run_alone() -> None:
    recoveries, jobs, live, view = lost_and_begun_anew()
    recoveries.start(live, view)
    (job,) = jobs
    assert [pose.index for pose in job.poses] == list(range(FIRST + 100, FIRST + 130))
    assert job.paths[0].index.tolist() == list(range(FIRST, FIRST + 30))


def test_in_real_time_and_if_made_again_the_first_attempt_is_made_alone() -> None:
    recoveries, jobs, live, view = lost_and_begun_anew()
    recoveries.start(live, view)
    recoveries.start(live, view, now=view)
    recoveries.in_real_time = True
    recoveries.start(live, view)
    assert [job.first_alone for job in jobs] == [False, True, True]


def test_a_saved_map_in_which_no_frame_of_this_run_is_left_is_archived() -> None:
    record, submap = book()
    now = range(FIRST, FIRST + 5)
    pose_frames(record, now, np.arange(5) / RATE_HZ, np.zeros((5, 3)), 0)
    enter(record, now)
    drop_corrupted(record, 0, FIRST)

    def full_estimate(_: Submap) -> None:
        raise SolverError("none")

    archive(record, submap, Fake(full_estimate=full_estimate), "track lost")
    (event,) = record.events.of_kind(EventKind.ARCHIVED)
    assert event.frame == FIRST + 4
