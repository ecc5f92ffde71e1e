"""Reverse tracking that ends late: what it found comes into a map that has gone on, by any schedule."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.trajectory import compose
from dualslam.build import build_system
from dualslam.core.config.settings import Config, LinkingConfig
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.types import Failure, FailureReason, FloatArray, Frame, FrameStatus, View
from dualslam.linking.join_test import LinkEvidence, motion_gate
from dualslam.linking.motion import MIN_ASKED, Motion
from dualslam.recovery.job import RecoveryJob
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, random_features, system_in
from dualslam.testing.walks import Outcome, Walks, replace_walks
from tests.backend.test_self_calibration import wrong_camera
from tests.map.test_submap import assert_consistent
from tests.seeds import first_of
from tests.system.camera.test_lens import CalibrationWorld as CalibrationWorld

N, COVERED = 65, frozenset(range(22, 37))
POSITION_M, ROTATION_RAD = 0.08, 0.01
LEAP = LinkEvidence((motion_gate(Motion(off_mu=9.0, usual_mu=1.0, n_asked=MIN_ASKED)),))


class LateExecutor:
    """Gives each result out only after so many more polls (there is one with each frame)."""

    def __init__(self, inner: Walks, polls: int) -> None:
        self.inner, self.polls = inner, polls
        self.waiting: list[tuple[int, Outcome]] = []
        self.n_polls = 0

    def submit(self, job: RecoveryJob) -> None:
        self.inner.submit(job)
        self.waiting += [(self.n_polls + self.polls, outcome) for outcome in self.inner.poll()]

    def poll(self) -> list[Outcome]:
        self.n_polls += 1
        due = [outcome for at, outcome in self.waiting if at < self.n_polls]
        self.waiting = [(at, outcome) for at, outcome in self.waiting if at >= self.n_polls]
        return due

    def finish(self) -> list[Outcome]:
        left, self.waiting = self.waiting, []
        return [outcome for _, outcome in left]


class FailingExecutor(LateExecutor):
    """One whose jobs all fail."""

    def poll(self) -> list[Outcome]:
        return self._lost(super().poll())

    def finish(self) -> list[Outcome]:
        return self._lost(super().finish())

    @staticmethod
    def _lost(outcomes: list[Outcome]) -> list[Outcome]:
        lost = Failure(FailureReason.WORKER, "the recovery process ended with exit code -9")
        return [(job, lost) for job, _ in outcomes]


def late_system(world: PointWorld, polls: int, **settings: object) -> System:
    system = system_in(world, **({"recovery": {"enabled": True}} | settings))
    replace_walks(system, lambda inner: LateExecutor(inner, polls))
    return system


def run(world: PointWorld, polls: int, **settings: object) -> System:
    system = late_system(world, polls, **settings)
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system


def assert_one_right_map(system: System, world: PointWorld, missing: frozenset[int]) -> None:
    found = trajectories_of(system)
    assert set(found.main.index.tolist()) == set(range(len(world.T_world_cam))) - missing
    translation, rotation = pose_errors(found.main.T_world_cam, world.T_world_cam[found.main.index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


@pytest.fixture(scope="module")
def world() -> PointWorld:
    return PointWorld(cloud(600), hand_held(N), covered=COVERED)


@pytest.mark.parametrize("polls", first_of([12, 1, 20]))
def test_the_live_map_has_grown_meanwhile(world: PointWorld, polls: int) -> None:
    system = run(world, polls)
    (ended,) = system.events.of_kind(EventKind.RECOVERY_ENDED)
    (again,) = system.events.of_kind(EventKind.REINITIALISED)
    assert ended.frame == again.frame + polls
    assert_one_right_map(system, world, COVERED)
    assert not system.events.of_kind(EventKind.RECOVERY_FAILED)
    # Tracking went on as if nothing had happened.
    assert all(system.rows[i].status is FrameStatus.TRACKED for i in range(again.frame, N))
    assert not system.events.of_kind(EventKind.GAP_RELOCALISED)


@pytest.mark.slow
def test_the_live_map_has_rolled_over_meanwhile() -> None:
    world = PointWorld(cloud(600), hand_held(97), covered=COVERED)
    settings = {
        "graph": {"max_keyframes": 20, "rollover_keyframes": 6},
        "keyframes": {"max_parallax_deg": 0.6},
        "mapping": {"redundant_ratio": 1.0},
    }
    system = run(world, 50, **settings)
    (ended,) = system.events.of_kind(EventKind.RECOVERY_ENDED)
    assert system.rows[ended.frame].submap != ended.submap
    assert_one_right_map(system, world, COVERED)


DENSE = {"keyframes": {"max_parallax_deg": 2.0}, "mapping": {"redundant_ratio": 1.0}}


@pytest.fixture(scope="module")
def twice_lost() -> PointWorld:
    return PointWorld(cloud(600), hand_held(107), covered=COVERED | frozenset(range(55, 67)))


@pytest.mark.slow
def test_the_live_map_has_been_lost_meanwhile(twice_lost: PointWorld) -> None:
    """The result goes into the archived map, before the next one starts."""
    system = run(twice_lost, 25, **DENSE)
    first, *later = system.events.of_kind(EventKind.RECOVERY_ENDED)  # one that finds no link is made again
    _, failed = system.events.of_kind(EventKind.FAILED)
    assert failed.frame < first.frame < system.events.of_kind(EventKind.REINITIALISED)[1].frame
    assert first.submap == 1
    assert {ended.submap for ended in later} == {2}
    assert_one_right_map(system, twice_lost, twice_lost.covered)


@pytest.mark.slow
def test_two_walks_overlap(twice_lost: PointWorld) -> None:
    """The second starts from a copy of the lost map that the first one's result is not in yet."""
    system = run(twice_lost, 33, **DENSE)
    first, *later = system.events.of_kind(EventKind.RECOVERY_ENDED)
    assert system.events.of_kind(EventKind.RECOVERY_STARTED)[1].frame < first.frame < later[0].frame
    assert system.events.of_kind(EventKind.RECOVERY_STARTED)[1].data["lost"] == [0, 1]
    assert_one_right_map(system, twice_lost, twice_lost.covered)
    assert not system._recoveries._lost  # all is one map: nothing is left to look for


