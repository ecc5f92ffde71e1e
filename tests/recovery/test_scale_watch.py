"""A map that does not hand its scale on is parted there, and only there; reverse tracking may join the two again."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.config.settings import GraphConfig, LinkingConfig
from dualslam.core.events import EventKind
from dualslam.core.jobs import Ended, InlineDesk, JobKind
from dualslam.core.noise_model import GROUP
from dualslam.core.types import Keyframe
from dualslam.linking.scale_observability import N_AROUND
from dualslam.map.split import submap_of
from dualslam.map.submap import Submap
from dualslam.map.submap_change import solve
from dualslam.recovery.scale_watch import BEHIND, SCALE_HANDLERS, ScaleLoss, ScaleWatch, count_ties
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.link_worlds import FRAME_STEP, Recipe, build, make_world, thinned
from dualslam.testing.point_world import (
    CAMERA,
    PointWorld,
    cloud,
    hand_held,
    make_features,
    path,
    pose_errors,
    system_in,
)

N = 24
PLACE = 11 * FRAME_STEP
"""In the group that is asked about: it begins with the 15 newest keyframes of the 24."""


def solved(layout: str, n: int = N) -> Submap:
    submap = build(
        make_world(layout, 0, n_frames=n), Recipe(list(range(n)), 0, outliers=0.0), 0, np.random.default_rng(0)
    )
    solve(submap, ISam2SubmapGraph(GraphConfig()))
    return submap


def watch_since(submap: Submap) -> ScaleWatch:
    """Return one that has seen the map grow up to the group."""
    watch, ids = ScaleWatch(LinkingConfig()), sorted(submap.keyframes)
    assert watch.judge(submap_of(submap, submap.id, ids[: -BEHIND - GROUP]), []) is None
    return watch


@pytest.mark.parametrize("layout", ["street", "room"])
def test_a_healthy_map_is_left_alone(layout: str) -> None:
    submap = solved(layout)
    assert watch_since(submap).judge(submap, []) is None


@pytest.mark.parametrize("n_ties", [0, 1])
def test_a_map_that_hangs_by_next_to_nothing_is_parted_there(n_ties: int) -> None:
    submap = thinned(solved("street"), PLACE, n_ties)
    watch = watch_since(submap)
    loss = watch.judge(submap, [])
    assert isinstance(loss, ScaleLoss)
    ids = sorted(submap.keyframes)
    group = ids[-BEHIND - GROUP : -BEHIND]
    assert PLACE in group
    assert loss.since == group[0]
    assert loss.first == PLACE
    assert loss.sigma > watch.max_sigma > LinkingConfig().wrong_scale
    assert "not known" in loss.detail
    assert "known to 45%" in ScaleLoss(1, 2, 0.45).detail
    assert watch.judge(submap, []) is None  # a group is asked about once


def test_ties_that_hold_the_scale_are_enough() -> None:
    submap = thinned(solved("street"), PLACE, 12)
    assert watch_since(submap).judge(submap, []) is None


def test_far_landmarks_are_no_ties() -> None:
    """They may be off by half their depth, however many of them both sides have seen."""
    rng = np.random.default_rng(0)
    near = rng.uniform([-0.3, -0.3, 3.0], [0.3, 0.3, 4.0], (12, 3))
    xyz = np.concatenate([near, 100.0 * near])
    n, ids = len(xyz), np.arange(8)
    features = make_features(np.zeros((n, 2)), np.ones(n), np.zeros(n, np.int64), np.zeros((n, 32), np.uint8))
    submap = Submap(0, CAMERA.K, features.descriptors[0])
    for k, T_submap_kf in enumerate(path(len(ids), np.array([0.1, 0.0, 0.0]), np.zeros(3))):
        submap.add_keyframe(Keyframe(k, float(k), features), T_submap_kf)
    landmarks = submap.add_landmarks(xyz, features.descriptors, np.ones(n), 0)
    for k in ids.tolist():
        submap.add_observations(k, np.arange(n), landmarks)
    assert count_ties(submap, ids, 4, 4, n_views=2) == len(near)


def test_what_a_map_began_with_is_not_asked_about() -> None:
    assert ScaleWatch(LinkingConfig()).judge(thinned(solved("street"), PLACE, 0), []) is None


def test_what_a_link_holds_is_not_lost() -> None:
    submap = thinned(solved("street"), PLACE, 0)
    newest = max(submap.keyframes)
    loop = Link(0, 0, np.eye(4), np.eye(7), LinkKind.LOOP, keyframe_a=newest, keyframe_b=0)
    assert watch_since(submap).judge(submap, [loop]) is None
    elsewhere = Link(3, 4, np.eye(4), np.eye(7), LinkKind.LOOP, keyframe_a=newest, keyframe_b=newest)
    assert watch_since(submap).judge(submap, [elsewhere]) is not None


def test_what_older_keyframes_hold_is_not_lost() -> None:
    """The camera is back where it was long before: neighbours in time share nothing, and yet hang together."""
    n = 2 * N_AROUND + N
    submap = solved("room", n)
    place = n - BEHIND - GROUP + 2
    obs = submap.observations
    after, at = obs["kf"] >= place * FRAME_STEP, obs["kf"]
    seen_after = np.isin(obs["landmark"], obs["landmark"][after])
    recent = (at < place * FRAME_STEP) & (at >= (place - N_AROUND - 2 * GROUP) * FRAME_STEP)
    apart = submap.copy()
    apart.remove_observations(np.flatnonzero(seen_after & recent))
    assert watch_since(apart).judge(apart, []) is None
    apart.remove_observations(np.flatnonzero(seen_after & ~after & apart.observations["alive"]))
    assert watch_since(apart).judge(apart, []) is not None


# --- the system


def parted(monkeypatch: pytest.MonkeyPatch, recovery: bool) -> tuple[System, PointWorld, ScaleLoss]:
    """Run a healthy world, of which one place is said to have lost its scale."""
    said: list[ScaleLoss] = []

    def judge(watch: ScaleWatch, submap: Submap, links: list[Link]) -> ScaleLoss | None:
        ids = sorted(submap.keyframes)
        if said or ids[-1] < 60:
            return None
        said.append(ScaleLoss(ids[-12], ids[-10], 0.2))
        return said[0]

    monkeypatch.setattr(ScaleWatch, "judge", judge)
    world = PointWorld(cloud(), hand_held(90))
    system = system_in(
        world,
        recovery={"enabled": recovery, "attempts": ["live"]},
        loops={"enabled": False},
        keyframes={"max_parallax_deg": 1.0},
        mapping={"redundant_ratio": 1.0},
    )
    for frame in world.frames():
        system.step(frame)
    system.finish()
    (loss,) = said
    return system, world, loss


@pytest.mark.slow
def test_both_parts_are_joined_by_reverse_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    system, world, loss = parted(monkeypatch, recovery=True)
    (failed,) = system.events.of_kind(EventKind.FAILED)
    assert failed.data["reason"] == "scale_lost"
    assert (failed.data["lost_since"], failed.data["suspected_since"]) == (loss.first, loss.since)
    (link,) = system.atlas.links
    assert link.kind is LinkKind.RECOVERY
    main = trajectories_of(system).main
    assert main.index.tolist() == list(range(90))
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam)
    assert translation.max() < 0.08
    assert rotation.max() < 0.01


def test_without_recovery_both_are_kept_and_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    system, world, loss = parted(monkeypatch, recovery=False)
    old, new = (system.atlas.submaps[m] for m in (0, 1))
    assert max(old.keyframes) < loss.first == min(new.keyframes)
    assert not system.atlas.links
    found = trajectories_of(system)
    (other,) = found.unlinked.values()
    assert sorted([*found.main.index.tolist(), *other.index.tolist()]) == list(range(90))
    for part in (found.main, other):
        translation, rotation = pose_errors(part.T_world_cam, world.T_world_cam[part.index])
        assert translation.max() < 0.08
        assert rotation.max() < 0.01


class _LateDesk(InlineDesk):
    """Gives answers out when it is told to."""

    held = True

    def poll(self, kind: JobKind) -> list[Ended]:
        return [] if self.held else super().poll(kind)

    def n_open(self, kind: JobKind, of: int | None = None) -> int:
        return len(self._done[kind]) if self.held else 0


def late_watch(submap: Submap) -> tuple[ScaleWatch, _LateDesk]:
    desk, ids = _LateDesk(SCALE_HANDLERS), sorted(submap.keyframes)
    watch = ScaleWatch(LinkingConfig(), desk)
    assert watch.judge(submap_of(submap, submap.id, ids[: -BEHIND - GROUP]), []) is None
    assert watch.judge(submap, []) is None  # asked, and not answered yet
    desk.held = False
    return watch, desk


def test_a_verdict_that_comes_late_is_the_same() -> None:
    submap = thinned(solved("street"), PLACE, 0)
    at_once = watch_since(submap).judge(submap, [])
    assert isinstance(at_once, ScaleLoss)
    watch, _ = late_watch(submap)
    assert watch.judge(submap, []) == at_once
    assert watch.judge(submap, []) is None


def test_a_late_verdict_on_what_was_tied_meanwhile_or_on_another_map_is_none() -> None:
    whole = solved("street")
    submap = thinned(whole, PLACE, 0)
    watch, _ = late_watch(submap)
    assert watch.judge(whole, []) is None
    watch, _ = late_watch(submap)
    other = submap.copy()
    other.id += 1
    assert watch.judge(other, []) is None
    assert watch.judge(submap, []) is None


def test_a_late_verdict_on_keyframes_that_were_taken_out_meanwhile_is_none() -> None:
    submap = thinned(solved("street"), PLACE, 0)
    watch, desk = late_watch(submap)
    (asked,) = (ended.work for ended in desk._done[JobKind.SCALE])
    earlier = submap_of(submap, submap.id, [k for k in sorted(submap.keyframes) if k < asked.group[0]])
    assert watch.judge(earlier, []) is None
