"""Fusion of a recovered map with the lost one: their link, the by-pass of what is corrupted, and the gauge."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence, Set
from dataclasses import replace
from itertools import combinations

import numpy as np

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.atlas.connections import Connections
from dualslam.atlas.propagation import propagate_poses
from dualslam.atlas.record import FrameStamp, Record
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Failure, FailureReason, FloatArray, FrameStatus, IntArray
from dualslam.linking import LinkRefusal, estimate_link
from dualslam.map.frame_observations import Change
from dualslam.map.split import sound_copy
from dualslam.map.submap import Submap
from dualslam.map.submap_change import change_of_frame
from dualslam.recovery.job import FoundLink, RecoveredFrame, RecoveryJob, refusal_data
from dualslam.recovery.merge import Merged


def fuse(
    record: Record,
    connections: Connections,
    job: RecoveryJob,
    found: FoundLink,
    S_now_then: FloatArray,
    recovered_frames: list[RecoveredFrame],
    now: FrameStamp,
    seconds: float,
) -> bool:
    """Join the two submaps by the link, unless the atlas refuses it; return whether they are joined.

    The link was measured between a copy of the old submap and the new one at the end of the walk. Both may have moved
    since. Frames of the old map's end take their pose from the new one.
    """
    new_id = job.submap.id
    joined = _current(record, job.lost[found.old_id], new_id, found, S_now_then)
    report = connections.connect([joined], now)
    if not report or any(link.attached_as(joined) for link in report.newly_rejected):
        why = report.failure or Failure(FailureReason.CONTRADICTION, "the rest of the atlas contradicts the link")
        note_refused(record, found, new_id, why, now)
        return False
    _note_link(record, EventKind.LINKED, found, joined, now, seconds)
    _hand_over(record, job, found, recovered_frames, now)
    return True


def tighten(
    record: Record, connections: Connections, job: RecoveryJob, relinked: FoundLink, grown: Submap, now: FrameStamp
) -> None:
    """Replace the link of two joined submaps where `grown` has measured it again, and its scale is known better."""
    keyframe_ids = relinked.estimate.agreeing_keyframes.tolist()
    S_now_then = change_of_frame(grown, record.atlas.submaps[grown.id], keyframe_ids)
    link = _current(record, job.joined[relinked.old_id], grown.id, relinked, S_now_then)
    if connections.tighten(link, now):
        _note_link(record, EventKind.RELINKED, relinked, link, now)


def _current(record: Record, old: Submap, new_id: int, found: FoundLink, S_now_then: FloatArray) -> Link:
    """Return a link that was measured between copies of two submaps as one between what they have become since.

    `old`: the copy of the old one; `S_now_then`: what has become of the new one.
    """
    link, keyframe_ids = found.estimate, found.estimate.agreeing_keyframes.tolist()
    S_old_now_then = change_of_frame(old, record.atlas.submaps[old.id], keyframe_ids)
    S_old_new = S_old_now_then @ link.S_old_new @ sim3.inverse(S_now_then)
    Ad = sim3.adjoint(S_now_then)
    C, stands_on = Ad @ link.covariance @ Ad.T, tuple(keyframe_ids)
    return Link(old.id, new_id, S_old_new, C, LinkKind.RECOVERY, stands_on, is_sure=found.is_sure)


def _note_link(
    record: Record, kind: EventKind, found: FoundLink, joined: Link, now: FrameStamp, seconds: float | None = None
) -> None:
    link = found.estimate
    record.event(
        kind,
        now,
        joined.b,
        link.gates,
        old_submap=found.old_id,
        attempt=found.attempt,
        matches=link.n_matches,
        inliers=link.n_inliers,
        agreeing_keyframes=list(joined.keyframes),
        change_point=link.change_point,
        S_old_new=joined.S_a_b.tolist(),
        **({} if seconds is None else {"seconds": seconds}),
        **(link.numbers | {"scale": float(sim3.scale(joined.S_a_b))}),
    )


def gauge_at_overlap(submap: Submap, keyframe_ids: IntArray) -> tuple[int, int]:
    """Return the two keyframes that are to hold a submap's gauge from now on: the widest baseline of the overlap.

    A link is measured at its overlap, which would drift away under it if the gauge lay elsewhere. Where the overlap
    spans less than the gauge in use (a turn in place), that one stays.
    """
    ids = [int(k) for k in keyframe_ids if int(k) in submap.keyframes]
    if len(ids) < 2:
        return submap.gauge
    newest = ids[-1]
    reach = np.linalg.norm(
        se3.translation(submap.keyframe_poses(ids)) - se3.translation(submap.T_submap_kf[newest]), axis=1
    )
    in_use = [se3.translation(submap.resolve_anchor(k, se3.IDENTITY)) for k in submap.gauge]
    if reach.max() <= np.linalg.norm(in_use[0] - in_use[1]):
        return submap.gauge
    return newest, ids[int(np.argmax(reach))]


def _hand_over(
    record: Record, job: RecoveryJob, found: FoundLink, recovered_frames: list[RecoveredFrame], now: FrameStamp
) -> None:
    """Give the frames of the old map's end the poses of the new one, and mark unreliable keyframes invalid."""
    link, new_id = found.estimate, job.submap.id
    newest = int(link.agreeing_keyframes[-1])
    onset = job.onsets[found.old_id]
    corrupted_since = onset if link.change_point is None else min(onset, link.change_point)
    n_bypassed = bypass(record, recovered_frames, new_id, newest)
    n_dropped = drop_corrupted(record, found.old_id, corrupted_since)
    n_condemned = condemn_tail(record, recovered_frames, found.old_id, newest, corrupted_since)
    for i in (frame.pose.index for frame in recovered_frames if frame.pose.index >= onset):
        row = record.rows[i]
        if row.status is FrameStatus.TRACKED and record.poses[i].submap_id != found.old_id:
            row.status = FrameStatus.RECOVERED
    record.event(
        EventKind.FUSED,
        now,
        new_id,
        old_submap=found.old_id,
        bypassed=n_bypassed,
        dropped=n_dropped,
        condemned_keyframes=n_condemned,
        condemned_landmarks=int(record.atlas.submaps[found.old_id].landmarks["condemned"].sum()),
    )


