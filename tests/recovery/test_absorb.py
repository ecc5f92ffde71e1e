"""Which lost maps are absorbed by a new one that has posed their frames, on books that are made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose
from dualslam.core.events import EventKind
from dualslam.core.types import FrameStatus
from dualslam.map.frame_records import FrameRow
from dualslam.recovery.bypass import Absorption, absorb
from dualslam.recovery.job import RecoveredFrame
from dualslam.testing.graph_scene import guessed_submap, make_scene

N_LOST = 8


def pose(index: int, submap_id: int, off_m: float = 0.0) -> FramePose:
    T_kf_cam = np.eye(4)
    T_kf_cam[:3, 3] = [0.1 * index + off_m, 0.002 * np.sin(index), 0.0]
    return FramePose(index, 0.1 * index, submap_id, 0, T_kf_cam)


def book(n_new: int) -> Record:
    """A lost map 0 of the frames up to `N_LOST`, and map 1 of the `n_new` since."""
    record = Record()
    for m, frames in enumerate((range(N_LOST), range(N_LOST, N_LOST + n_new))):
        submap = guessed_submap(make_scene(6), pose_noise=0.0)
        submap.id = m
        record.atlas.add(submap)
        for i in frames:
            record.rows[i] = FrameRow(i, 0.1 * i, FrameStatus.TRACKED)
            record.pose(pose(i, m))
    return record


def walked(record: Record, n: int = N_LOST, at_end: bool = False) -> Absorption:
    """Absorb what the new map has posed: the `n` newest frames of the lost one."""
    frames = [RecoveredFrame(pose(i, 1), 90, 80) for i in range(N_LOST - n, N_LOST)]
    return absorb(record, frames, 1, {0}, record.rows[N_LOST], at_end)


def test_a_smaller_map_goes_and_its_frames_change_to_the_new_one() -> None:
    record = book(N_LOST + 1)
    assert walked(record) == Absorption([0], None)
    assert {p.submap_id for p in record.poses.values()} == {1}
    statuses = [row.status for row in record.rows.values()]
    assert statuses == [FrameStatus.BYPASSED] * N_LOST + [FrameStatus.TRACKED] * (N_LOST + 1)
    (event,) = record.events.of_kind(EventKind.ABSORBED)
    assert (event.data["old_submaps"], event.data["frames"]) == ([0], N_LOST)
    lost = record.atlas.submaps[0]
    assert lost.condemned == set(lost.keyframes)


@pytest.mark.parametrize("n_new", [3, N_LOST])
def test_a_map_that_holds_no_less_stays_until_it_is_outgrown(n_new: int) -> None:
    record = book(n_new)
    assert walked(record) == Absorption([], N_LOST)
    assert [record.poses[i].submap_id for i in range(N_LOST)] == [0] * N_LOST
    assert not record.events.of_kind(EventKind.ABSORBED)
    assert not record.atlas.submaps[0].condemned


@pytest.mark.parametrize("n_new", [3, N_LOST])
def test_at_the_end_a_map_of_any_size_goes(n_new: int) -> None:
    record = book(n_new)
    assert walked(record, at_end=True) == Absorption([0], None)
    assert {p.submap_id for p in record.poses.values()} == {1}


def test_a_map_of_which_a_frame_was_not_posed_stays_for_good() -> None:
    record = book(N_LOST + 1)
    assert walked(record, N_LOST - 1) == Absorption([], None)
    assert not record.events.of_kind(EventKind.ABSORBED)


@pytest.mark.parametrize("wrong", [[3], [0, 1, 2, 3], range(N_LOST)])
def test_a_map_stays_whose_frames_would_jump(wrong: list[int]) -> None:
    """One frame, those beyond a gap that was crossed wrongly, or all: half a metre off; a step is 0.1 m."""
    record = book(40)
    frames = [RecoveredFrame(pose(i, 1, 0.5 * (i in wrong)), 90, 80) for i in range(N_LOST)]
    assert absorb(record, frames, 1, {0}, record.rows[N_LOST]) == Absorption([], None)
    assert [record.poses[i].submap_id for i in range(N_LOST)] == [0] * N_LOST
    assert not record.atlas.submaps[0].condemned
    (event,) = record.events.of_kind(EventKind.LINK_REFUSED)
    assert (event.data["old_submap"], event.data["reason"]) == (0, "leap")
