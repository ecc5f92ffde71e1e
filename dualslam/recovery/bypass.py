"""Frames that take their pose from the map that has tracked over them in reverse, or stay without one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from dualslam.atlas.propagation import propagate_poses
from dualslam.atlas.record import Record
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import FrameStatus
from dualslam.map.frame_observations import Change
from dualslam.map.submap import Submap
from dualslam.recovery.job import RecoveredFrame
from dualslam.recovery.merge import Merged


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
    scaled = [replace(frame.pose, T_kf_cam=se3.scaled(frame.pose.T_kf_cam, scale)) for frame in frames]
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
