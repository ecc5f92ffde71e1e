"""Attempts at a recovery: their order, what they say, and a gap relocalisation over a black-out on rendered images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.atlas.connections import Connections
from dualslam.atlas.record import FrameStamp
from dualslam.atlas.report import AtlasReport
from dualslam.build import build_system, recovery_parts
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.config.corruption import Corruption
from dualslam.core.config.corruption import CorruptionKind as SpoilKind
from dualslam.core.config.settings import AttemptConfig, Config, FrontendConfig, LinkingConfig, RecoveryConfig
from dualslam.core.errors import ConfigError, SolverError, how_to_install
from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import se3, sim3
from dualslam.core.grey_image import GreyImage
from dualslam.core.jobs import JobKind, Limit
from dualslam.core.types import Failure, FailureReason, Features, Frame, View
from dualslam.frontends import registry
from dualslam.frontends.features.sift import SiftFrontend
from dualslam.frontends.gap.pnp_odometry import PnpOdometry
from dualslam.lab.audits.link_audit import LinkAudit, audit_links
from dualslam.lab.synthetic import SyntheticSequence, make_sequence
from dualslam.linking.join_test import JoinGate
from dualslam.recovery.job import RecoveryResult
from dualslam.recovery.reverse_tracking import run_recovery
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, random_features, system_in
from dualslam.testing.walks import KeptWalks, replace_walks
from tests.workers.test_worker import assert_same

COVERED = frozenset(range(22, 37))
N, N_POINTS = 47, 600
NO_LINK = {"min_inliers": 100_000}
CAMERA = PinholeCamera(640, 480, 450.0, 450.0, 319.5, 239.5)


def config(**recovery: object) -> RecoveryConfig:
    return Config.model_validate({"recovery": recovery}).recovery


class TestConfig:
    def test_a_list_of_words_is_a_list_of_front_ends(self) -> None:
        attempts = config(attempts=["live", "sift", {"frontend": "orb", "n_features": 4000}]).attempts
        assert [attempt.frontend for attempt in attempts] == ["live", "sift", "orb"]
        assert attempts[0].is_live
        assert attempts[2] == AttemptConfig(frontend="orb", n_features=4000)
        (learned,) = config(attempts=["learned"]).attempts
        assert (learned.frontend, learned.tracking, learned.if_installed) == ("kornia", "own", True)
        (gap,) = config(attempts=["gap"]).attempts
        assert (gap.frontend, gap.tracking, gap.name) == ("sift", "live", "gap (sift)")

    @pytest.mark.parametrize(
        ("attempts", "told"),
        [
            ([], "at least 1"),
            ([{"frontend": "live", "n_features": 500}], "no settings of its own"),
            ([{"frontent": "sift"}], "frontent"),
            ([3], "attempts.0"),
        ],
    )
    def test_mistakes_are_told(self, attempts: list[object], told: str) -> None:
        with pytest.raises(ValueError, match=told):
            config(attempts=attempts)

    def test_an_unknown_front_end_is_told_with_its_place(self) -> None:
        with pytest.raises(ConfigError, match=r"recovery.attempts\[1\].*'surf'.*known: .*sift"):
            build_system(Config.model_validate({"recovery": {"attempts": ["live", "surf"]}}), CAMERA)
        options = [{"frontend": "sift", "options": {"ratios": 0.7}}]
        with pytest.raises(ConfigError, match=r"recovery.attempts\[0\].*ratios"):
            build_system(Config.model_validate({"recovery": {"attempts": options}}), CAMERA)


def system_of(
    attempts: list[str],
    n: int = N,
    linking: dict[str, object] | None = None,
    buffer_s: float = 10.0,
    **recovery: object,
) -> tuple[System, PointWorld]:
    """Build a system in a world of points, where there are no images, that is covered for a while."""
    world = PointWorld(cloud(N_POINTS), hand_held(n), covered=COVERED)
    recovery = {"attempts": attempts, "retry_keyframes": []} | recovery
    return system_in(world, recovery=recovery, linking=linking or {}, buffer={"duration_s": buffer_s}), world


def run(attempts: list[str], **settings: Any) -> System:
    system, world = system_of(attempts, **settings)
    for frame in world.frames():
        system.step(frame)
    return system


def events_of(attempts: list[str], **settings: Any) -> list[Event]:
    system = run(attempts, **settings)
    return system.events.of_kind(EventKind.RECOVERY_ATTEMPT, EventKind.LINKED, EventKind.RECOVERY_ENDED)


def refused_scale(sigma: float, detail: str, reason: FailureReason, config: LinkingConfig) -> JoinGate:
    return JoinGate.at_most("sigma_scale", sigma, 0.0, reason, detail)


class TestOrder:
    def test_the_first_that_links_is_the_last_that_is_made(self) -> None:
        attempt, linked, ended = events_of(["live", "sift"])
        assert attempt.data["attempt"] == linked.data["attempt"] == "live"
        assert attempt.data["verdict"] == "linked"
        assert attempt.data["frames"] >= attempt.data["new_keyframes"] >= 4
        assert attempt.data["inliers"] <= attempt.data["matches"]
        assert attempt.data["skipped_frames"] >= len(COVERED)
        assert {gate.name for gate in linked.gates} >= {"n_agreeing_keyframes", "sigma_scale", "sigma_rot_deg"}
        assert all(gate.passed for gate in linked.gates)
        assert ended.data["linked"]

    def test_one_that_fails_is_followed_by_the_next_from_the_same_start(self) -> None:
        first, second, linked, _ = events_of(["sift", "live"])
        assert [first.data["attempt"], second.data["attempt"]] == ["sift", "live"]
        assert first.data["verdict"] == "its image is no longer buffered"
        assert linked.data["attempt"] == "live"
        alone = events_of(["live"])[-2].data
        assert alone | {"seconds": 0} == linked.data | {"seconds": 0}

    @pytest.mark.parametrize(
        ("links", "made"), [(True, ["gap (sift)"]), (False, ["gap (sift)", "live"])], ids=["linked", "not linked"]
    )
    def test_a_crossed_gap_without_a_link_is_followed_by_the_next_attempt(self, links: bool, made: list[str]) -> None:
        system = run(["gap", "live"], linking=None if links else NO_LINK)
        attempts = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)
        assert attempts[0].data["gaps"] == 1
        assert [attempt.data["attempt"] for attempt in attempts] == made

    def test_an_attempt_that_is_not_installed_is_left_out_and_reported_once(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(registry, "find_spec", lambda package: None)
        monkeypatch.delitem(registry.BUILT_IN, "kornia")  # to import it fails the test
        system = run(["learned", "live", "learned"], linking=NO_LINK)
        (made,) = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)
        assert made.data["attempt"] == "live"
        (unavailable,) = system.events.of_kind(EventKind.ATTEMPT_UNAVAILABLE)
        assert unavailable.data == {"attempt": "kornia", "verdict": how_to_install("kornia")}

    def test_an_installed_attempt_is_built_when_it_is_made(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Its front end is a fake: the walk asks it for features of the images, of which a world of points has none."""
        built: list[str] = []

        def create(wanted: FrontendConfig, needs: Iterable[str] = ()) -> SiftFrontend:
            built.append(wanted.name)
            return SiftFrontend(wanted.n_features)

        monkeypatch.setattr(registry, "find_spec", lambda package: object())
        monkeypatch.setattr("dualslam.build.walks.create_frontend", create)
        system, world = system_of(["live", "learned"], linking=NO_LINK)
        assert built == []
        for frame in world.frames():
            system.step(frame)
        assert built == ["kornia"]
        made = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)
        assert [attempt.data["attempt"] for attempt in made] == ["live", "kornia"]
        assert not system.events.of_kind(EventKind.ATTEMPT_UNAVAILABLE)

    def test_a_broken_installation_is_reported_and_the_run_goes_on(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def create(wanted: FrontendConfig, needs: Iterable[str] = ()) -> SiftFrontend:
            raise ConfigError("'kornia' cannot be imported: libcudart.so.12 is missing", ("frontend", "name"))

        monkeypatch.setattr(registry, "find_spec", lambda package: object())
        monkeypatch.setattr("dualslam.build.walks.create_frontend", create)
        system = run(["learned", "live"])
        (unavailable,) = system.events.of_kind(EventKind.ATTEMPT_UNAVAILABLE)
        assert "libcudart.so.12 is missing" in unavailable.data["verdict"]
        (linked,) = system.events.of_kind(EventKind.LINKED)
        assert linked.data["attempt"] == "live"

    @pytest.mark.parametrize(("buffer_s", "made"), [(10.0, ["live"]), (1.0, ["live", "gap (sift)"])])
    def test_where_all_of_the_lost_map_leaves_the_scale_open_no_other_way_is_tried(
        self, monkeypatch: pytest.MonkeyPatch, buffer_s: float, made: list[str]
    ) -> None:
        monkeypatch.setattr(LinkingConfig, "max_scale_sigma", 1e-6)
        monkeypatch.setattr(LinkingConfig, "max_joined_scale_sigma", 1e-6)
        system = run(["live", "gap"], buffer_s=buffer_s)
        refused = system.events.of_kind(EventKind.LINK_REFUSED)
        assert {event.data["reason"] for event in refused} == {"scale"}
        attempts = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)
        assert [attempt.data["attempt"] for attempt in attempts] == made

    def test_nothing_is_kept_from_beyond_a_gap_across_which_the_scale_was_lost(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """By a bound that no walk can hold: what lies before the gap stays, and the next walk crosses it anew."""
        monkeypatch.setattr(LinkingConfig, "max_live_scale_sigma", 1e-6)
        monkeypatch.setattr("dualslam.linking.live_end.live_scale_gate", refused_scale)
        system = run(["live"], retry_keyframes=[2])
        first, *later = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)
        assert first.data["gaps"] == 1
        assert "by the walk" in first.data["verdict"]
        assert min(system.live.submap.keyframes) > max(COVERED)
        assert any(attempt.data["gaps"] == 1 and attempt.data["new_keyframes"] >= 4 for attempt in later)

    @pytest.mark.parametrize("limit", ["max_scale_sigma", pytest.param("max_live_scale_sigma", marks=pytest.mark.slow)])
    def test_where_no_attempt_finds_a_sure_link_an_unsure_one_joins(
        self, monkeypatch: pytest.MonkeyPatch, limit: str
    ) -> None:
        """At the overlap or at the live end its scale is known to 5 %, and no link to what is asked for."""
        monkeypatch.setattr(LinkingConfig, limit, 1e-6)
        system = run(["live"])
        (attempt,) = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)
        assert "no link: scale known to" in attempt.data["verdict"]
        (linked,) = system.events.of_kind(EventKind.LINKED)
        (link,) = system.atlas.believed
        assert linked.data["sigma_scale"] == pytest.approx(link.sigma_scale, rel=0.01)
        assert link.sigma_scale < LinkingConfig().wrong_scale
        assert not link.is_sure

    def test_all_may_fail(self) -> None:
        events = events_of(["live", "sift"], max_gap_frames=3)
        assert [event.event for event in events[:2]] == [EventKind.RECOVERY_ATTEMPT] * 2
        assert not events[-1].data["linked"]
        assert events[0].data["unusable_at_end"] == 4


