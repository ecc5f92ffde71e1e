"""Frames that take their pose from the map that has tracked over them in reverse, or stay without one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualslam.atlas.propagation import propagate_poses
from dualslam.atlas.record import FrameStamp, Record
from dualslam.atlas.trajectory import Path
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.core.types import Failure, FloatArray, FrameStatus
from dualslam.linking.join_test import judge_motion
from dualslam.linking.motion import step_motions
from dualslam.map.frame_observations import Change
from dualslam.map.submap import Submap
from dualslam.recovery.job import RecoveredFrame, refusal_data
from dualslam.recovery.merge import Merged


@dataclass(frozen=True, slots=True)
class Absorption:
    """Effect on the lost maps of which a walk has posed every frame."""

    gone: list[int]  # the submaps that have gone
    outgrown_at: int | None
    """The smallest number of frames of those that hold no fewer than the new map, and stay; None where none does."""


def pose_frames(
    record: Record, frames: Sequence[RecoveredFrame], merged: Merged, submap: Submap, change: Change | None = None
) -> list[RecoveredFrame]:
    """Carry the frames of a walk into the submap that has taken it in, and enter those that had no pose.

    - `frames`: as the walk posed them.
    - `merged`: the submap with what the walk added, in its unit, not solved.
    - `submap`: the same, solved.
    - `change`: see `merge_recovery`.
    """
    scale = float(sim3.scale(merged.S_live_grown))
    scaled = [replace(frame.pose, T_kf_cam=_scaled(frame.pose.T_kf_cam, scale)) for frame in frames]
    carried = {pose.index: pose for pose in propagate_poses(scaled, merged.moved, submap)}
    recovered_frames = []
    for frame, pose in zip(frames, scaled, strict=True):
        seen = frame.observations
        if seen is not None:
            seen = seen.in_submap(submap.id, merged.id_of)
            seen = seen if change is None else seen.with_change(change)
        recovered_frames.append(replace(frame, pose=carried.get(pose.index, pose), observations=seen))
        if pose.index not in record.poses:
            record.pose(recovered_frames[-1].pose, frame.n_matches, frame.n_inliers, seen, frame.method)
    return recovered_frames


def bypass(record: Record, recovered_frames: Collection[RecoveredFrame], new_id: int, handover: int) -> int:
    """Let the newest part of a linked old map take its poses from the new one; return of how many frames.

    - `new_id`: the submap that walked.
    - `handover`: the newest keyframe that agrees in both maps: what is beyond it changes.
    """
    poses, n_bypassed = record.poses, 0
    for frame in recovered_frames:
        i = frame.pose.index
        if i <= handover or poses[i].submap_id == new_id:
            continue
        record.pose(frame.pose, observations=frame.observations, method=frame.method)
        record.rows[i].status = FrameStatus.BYPASSED
        n_bypassed += 1
    return n_bypassed


def drop_corrupted(record: Record, old_id: int, since: int) -> int:
    """Take the pose from frames of the corrupted tail that the walk has skipped: that of the old map may be wrong.

    They keep their row.
    """
    poses = record.poses
    corrupted = [i for i, pose in poses.items() if pose.submap_id == old_id and i >= since]
    for i in corrupted:
        del poses[i]
        record.observations.pop(i, None)
        row = record.rows[i]
        row.status, row.submap, row.method = FrameStatus.BYPASSED, None, None
    return len(corrupted)


def condemn_tail(
    record: Record, recovered_frames: Collection[RecoveredFrame], old_id: int, handover: int, since: int
) -> int:
    """Mark the keyframes of a linked old map that are no longer reliable; return how many.

    Those beyond the handover that the new map has posed, and all of the corrupted tail, from `since` on.
    """
    submap, own = record.atlas.submaps[old_id], {frame.pose.index for frame in recovered_frames}
    tail = {k for k in submap.keyframes if k >= since or (k > handover and k in own)}
    submap.condemn(tail)
    return len(submap.condemned)


def absorb(
    record: Record,
    recovered_frames: Collection[RecoveredFrame],
    new_id: int,
    lost: Collection[int],
    now: FrameStamp,
    at_end: bool = False,
) -> Absorption:
    """Let lost maps go of which the new one has posed every frame, where it holds more frames besides.

    A map of a few frames hardly knows its own scale, so that no similarity to it is sure. None is needed: what it saw
    has its place in the larger map. The smaller one stays archived, without frames. A lost map that holds more than
    the new one stays until the end of the run: until then a link may still join it. A map whose frames would move as
    the camera does not stays for good (`linking/motion.py`).

    - `new_id`: the submap that walked.
    - `lost`: submaps that wait for a link; with those that they are linked to they go or stay.
    - `at_end`: no link can join a lost map any more.
    """
    found = {frame.pose.index: frame for frame in recovered_frames}
    n_own, gone, n_stay = n_frames(record, new_id), list[int](), list[int]()
    for component in record.atlas.components():
        frames = {i for i, pose in record.poses.items() if pose.submap_id in component}
        is_covered = bool(frames) and frames <= found.keys()
        if new_id in component or not is_covered or set(lost).isdisjoint(component):
            continue
        if len(frames) >= n_own and not at_end:
            n_stay.append(len(frames))
            continue
        refused = _refuse_motion(record, found, frames, new_id)
        if refused is not None:
            data = refusal_data("absorb", max(component), refused)
            record.event(EventKind.LINK_REFUSED, now, new_id, refused.gates, **data)
            continue
        for i in frames:
            record.pose(found[i].pose, observations=found[i].observations, method=found[i].method)
            record.rows[i].status = FrameStatus.BYPASSED
        gone += component
        for m in component:
            record.atlas.submaps[m].condemn(record.atlas.submaps[m].keyframes)
        record.event(EventKind.ABSORBED, now, new_id, old_submaps=component, frames=len(frames))
    return Absorption(gone, min(n_stay, default=None))


def _refuse_motion(
    record: Record, found: dict[int, RecoveredFrame], frames: Collection[int], new_id: int
) -> Failure | None:
    """Return why lost frames are not given their new poses, by the camera's motion at each of them."""
    submap = record.atlas.submaps[new_id]
    own = [pose for pose in record.own_poses() if pose.submap_id == new_id and pose.index not in found]
    known = Path.of(own, submap)
    known = replace(known, refound=record.are_refound(known.index.tolist()))
    path = Path.of([*own, *(frame.pose for frame in found.values())], submap)
    lost = np.isin(path.index, list(frames))
    return judge_motion(step_motions(path, np.flatnonzero(lost[:-1] | lost[1:]), known)).refusal()


def n_frames(record: Record, submap_id: int) -> int:
    """Count the frames that a submap, and what it is linked to, have posed."""
    own = record.atlas.component_of(submap_id)
    return sum(pose.submap_id in own for pose in record.poses.values())


def _scaled(T: FloatArray, scale: float) -> FloatArray:
    scaled = T.copy()
    scaled[:3, 3] *= scale
    return scaled