def prediction_errors(world: PointWorld, polls: int) -> tuple[System, dict[int, FloatArray]]:
    """Turn and shift between what the motion model said of each live frame, and where it was found."""
    system, errors = late_system(world, polls), {}
    for frame in world.frames():
        system.step(frame)
        track = system.live._tracker.last if system.live is not None else None
        if track is not None and track.view.index == frame.index:
            xi = se3.log(track.T_cam_submap @ se3.inverse(track.T_predicted))
            errors[frame.index] = np.array([np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])])
    return system, errors


@pytest.mark.slow
def test_tracking_goes_on_with_no_jump_that_the_motion_model_could_not_explain(world: PointWorld) -> None:
    _, undisturbed = prediction_errors(world, 1000)
    usual = np.max([undisturbed[i] for i in range(47, N)], axis=0)
    system, errors = prediction_errors(world, 15)
    (ended,) = system.events.of_kind(EventKind.RECOVERY_ENDED)
    assert all((errors[i] <= 1.2 * usual).all() for i in range(ended.frame, ended.frame + 3))


def miscalibrated(f: float, covered: range, settings: dict[str, object]) -> tuple[System, CalibrationWorld]:
    """Build a system that is told a focal length `f` times too long, before a lens that is covered for a while."""
    config = Config.model_validate({"tracking": {"max_lost_s": 0.25}} | settings)
    system, world = build_system(config, wrong_camera(f)), CalibrationWorld()
    calibration, rng = system._state.parts.calibration, np.random.default_rng(0)

    def view_of(frame: Frame) -> View:
        if frame.index in covered:
            return View(frame.index, frame.timestamp_s, random_features(rng))
        return world.view(frame, calibration)

    system._state.parts = replace(system._state.parts, view_of=view_of)
    return system, world


@pytest.mark.slow
def test_the_camera_has_been_refined_meanwhile() -> None:
    """What the walk saw by the old camera is merged by the pixels of the new one, and fits the map as it is now."""
    settings = {
        "calibration": {"first_keyframes": 14, "max_observations": 6000},
        "keyframes": {"max_parallax_deg": 1.0},
        "mapping": {"redundant_ratio": 1.0},
        "camera": {"model_sigma_px": 0.0},
    }
    covered = range(12, 26)
    system, world = miscalibrated(1.03, covered, settings)
    replace_walks(system, lambda inner: LateExecutor(inner, 34))
    for i in range(75):
        system.step(Frame(i, i / 30, None))
    system.finish()
    order = [EventKind.RECOVERY_STARTED, EventKind.CALIBRATED, EventKind.RECOVERY_ENDED]
    assert [event.event for event in system.events.of_kind(*order)][:3] == order
    submap = system.atlas.submaps[1]
    assert min(submap.keyframes) < min(covered)
    for keyframe in submap.keyframes.values():
        uv_rect_px, _ = system._state.parts.calibration.camera.rectify(keyframe.features.uv_px)
        np.testing.assert_allclose(keyframe.features.uv_rect_px, uv_rect_px)
    ids = sorted(submap.keyframes)
    truth = np.stack([world.T_world_cam(k) for k in ids])
    translation, rotation = pose_errors(submap.keyframe_poses(ids), truth)
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