def test_a_solver_that_fails_ends_an_attempt_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise SolverError("no solution")

    monkeypatch.setattr(PnpOdometry, "insert_keyframe", fail)
    attempt = events_of(["live"])[0]
    assert attempt.data["verdict"] == "no solution"


def test_frames_before_a_start_are_posed_by_live_features_whatever_the_attempts() -> None:
    world = PointWorld(cloud(), hand_held(30))  # without images, so that no other front end sees anything
    system = system_in(world, recovery={"attempts": ["sift"]})
    for frame in world.frames():
        system.step(frame)
    system.finish()
    (start,) = system.events.of_kind(EventKind.INITIALISED)
    assert start.data["first_view"] + 1 < start.frame  # there are some
    assert sorted(system.poses) == list(range(30))


class OutOfTimeAtFirst:
    """Gives the first jobs that have a lost map to look for no time at all."""

    def __init__(self, system: System, n_failing: int) -> None:
        self._submit, self._n_failing = system.desk.executor.submit, n_failing
        system.desk.executor.submit = self.submit  # type: ignore[method-assign]

    def submit(self, kind: JobKind, work: Any, of: int | None = None, limit: Limit | None = None) -> None:
        if kind is JobKind.WALK and work.lost:
            limit = Limit(after_steps=0) if self._n_failing > 0 else None
            self._n_failing -= 1
        self._submit(kind, work, of, limit)


