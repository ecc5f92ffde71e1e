"""What is told of reverse tracking while it is under way: where it is, in order, and nothing that changes it."""

from __future__ import annotations

import multiprocessing
from itertools import pairwise

import numpy as np
import pytest

from dualslam.build import recovery_parts
from dualslam.core import walk_news
from dualslam.core.config.settings import Config
from dualslam.core.jobs import JobKind
from dualslam.core.types import Failure, FailureReason
from dualslam.core.walk_news import MAX_POINTS, WalkNews, WalkTrace
from dualslam.recovery.job import RecoveryJob, RecoveryResult
from dualslam.recovery.reverse_tracking import run_recovery
from dualslam.testing.point_world import CAMERA, PointWorld, cloud, hand_held, pose_errors, system_in
from dualslam.workers.desk import WorkerDesk
from dualslam.workers.transport import Channel
from tests.workers.test_worker import COVERED, assert_same, wait_for
from tests.workers.test_worker import desk as desk
from tests.workers.test_worker import job as job

PARTS = recovery_parts(Config.model_validate({"recovery": {"attempts": ["live"]}}), CAMERA)
POSITION_M, ROTATION_RAD = 0.08, 0.01


def world() -> PointWorld:
    return PointWorld(cloud(), hand_held(60), covered=COVERED)


@pytest.fixture(scope="module")
def walked(job: RecoveryJob) -> tuple[RecoveryResult, list[WalkNews]]:
    """A walk that tells of each frame."""
    news: list[WalkNews] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(walk_news, "EVERY_S", 0.0)
        result = run_recovery(job, PARTS, news.append)
    assert isinstance(result, RecoveryResult)
    return result, news


def test_a_walk_tells_where_it_is(job: RecoveryJob, walked: tuple[RecoveryResult, list[WalkNews]]) -> None:
    result, news = walked
    frames = [told.frame for told in news]
    assert frames == [view.index for view in job.views][: len(news)], "latest first, and each once"
    confirmed = {max(COVERED) - len(COVERED)}  # the first beyond the gap, by the one after it
    assert {told.frame for told in news if told.is_posed} == {f.pose.index for f in result.frames} - confirmed
    assert {told.frame for told in news if not told.is_posed} == COVERED | confirmed
    assert news[-1].n_posed == len(result.frames)
    assert {told.submap_id for told in news} == {job.submap.id}

    posed = [told for told in news if told.is_posed]
    T_found = np.array([told.T_submap_cam for told in posed], np.float64)
    translation, rotation = pose_errors(T_found, world().T_world_cam[[told.frame for told in posed]])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


def test_the_way_grows_at_its_early_end_and_is_whole_each_time(
    job: RecoveryJob, walked: tuple[RecoveryResult, list[WalkNews]]
) -> None:
    news = walked[1]
    start = job.submap.T_submap_kf[job.newest_id][:3, 3]
    for told in news:
        np.testing.assert_allclose(told.way[-1], start, atol=1e-2)
        assert len(told.way) == told.n_posed + 1
        assert told.T_submap_cam is None or np.array_equal(told.way[0], told.T_submap_cam[:3, 3])
    for before, after in pairwise(news):
        assert after.n_posed >= before.n_posed + after.is_posed
        kept = {point.tobytes() for point in after.way}
        assert all(point.tobytes() in kept for point in before.way)


def test_nobody_is_told_too_often_or_too_much() -> None:
    trace = WalkTrace(0, "live", 5000, np.zeros(3))
    points = PointWorld(cloud(), hand_held(1))
    for i in range(1000):
        trace.note(points.view(0), Failure(FailureReason.TOO_FEW_MATCHES))
        trace._centres[4999 - i] = np.array([0.0, 0.0, -i - 1.0])
    told = trace.news()
    assert told is not None
    assert trace.news() is None, "it was told just before"
    assert len(told.way) == MAX_POINTS
    assert told.way[[0, -1], 2].tolist() == [-1000.0, 0.0]
    steps = np.diff(told.way[:, 2])
    assert steps.min() >= 7
    assert steps.max() <= 8


def test_who_listens_changes_nothing(job: RecoveryJob, walked: tuple[RecoveryResult, list[WalkNews]]) -> None:
    assert_same(run_recovery(job, PARTS), walked[0])


def test_a_worker_tells_while_it_walks(
    desk: WorkerDesk, job: RecoveryJob, walked: tuple[RecoveryResult, list[WalkNews]]
) -> None:
    news: list[WalkNews] = []
    desk.on_news = news.append
    desk.submit(JobKind.WALK, job)
    result = wait_for(desk)
    assert news, "the first is told at once"
    for attempt in {told.attempt for told in news}:
        frames = [told.frame for told in news if told.attempt == attempt]
        assert frames == sorted(set(frames), reverse=True)
    assert isinstance(result, RecoveryResult)
    assert result.link is not None
    assert walked[0].link is not None
    assert np.array_equal(result.link.estimate.S_old_new, walked[0].link.estimate.S_old_new)


def test_news_are_lost_where_nobody_takes_them_and_nobody_waits() -> None:
    ours, theirs = multiprocessing.Pipe()
    there, here = Channel(theirs, gives=False), Channel(ours, gives=True)
    sent = [n for n in range(2000) if there.send_in_passing((n, bytes(2000)))]
    assert 10 < len(sent) < 1000
    assert [here.receive()[0] for _ in sent] == sent
    assert there.send_in_passing("again")
    assert here.receive() == "again"
    ours.close()
    with pytest.raises(OSError, match=r"."):
        there.send_in_passing("nobody")


def test_frames_are_told_as_the_source_counts_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sequence that is read from its end: reverse tracking leads to larger indices."""
    monkeypatch.setattr(walk_news, "EVERY_S", 0.0)
    told: list[WalkNews] = []
    system = system_in(world(), recovery={"enabled": True, "attempts": ["live"]})
    system.watch_walks(told.append)
    for frame in reversed(list(world().frames())):
        system.step(frame)
    over_the_gap = [news.frame for news in told if news.submap_id == 1]
    assert over_the_gap == sorted(over_the_gap)
    assert set(over_the_gap) > COVERED