@pytest.mark.slow
def test_maps_of_a_wrong_camera_are_linked_anew_after_both_have_been_calibrated() -> None:
    settings = {
        "calibration": {"first_keyframes": 20, "max_observations": 6000},
        "keyframes": {"max_parallax_deg": 1.0},
        "mapping": {"redundant_ratio": 1.0},
        "camera": {"model_sigma_px": 0.0},
        "recovery": {"attempts": ["live"]},
    }
    system, world = miscalibrated(1.03, range(26, 38), settings)
    doubts = [system.step(Frame(i, i / 30, None)).doubt for i in range(75)]
    system.finish()
    refused = system.events.of_kind(EventKind.LINK_REFUSED)
    assert refused, "by the bend that the camera makes, or by what it does to the scales of the two"
    assert {event.data["reason"] for event in refused} <= {"camera", "scale"}
    (calibrated,) = system.events.of_kind(EventKind.CALIBRATED)
    assert calibrated.data["lost"] == [0]
    (linked,) = system.events.of_kind(EventKind.LINKED)
    (relinked,) = system.events.of_kind(EventKind.RELINKED)
    assert refused[0].frame < linked.frame < calibrated.frame <= relinked.frame
    max_sigma = LinkingConfig().max_live_scale_sigma
    assert linked.data["sigma_scale"] > max_sigma > relinked.data["sigma_scale"]
    assert [link.sigma_scale for link in system.atlas.links] == [pytest.approx(relinked.data["sigma_scale"], rel=0.1)]
    # As long as the link is loose, what is posed beyond it has a doubt.
    assert doubts == ["scale" if linked.frame <= i < relinked.frame else "" for i in range(75)]
    assert not system._recoveries.waiting
    for submap in system.atlas.submaps.values():
        np.testing.assert_array_equal(submap.K, system._state.parts.calibration.camera.K)
    main = trajectories_of(system).main
    translation, rotation = pose_errors(main.T_world_cam, np.stack([world.T_world_cam(i) for i in main.index]))
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


def test_the_run_ends_meanwhile(world: PointWorld) -> None:
    system = run(world, 1000)
    (ended,) = system.events.of_kind(EventKind.RECOVERY_ENDED)
    assert ended.frame == N - 1
    assert_one_right_map(system, world, COVERED)


@pytest.mark.parametrize("again", [False, True])
def test_the_lost_map_has_been_found_again_meanwhile(world: PointWorld, again: bool) -> None:
    """What it has posed since is its own, whether or not it has been lost anew."""
    system, frames = late_system(world, 12), iter(world.frames())
    while not system.events.of_kind(EventKind.REINITIALISED):
        system.step(next(frames))
    old, poses = system.atlas.submaps[0], {i: p for i, p in system.poses.items() if p.submap_id == 0}
    system._recoveries.found_again(old)
    if again:
        system._recoveries.declare_lost(0, 32, "inliers", 32)
    while not system.events.of_kind(EventKind.RECOVERY_ENDED):
        system.step(next(frames))
    (ended,) = system.events.of_kind(EventKind.RECOVERY_ENDED)
    assert not ended.data["linked"]
    assert not system.atlas.links
    assert not old.condemned
    assert {i: p for i, p in system.poses.items() if p.submap_id == 0} == poses
    assert system._recoveries.waiting == ([0] if again else [])