class TestRetry:
    @staticmethod
    def run(n_failing: int, n_frames: int = N + 30) -> System:
        system, world = system_of(["live"], n_frames, retry_keyframes=[4])
        OutOfTimeAtFirst(system, n_failing)
        for frame in world.frames():
            system.step(frame)
        system.finish()
        return system

    def test_a_recovery_without_link_is_made_again_when_the_map_has_grown(self) -> None:
        system = self.run(n_failing=1)
        started = system.events.of_kind(EventKind.RECOVERY_STARTED)
        assert [event.data["again"] for event in started] == [False, True]
        ended = system.events.of_kind(EventKind.RECOVERY_ENDED)
        assert [event.data["linked"] for event in ended] == [False, True]
        (link,) = system.atlas.links
        assert link.keyframes
        main = trajectories_of(system).main
        assert set(main.index.tolist()) == set(range(N + 30)) - COVERED

    @pytest.mark.parametrize(
        "failure", [None, pytest.param(Failure(FailureReason.SOLVER, "singular"), marks=pytest.mark.slow)]
    )
    def test_so_it_is_where_the_atlas_refuses_the_link(
        self, monkeypatch: pytest.MonkeyPatch, failure: Failure | None
    ) -> None:
        asked, connect = [], Connections.connect

        def refuse_first(self: Connections, links: Sequence[Link], now: FrameStamp) -> AtlasReport:
            asked.append(links)
            if len(asked) > 1:
                return connect(self, links, now)
            return AtlasReport(failure=failure, newly_rejected=() if failure else (replace(links[0], rejected=True),))

        monkeypatch.setattr(Connections, "connect", refuse_first)
        system = self.run(n_failing=0, n_frames=N + 10)
        first, second = system.events.of_kind(EventKind.RECOVERY_ENDED)
        assert [event.data["linked"] for event in (first, second)] == [False, True]
        refused = system.events.of_kind(EventKind.LINK_REFUSED)[-1]
        assert (refused.frame, refused.data["reason"]) == (first.frame, "solver" if failure else "contradiction")
        assert [event.frame for event in system.events.of_kind(EventKind.LINKED)] == [second.frame]

    @pytest.mark.slow
    def test_that_an_older_link_falls_refuses_no_new_one(self, monkeypatch: pytest.MonkeyPatch) -> None:
        connect = Connections.connect

        def with_another_rejected(self: Connections, links: Sequence[Link], now: FrameStamp) -> AtlasReport:
            older = replace(links[0], kind=LinkKind.LOOP, rejected=True)
            return replace(connect(self, links, now), newly_rejected=(older,))

        monkeypatch.setattr(Connections, "connect", with_another_rejected)
        system = self.run(n_failing=0, n_frames=N)
        assert system.events.of_kind(EventKind.LINKED)
        assert system.events.of_kind(EventKind.FUSED)
        assert not system._recoveries.waiting

    def test_it_ends_with_the_last_of_the_sizes_and_once_more_with_the_run(self) -> None:
        system = self.run(n_failing=9, n_frames=N + 50)  # so many that the new map grows beyond the size
        started = system.events.of_kind(EventKind.RECOVERY_STARTED)
        assert [event.frame for event in started[2:]] == [N + 49]
        assert not system.atlas.links

    @pytest.mark.slow
    def test_what_is_linked_is_not_looked_for_again(self) -> None:
        system = self.run(n_failing=0)
        assert len(system.events.of_kind(EventKind.RECOVERY_STARTED)) == 1

    def test_nothing_is_looked_for_that_the_buffer_does_not_hold(self) -> None:
        system, world = system_of(["live"], n=60, retry_keyframes=[4], buffer_s=0.2)
        OutOfTimeAtFirst(system, 9)
        for frame in world.frames():
            system.step(frame)
        assert len(system.events.of_kind(EventKind.RECOVERY_STARTED)) == 1


