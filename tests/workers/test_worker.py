"""Work in processes of its own: the same result as inline, and no way in which a worker can take the run down."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dualslam.build import recovery_parts, walk_handlers
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.grey_image import GreyImage
from dualslam.core.jobs import JobKind, Limit
from dualslam.core.types import Failure, Frame, LateFrame
from dualslam.recovery.job import RecoveryJob, RecoveryResult
from dualslam.recovery.reverse_tracking import run_recovery
from dualslam.run.results import trajectories_of
from dualslam.testing.point_world import CAMERA, PointWorld, cloud, hand_held, pose_errors, system_in
from dualslam.testing.walks import KeptWalks, replace_walks
from dualslam.workers.desk import Lane, WorkerDesk

COVERED = frozenset(range(35, 50))
MAKE_PARTS = partial(recovery_parts, Config(), CAMERA)
MAKE_HANDLERS = partial(walk_handlers, Config(), CAMERA, 1)
PATIENCE_S = 120.0  # of the test, on a busy machine


@pytest.fixture(scope="module")
def job() -> RecoveryJob:
    """Reverse tracking that ends with a link."""
    world = PointWorld(cloud(600), hand_held(60), covered=COVERED)
    system = system_in(world, recovery={"enabled": True})
    kept = replace_walks(system, lambda _: KeptWalks())
    for frame in world.frames():
        system.step(frame)
    _, job = kept.jobs
    return job


@pytest.fixture(scope="module")
def inline(job: RecoveryJob) -> RecoveryResult | Failure:
    """The same job, pickled and done in this process."""
    return run_recovery(pickle.loads(pickle.dumps(job)), MAKE_PARTS())


def walking_desk(time_limit_s: float = PATIENCE_S, finish_wait_s: float = 0.0) -> WorkerDesk:
    return WorkerDesk([Lane("walks", (JobKind.WALK,), MAKE_HANDLERS, 1, time_limit_s)], finish_wait_s)


@pytest.fixture
def desk() -> Iterator[WorkerDesk]:
    desk = walking_desk()
    yield desk
    desk.close()


def wait_for(desk: WorkerDesk) -> RecoveryResult | Failure:
    began_s = time.monotonic()
    while time.monotonic() - began_s < PATIENCE_S:
        for ended in desk.poll(JobKind.WALK):
            return ended.result
        time.sleep(0.02)
    raise AssertionError("the worker gave no result")


def gone(pid: int | None) -> bool:
    try:
        os.kill(pid or 0, 0)
    except ProcessLookupError:
        return True
    return False


def assert_same(a: RecoveryResult | Failure, b: RecoveryResult | Failure) -> None:
    assert isinstance(a, RecoveryResult)
    assert isinstance(b, RecoveryResult)
    assert list(a.submap.keyframes) == list(b.submap.keyframes)
    for name, column in a.submap.landmarks.columns().items():
        assert np.array_equal(column, b.submap.landmarks[name])
    for x, y in zip(a.frames, b.frames, strict=True):
        assert x.pose.keyframe_id == y.pose.keyframe_id
        assert np.array_equal(x.pose.T_kf_cam, y.pose.T_kf_cam)
    told = [[event.as_dict() | {"seconds": None} for event in result.events] for result in (a, b)]
    assert told[0] == told[1]
    assert a.link is not None
    assert b.link is not None
    assert np.array_equal(a.link.estimate.S_old_new, b.link.estimate.S_old_new)


def test_a_recovery_out_of_time_gives_what_it_has(job: RecoveryJob) -> None:
    result = run_recovery(job, recovery_parts(Config(), CAMERA), limit=Limit(after_steps=0))
    assert isinstance(result, RecoveryResult)
    assert result.link is None
    (attempt,) = result.events
    assert attempt.data["verdict"] == "out of time"


@pytest.mark.slow
def test_frames_that_came_too_late_are_posed_by_reverse_tracking() -> None:
    late = range(30, 35)
    world = PointWorld(cloud(600), hand_held(60), covered=COVERED)
    system = system_in(world, recovery={"enabled": True})

    def keep(frame: Frame) -> LateFrame:
        return LateFrame(frame.index, frame.timestamp_s, GreyImage.of(np.zeros((4, 4), np.uint8)))

    system._state.parts = replace(system._state.parts, keep=keep)
    kept = replace_walks(system, lambda _: KeptWalks())
    for frame in world.frames():
        (system.keep if frame.index in late else system.step)(frame)
    _, job = kept.jobs
    assert [frame.index for frame in job.late] == list(late)
    result = run_recovery(job, replace(MAKE_PARTS(), read=lambda frame, camera: world.view(frame.index)))
    assert result.link is not None
    assert set(late) <= {frame.pose.index for frame in result.frames}
    without = run_recovery(replace(job, late=()), MAKE_PARTS())
    assert set(late).isdisjoint(frame.pose.index for frame in without.frames)


@pytest.mark.slow
def test_a_job_can_be_pickled_and_is_left_as_it_was(job: RecoveryJob, inline: RecoveryResult | Failure) -> None:
    before = job.submap.copy()
    here = run_recovery(job, MAKE_PARTS())
    assert_same(here, inline)
    assert isinstance(here, RecoveryResult)
    assert len(here.submap.keyframes) > len(before.keyframes)
    assert list(job.submap.keyframes) == list(before.keyframes)
    for name, column in before.landmarks.columns().items():
        assert np.array_equal(column, job.submap.landmarks[name])


@pytest.mark.slow
def test_a_worker_finds_what_would_be_found_inline_and_stays_warm(
    desk: WorkerDesk, job: RecoveryJob, inline: RecoveryResult | Failure
) -> None:
    pids = desk.pids
    for _ in range(2):
        desk.submit(JobKind.WALK, job)
        assert_same(wait_for(desk), inline)
    assert desk.pids == pids
    assert desk.drain(JobKind.WALK) == []
    desk.close()
    assert gone(pids[0])


@pytest.mark.slow
def test_a_system_with_a_worker_ends_in_one_map() -> None:
    world = PointWorld(cloud(600), hand_held(70), covered=COVERED)
    settings = {"enabled": True, "workers": 1, "finish_wait_s": PATIENCE_S}
    system = system_in(world, recovery=settings)
    for frame in world.frames():
        system.step(frame)
    system.finish()
    assert not system.events.of_kind(EventKind.RECOVERY_FAILED)
    main = trajectories_of(system).main
    assert set(main.index.tolist()) == set(range(70)) - COVERED
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < 0.08
    assert rotation.max() < 0.01
