"""A map that is linked by its later part, and lost its scale before, is parted: no pose beyond a loss of scale."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose
from dualslam.core.config.settings import LinkingConfig
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.noise_model import GROUP
from dualslam.core.types import FrameStatus
from dualslam.io.run_folder import FrameRow
from dualslam.map.anchors import Anchor
from dualslam.map.submap import Submap
from dualslam.recovery.scale_watch import part_what_lost_its_scale
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.link_worlds import FRAME_STEP, thinned
from dualslam.testing.point_world import pose_errors
from tests.places.worlds import N, lap, ring, run
from tests.recovery.test_scale_watch import solved

PLACE = 15 * FRAME_STEP
"""Of 30 keyframes."""
LOST_BY = 10.0


@cache
def whole() -> Submap:
    return solved("street", 30)


def linked(submap: Submap, *at: int, loop: tuple[int, int] | None = None) -> Record:
    """Return a submap with a frame at each keyframe, and another that links join to it at some of them."""
    atlas = Atlas()
    atlas.add(submap)
    other = submap.copy()
    other.id = 1
    atlas.add(other)
    for k in at:
        atlas.link(Link(1, 0, np.eye(4), np.eye(7), LinkKind.MERGE, keyframe_a=k, keyframe_b=k))
    if loop is not None:
        atlas.link(Link(0, 0, np.eye(4), np.eye(7), LinkKind.LOOP, keyframe_a=loop[0], keyframe_b=loop[1]))
    record = Record(atlas)
    for k, keyframe in submap.keyframes.items():
        record.rows[k] = FrameRow(k, keyframe.timestamp_s, FrameStatus.TRACKED)
        record.pose(FramePose(k, keyframe.timestamp_s, 0, k, np.eye(4)))
    return record


def parted(record: Record) -> Record:
    part_what_lost_its_scale(record, 0, LinkingConfig(), record.rows[max(record.rows)])
    return record


@pytest.mark.parametrize("n_ties", [0, 1])
@pytest.mark.parametrize("later", [True, False])
def test_what_lies_beyond_a_loss_is_parted_off(n_ties: int, later: bool) -> None:
    """`later`: the link stands on the later part, as that of a merge by sight; else on the earlier one."""
    submap = thinned(whole(), PLACE, n_ties)
    ids = sorted(submap.keyframes)
    record = parted(linked(submap, ids[-1] if later else ids[0]))
    (cut,) = record.events.of_kind(EventKind.CUT)
    assert cut.data["reason"] == "scale_lost"
    part = record.atlas.submaps[cut.data["old_submap"]]
    assert sorted([*submap.keyframes, *part.keyframes]) == ids
    wrong = {k for k in ids if (k < PLACE) == later}
    assert wrong <= part.keyframes.keys()
    assert len(part.keyframes.keys() - wrong) < GROUP, "of what is right, what is asked together with what is not"
    assert record.atlas.components() == [[0, 1], [2]]
    assert {k: pose.submap_id for k, pose in record.poses.items()} == {k: 2 if k in part.keyframes else 0 for k in ids}
    assert cut.data["left"] == sorted(part.keyframes)
    assert record.rows[ids[0]].submap == (2 if later else 0)


def test_losses_on_either_side_of_a_link_are_both_parted_off() -> None:
    ids = sorted(whole().keyframes)
    submap = thinned(thinned(whole(), ids[8], 0), ids[22], 0)
    record = parted(linked(submap, ids[15]))
    assert len(record.events.of_kind(EventKind.CUT)) == 2
    assert ids[15] in submap.keyframes
    assert submap.keyframes.keys() <= set(ids[8:22])


def test_what_is_condemned_is_not_asked() -> None:
    """The end of a map that a walk has by-passed has no frames any more, and stays where it is."""
    submap = thinned(whole(), PLACE, 0)
    submap.condemn({k for k in submap.keyframes if k >= PLACE})
    assert not parted(linked(submap, min(submap.keyframes))).events.of_kind(EventKind.CUT)


def test_a_map_that_hands_its_scale_on_stays_whole() -> None:
    assert not parted(linked(whole().copy(), max(whole().keyframes))).events.of_kind(EventKind.CUT)


def test_where_no_link_stands_nothing_tells_which_part_is_right() -> None:
    assert not parted(linked(thinned(whole(), PLACE, 0))).events.of_kind(EventKind.CUT)


def test_what_links_hold_on_either_side_is_known() -> None:
    submap = thinned(whole(), PLACE, 0)
    record = linked(submap, min(submap.keyframes), max(submap.keyframes))
    assert not parted(record).events.of_kind(EventKind.CUT)


def test_links_to_maps_that_nothing_else_joins_hold_nothing_in_between() -> None:
    """The part takes its link along; where the other maps are joined, too, both scales are known."""
    submap = thinned(whole(), PLACE, 0)
    first, last = min(submap.keyframes), max(submap.keyframes)
    for joined in (False, True):
        record = linked(submap.copy(), first)
        third = submap.copy()
        third.id = 2
        record.atlas.add(third)
        record.atlas.link(Link(0, 2, np.eye(4), np.eye(7), LinkKind.MERGE, keyframe_a=last, keyframe_b=last))
        if joined:
            record.atlas.link(Link(1, 2, np.eye(4), np.eye(7), LinkKind.MERGE, keyframe_a=last, keyframe_b=last))
        cuts = parted(record).events.of_kind(EventKind.CUT)
        assert len(cuts) == (0 if joined else 1)
        if not joined:
            assert sorted(record.atlas.components(), key=len) == [[0, 1], [2, 3]]


def test_what_a_loop_holds_is_known() -> None:
    submap = thinned(whole(), PLACE, 0)
    first, last = min(submap.keyframes), max(submap.keyframes)
    assert not parted(linked(submap, last, loop=(first, last))).events.of_kind(EventKind.CUT)
    submap = thinned(whole(), PLACE, 0)
    assert parted(linked(submap, last, loop=(PLACE, last))).events.of_kind(EventKind.CUT)


# --- the system


def lose_scale(system: System, submap: Submap, place: int) -> None:
    """Make all before a keyframe ten times too large, and hang by nothing on what comes after."""
    lost = thinned(submap, place, 0)
    obs, before = lost.observations, [k for k in lost.keyframes if k < place]
    centre = lost.T_submap_kf[place][:3, 3]
    own = np.unique(obs["landmark"][obs["alive"] & (obs["kf"] < place)])
    lost.landmarks["xyz_mu"][own] = centre + LOST_BY * (lost.landmarks["xyz_mu"][own] - centre)
    for k in before:
        lost.T_submap_kf[k] = larger(lost.T_submap_kf[k], centre)
    for i, pose in system.poses.items():
        if pose.submap_id == submap.id and submap.keyframe_for(pose.keyframe_id) in before:
            system.poses[i] = pose.at(Anchor(pose.keyframe_id, se3.scaled(pose.T_kf_cam, LOST_BY)))
    submap.take_over(lost)


def larger(T: np.ndarray, centre: np.ndarray) -> np.ndarray:
    return se3.from_parts(T[:3, :3], centre + LOST_BY * (T[:3, 3] - centre))


@cache
def merged_after_a_loss(asks: bool) -> System:
    """Lost for long; the second map, ten times too large at first, is joined to the first by sight at its end."""
    world = lap(N + 12, covered=frozenset(range(60, 80)))
    system = run(world, recovery={"enabled": True}, buffer={"duration_s": 0.3})
    (merged,) = system.events.of_kind(EventKind.MERGED)
    submap = system.atlas.submaps[merged.submap or 0]
    settle, place = system._connections.settle, sorted(submap.keyframes)[10]

    def lose_and_settle(now: FrameRow) -> None:
        settle(now)
        lose_scale(system, submap, place)

    if not asks:
        system._endings.part_what_lost_its_scale = lambda last: None  # type: ignore[method-assign]
    system._connections.settle = lose_and_settle  # type: ignore[method-assign, assignment]
    system.finish()
    return system


def largest_error(system: System) -> float:
    main = trajectories_of(system).main
    return float(pose_errors(main.T_world_cam, ring(N + 12)[main.index])[0].max())


@pytest.mark.slow
def test_a_merge_by_sight_does_not_take_in_what_lies_beyond_a_loss() -> None:
    size = float(np.linalg.norm(np.ptp(ring(N)[:, :3, 3], axis=0)))
    as_one, system = merged_after_a_loss(False), merged_after_a_loss(True)
    assert largest_error(as_one) > 0.5 * size, "taken in as one map it is wrong"
    assert largest_error(system) < 0.05 * size
    (cut,) = system.events.of_kind(EventKind.CUT)
    found = trajectories_of(system)
    assert found.unlinked[cut.data["old_submap"]].index.tolist() == cut.data["left"]
    everything = trajectories_of(as_one).main.index.tolist()
    assert sorted([*found.main.index.tolist(), *cut.data["left"]]) == everything
    assert len(cut.data["left"]) < 0.3 * len(everything)