def test_a_link_that_leaps_must_hold_anew(world: PointWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dualslam.recovery.manager.judge_motion", lambda _: LEAP)
    monkeypatch.setattr("dualslam.recovery.schedule.tightened", lambda *_: 0.0)  # sure as it may be, it holds twice
    system, frames = late_system(world, 12), iter(world.frames())
    tries = system._recoveries._tries
    tries.refused[0] = 1
    while not any(event.data["reason"] == "leap" for event in system.events.of_kind(EventKind.RECOVERY_FAILED)):
        system.step(next(frames))
    assert not system.atlas.links
    assert tries.judge(0, 0.024, 0.025) is not None


def test_a_link_that_leaps_is_tried_again_as_its_map_grows(world: PointWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    leaps = [LEAP]
    monkeypatch.setattr("dualslam.recovery.manager.judge_motion", lambda _: leaps.pop() if leaps else LinkEvidence(()))
    system = late_system(world, 1, recovery={"enabled": True, "retry_keyframes": [4]})
    for frame in world.frames():
        system.step(frame)
    first, again = system.events.of_kind(EventKind.RECOVERY_STARTED)
    assert (first.data["again"], again.data["again"]) == (False, True)
    assert system.events.of_kind(EventKind.LINKED)


def test_a_recovery_that_fails_costs_its_link_only(world: PointWorld) -> None:
    system = system_in(world, recovery={"enabled": True})
    replace_walks(system, lambda inner: FailingExecutor(inner, 5))
    for frame in world.frames():
        system.step(frame)
    system.finish()
    _, *failed = system.events.of_kind(EventKind.RECOVERY_FAILED)  # the first: of the frames before the first map
    assert failed
    assert all((f.submap, f.data["lost"], f.data["reason"]) == (1, [0], "worker") for f in failed)
    assert system.atlas.components() == [[0], [1]]
    (again,) = system.events.of_kind(EventKind.REINITIALISED)
    assert all(system.rows[i].status is FrameStatus.TRACKED for i in range(again.frame, N))
    assert not system.events.of_kind(EventKind.LINKED)


def test_what_the_live_map_knew_stays_as_it_was(world: PointWorld) -> None:
    """Ids and history of the live map outlast the merge; the walk's keyframes stand before them."""
    system = late_system(world, 20)
    frames = iter(world.frames())
    while not system.events.of_kind(EventKind.REINITIALISED):
        system.step(next(frames))
    for _ in range(19):
        system.step(next(frames))
    submap = system.atlas.submaps[1]
    before = submap.copy()
    result = system.step(next(frames))
    assert system.events.of_kind(EventKind.RECOVERY_ENDED)
    assert result.status is FrameStatus.TRACKED
    n = len(before.landmarks)
    assert len(submap.landmarks) > n
    assert np.array_equal(submap.landmarks["first_kf"][:n], before.landmarks["first_kf"])
    n_rows = len(before.observations)
    for name in ("kf", "feature", "landmark"):
        assert np.array_equal(submap.observations[name][:n_rows], before.observations[name])
    added = submap.keyframes.keys() - before.keyframes.keys()
    assert added
    assert list(submap.keyframes)[len(added) :] == list(before.keyframes)
    assert max(added) < min(before.keyframes)
    assert set(submap.gauge) <= submap.keyframes.keys()
    assert_consistent(submap)


class UnsteadyExecutor(LateExecutor):
    """Gives results out after delays of all kinds, in any order, and loses some."""

    def __init__(self, inner: Walks, seed: int) -> None:
        super().__init__(inner, 0)
        self.rng = np.random.default_rng(seed)

    def submit(self, job: RecoveryJob) -> None:
        self.polls = int(self.rng.integers(0, 50))
        super().submit(job)

    def poll(self) -> list[Outcome]:
        lost = Failure(FailureReason.WORKER, "the recovery process ended with exit code -9")
        return [(job, lost if self.rng.random() < 0.1 else result) for job, result in super().poll()]


@pytest.mark.slow
@pytest.mark.parametrize("seed", first_of([12, 15, 22]))
def test_any_schedule_leaves_a_consistent_atlas(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, covered, at = 110, set(), 25
    while at < n - 15:
        length = int(rng.integers(9, 16))
        covered |= set(range(at, at + length))
        at += length + int(rng.integers(8, 40))
    world = PointWorld(cloud(600), hand_held(n), covered=frozenset(covered), seed=seed)
    system = system_in(world, recovery={"enabled": True}, graph={"max_keyframes": 20, "rollover_keyframes": 6}, **DENSE)
    replace_walks(system, lambda inner: UnsteadyExecutor(inner, seed))
    for frame in world.frames():
        system.step(frame)
    system.finish()
    assert len(system.events.of_kind(EventKind.FAILED)) > 1
    for submap in system.atlas.submaps.values():
        assert_consistent(submap)
        assert submap.keyframes.keys() == submap.T_submap_kf.keys() == submap.landmark_of.keys()
        assert np.isfinite([submap.resolve_anchor(k, np.eye(4)) for k in submap.anchors]).all()
    assert all(system.rows[i].submap == pose.submap_id for i, pose in system.poses.items())
    for component in system.atlas.components():  # what is linked is one map
        found = compose(system.poses.values(), system.atlas, system.atlas.S_world_submap(component))
        translation, rotation = pose_errors(found.T_world_cam, world.T_world_cam[found.index])
        assert translation.max() < POSITION_M
        assert rotation.max() < ROTATION_RAD