@cache
def road() -> tuple[SyntheticSequence, list[Frame]]:
    """A street with a black-out of a second, at ten frames a second and half a metre a frame; its rendered frames."""
    sequence = make_sequence("street", 52, seed=2, events=[Corruption(kind=SpoilKind.BLACKOUT, start=26, length=10)])
    return sequence, [sequence.frame(i) for i in range(6, 52)]


def on_the_road(attempt: str) -> Config:
    settings = {"recovery": {"attempts": [attempt]}, "calibration": {"refine": False}, "buffer": {"duration_s": 5.0}}
    return Config.model_validate(settings)


@pytest.mark.slow
@pytest.mark.parametrize("attempt", ["sift", "gap"])
def test_a_black_out_on_the_road_is_leapt(attempt: str) -> None:
    sequence, frames = road()
    truth = sequence.ground_truth_T_world_cam
    system = build_system(on_the_road(attempt), sequence.camera)
    for frame in frames:
        system.step(frame)
    system.finish()
    # Just begun, the new map may hold its scale too loosely across the gap: then it is tried again two frames later.
    made = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)[-1]
    assert made.data["gaps"] == 1
    (link,) = system.atlas.links
    scales = []
    for m in (link.a, link.b):
        submap = system.atlas.submaps[m]
        ids = [k for k in submap.keyframes if (k > 35) == (m == link.b)]
        est, true = submap.keyframe_poses(ids)[:, :3, 3], truth[ids][:, :3, 3]
        scales.append(np.linalg.norm(true - true.mean(0)) / np.linalg.norm(est - est.mean(0)))
    # What the gap relocalisation knew is still known once the walk's result is in the map, whatever frame the map has
    # by then.
    new = system.atlas.submaps[link.b]
    (k, known), *_ = new.relative_poses.items()
    assert k < 35 < known.keyframe_id
    off = se3.log(se3.inverse(known.T_ref_kf) @ se3.inverse(new.T_submap_kf[known.keyframe_id]) @ new.T_submap_kf[k])
    assert off @ np.linalg.solve(known.covariance, off) < 22.5  # 99.9 % for six degrees of freedom
    # The whole new map, not only its end on this side of the gap, has its place and size.
    assert abs(float(sim3.scale(link.S_a_b)) / (scales[1] / scales[0]) - 1) < 0.05
    main = trajectories_of(system).main
    translation, rotation = pose_errors(main.T_world_cam, truth[main.index])
    length = np.linalg.norm(np.diff(truth[6:, :3, 3], axis=0), axis=1).sum()
    assert translation.max() < 0.03 * length
    assert rotation.max() < np.radians(1.0)  # a third of what makes a link wrong


