"""Frames of a lost map that change to the map that has tracked over them in reverse, or stay without a pose."""

from __future__ import annotations

from collections.abc import Collection

from dualslam.core.events import EventKind
from dualslam.core.types import FrameStatus
from dualslam.map.record import FrameStamp, Record
from dualslam.recovery.job import RecoveredFrame


def bypass(record: Record, recovered_frames: Collection[RecoveredFrame], new_id: int, handover: int) -> int:
    """Let the newest part of a linked old map take its poses from the new one; return of how many frames.

    Parameters
    ----------
    record : Record
    recovered_frames : collection of RecoveredFrame
    new_id : int
        The submap that walked.
    handover : int
        The newest keyframe that agrees in both maps: what is beyond it changes.
    """
    poses, n_bypassed = record.poses, 0
    for frame in recovered_frames:
        i = frame.pose.index
        if i <= handover or poses[i].submap_id == new_id:
            continue
        record.pose(frame.pose)
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
        record.rows[i].status, record.rows[i].submap = FrameStatus.BYPASSED, None
    return len(corrupted)


def condemn_tail(
    record: Record, recovered_frames: Collection[RecoveredFrame], old_id: int, handover: int, since: int
) -> int:
    """Mark the keyframes of a linked old map that are not to be relied on any more; return how many.

    Those beyond the handover that the new map has posed, and all of the corrupted tail, from `since` on.
    """
    submap, own = record.atlas.submaps[old_id], {frame.pose.index for frame in recovered_frames}
    tail = {k for k in submap.keyframes if k >= since or (k > handover and k in own)}
    submap.condemn(tail)
    return len(submap.condemned)


def absorb(
    record: Record, recovered_frames: Collection[RecoveredFrame], new_id: int, lost: Collection[int], now: FrameStamp
) -> list[int]:
    """Let lost maps go of which the new one has posed every frame, where it holds more frames besides.

    A map of a few frames hardly knows its own scale, so that no similarity to it is sure. None is needed: what it saw
    has its place in the larger map. The smaller one stays archived, without frames. A lost map that holds more than
    the new one stays: what a long map says is not given up for a short one that would not fit it.

    Parameters
    ----------
    record : Record
    recovered_frames : collection of RecoveredFrame
    new_id : int
        The submap that walked.
    lost : collection of int
        Submaps that wait for a link; with those that they are linked to they go or stay.
    now : FrameStamp

    Returns
    -------
    list of int
        The submaps that have gone.
    """
    found = {frame.pose.index: frame.pose for frame in recovered_frames}
    n_own, gone = n_frames(record, new_id), list[int]()
    for component, frames in covered(record, recovered_frames, new_id, lost):
        if len(frames) >= n_own:
            continue
        for i in frames:
            record.pose(found[i])
            record.rows[i].status = FrameStatus.BYPASSED
        gone += component
        for m in component:
            record.atlas.submaps[m].condemn(record.atlas.submaps[m].keyframes)
        record.event(EventKind.ABSORBED, now, new_id, old_submaps=component, frames=len(frames))
    return gone


def covered(
    record: Record, recovered_frames: Collection[RecoveredFrame], new_id: int, lost: Collection[int]
) -> list[tuple[list[int], set[int]]]:
    """Return the lost maps, with what they are linked to, of which a walk has posed every frame; and these frames."""
    found, maps = {frame.pose.index for frame in recovered_frames}, []
    for component in record.atlas.components():
        frames = {i for i, pose in record.poses.items() if pose.submap_id in component}
        if new_id not in component and frames and frames <= found and not set(lost).isdisjoint(component):
            maps.append((component, frames))
    return maps


def n_frames(record: Record, submap_id: int) -> int:
    """Count the frames that a submap, and what it is linked to, have posed."""
    own = next(c for c in record.atlas.components() if submap_id in c)
    return sum(pose.submap_id in own for pose in record.poses.values())