def note_refused(record: Record, found: FoundLink, new_id: int, why: Failure, now: FrameStamp) -> None:
    """Say why a link that a walk had found is not made."""
    data = refusal_data(found.attempt, found.old_id, why)
    record.event(EventKind.LINK_REFUSED, now, new_id, why.gates, **data)


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
    """Let the newest part of a linked old map take its poses from the new one, `new_id`; return of how many frames.

    `handover`: the newest keyframe that agrees in both maps: what is beyond it changes.
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
    """Take the pose from frames of the corrupted tail that the walk has skipped: that of the old map may be wrong."""
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


def link_overlaps(record: Record, connections: Connections, config: Config, own: Set[int], now: FrameStamp) -> None:
    """Link a run's `own` submaps of each set where they hold the same keyframes, when the run is over."""
    with record.timer.measure("overlaps"):
        for component in record.atlas.components():
            if links := list(_overlaps(record, [m for m in component if m in own], config)):
                connections.connect(links, now)


def _overlaps(record: Record, submap_ids: list[int], config: Config) -> Iterator[Link]:
    """Yield links between submaps, ascending, over the keyframes that both hold, where none stands on these yet."""
    submaps = record.atlas.submaps
    onsets = {event.submap: event.data["suspected_since"] for event in record.events.of_kind(EventKind.FAILED)}
    linked = {frozenset((link.a, link.b)) for link in record.atlas.believed if link.keyframes}
    for a, b in combinations(submap_ids, 2):
        n_shared = len(submaps[a].keyframes.keys() & submaps[b].keyframes.keys())
        if n_shared < config.linking.min_keyframes or {a, b} in linked:
            continue
        old, new = (sound_copy(submaps[m]) for m in (a, b))
        found = estimate_link(old, new, config.linking, np.random.default_rng(config.seed), onsets.get(a))
        link = found.unsure or found if isinstance(found, LinkRefusal) else found
        if not isinstance(link, Failure):
            known = link.S_old_new, link.covariance, LinkKind.RECOVERY, tuple(link.agreeing_keyframes.tolist())
            yield Link(a, b, *known, doubtful=False, is_sure=link is found)