@pytest.mark.slow
def test_the_result_is_the_same_whatever_the_threads() -> None:
    sequence, frames = road()
    config = on_the_road("gap")
    system = build_system(config, sequence.camera)
    jobs = replace_walks(system, lambda _: KeptWalks()).jobs
    for frame in frames:
        system.step(frame)
        if job := next((job for job in jobs if job.lost), None):
            break
    assert job is not None
    alone, beside = (run_recovery(job, recovery_parts(config, sequence.camera, n_threads=n)) for n in (0, 2))
    assert isinstance(beside, RecoveryResult)
    assert beside.events[-1].data["gaps"] == 1
    assert_same(alone, beside)


@pytest.mark.slow
def test_missing_frames_lead_to_no_wrong_link() -> None:
    """Ten metres of road without a frame: guided matching goes over them to a place 5.6 m off, and does not notice."""
    world = make_sequence("street", 90, 8, 320, 240, events=[Corruption(kind=SpoilKind.DROP, start=53, length=10)])
    config = Config.model_validate({"seed": 8, "frontend": {"n_features": 600}})
    system = build_system(config, world.camera)
    for i in world.indices[25:]:
        system.step(world.frame(i))
    system.finish()
    assert system.events.of_kind(EventKind.FAILED)
    truth = dict(enumerate(world.ground_truth_T_world_cam))
    links = audit_links(system.atlas, system.poses.values(), truth)
    assert all(isinstance(link, LinkAudit) and not link.wrong for link in links)
    crossed = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)[-1]
    assert (crossed.data["verdict"] == "linked") == bool(links)
    assert crossed.data["gaps"] == bool(links)  # over the gap no walk goes but by a gap relocalisation


def test_what_was_foreseen_in_an_image_is_not_looked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[int] = []
    extract = SiftFrontend.extract

    def count(self: SiftFrontend, image: NDArray[np.uint8]) -> Features:
        looked_at.append(int(image[0, 0]))
        return extract(self, image)

    monkeypatch.setattr(SiftFrontend, "extract", count)
    features = random_features(np.random.default_rng(0))
    grey = np.random.default_rng(1).integers(0, 256, (120, 160), np.uint8)
    shows, blank = (View(i, float(i), features, GreyImage.of(image)) for i, image in enumerate((grey, 0 * grey)))
    parts = recovery_parts(Config(), CAMERA)
    for view in (shows, blank, replace(shows, index=2)):
        parts.foresee(view)
    assert looked_at == [int(grey[0, 0])]
