"""Features found in a process beside the tracking: the same ones, and a process that dies costs none."""

from __future__ import annotations

import numpy as np

from dualslam.build import feature_handlers
from dualslam.core.config.settings import FrontendConfig
from dualslam.core.jobs import JobKind
from dualslam.core.noise_model import MAX_TRIES
from dualslam.core.types import Failure, Frame
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.testing.desk_work import lane, working
from dualslam.workers.desk import Lane
from dualslam.workers.start_beside import FeaturesBeside
from tests.workers.test_stillborn import end_at_once


def frame(index: int, brightness: int) -> Frame:
    return Frame(index, index / 30, np.full((20, 30), brightness, np.uint8))


def as_it_is(frame: Frame) -> Frame:
    return frame


def test_a_frame_comes_back_with_its_features() -> None:
    with working(lane(JobKind.FEATURES)) as desk:
        found = [FeaturesBeside(desk, as_it_is)(frame(i, i + 1)) for i in range(3)]
    assert [f.index for f in found] == [0, 1, 2]
    assert [int(f.features.descriptors[0, 0]) for f in found if f.features is not None] == [1, 2, 3]
    assert desk.statistics[JobKind.FEATURES].n_done == 3


def test_a_process_that_dies_costs_no_frame() -> None:
    with working(lane(JobKind.FEATURES)) as desk:
        find = FeaturesBeside(desk, as_it_is)
        dead, after = find(frame(0, 0)), find(frame(1, 9))
    assert dead.features is None
    assert dead.image is not None
    assert after.features is not None
    assert desk.statistics[JobKind.FEATURES].n_failed == 1


def test_processes_that_end_as_they_start_cost_no_frame_and_are_asked_no_more() -> None:
    with working(Lane("features", (JobKind.FEATURES,), end_at_once, 1, 60.0)) as desk:
        find, n = FeaturesBeside(desk, as_it_is), MAX_TRIES + 3
        frames = [find(frame(i, 9)) for i in range(n)]
    assert [f.index for f in frames if f.features is None and f.image is not None] == list(range(n))
    assert desk.statistics[JobKind.FEATURES].n_done == MAX_TRIES + 1


def test_a_frame_without_an_image_stays_as_it_is() -> None:
    with working(lane(JobKind.FEATURES)) as desk:
        unread = Frame(0, 0.0, None, "cut off")
        assert FeaturesBeside(desk, as_it_is)(unread) is unread


def test_a_lane_opens_later_and_whoever_asks_waits_for_the_answer() -> None:
    with working(lane(JobKind.GRAPH)) as desk:
        assert desk.n_open(JobKind.WALK) == 0
        desk.open(lane(JobKind.WALK))
        pid, _ = desk.ask(JobKind.WALK, ("sleep", 0.05)).result
        assert pid in desk.pids
        assert isinstance(desk.ask(JobKind.WALK, ("die", 0.0)).result, Failure)


def test_the_worker_finds_what_the_front_end_finds() -> None:
    image = np.random.default_rng(3).integers(0, 256, (120, 160), dtype=np.uint8)
    image = np.kron(image[::8, ::8], np.ones((8, 8), np.uint8))
    here = OrbFrontend(200).extract(image)
    there = feature_handlers(FrontendConfig(n_features=200))[JobKind.FEATURES](image)
    assert len(here) > 50
    np.testing.assert_array_equal(here.uv_px, there.uv_px)
    np.testing.assert_array_equal(here.descriptors, there.descriptors)
