"""The start of a map, asked again once the map has matured: reverse tracking over it, on its own triangulations.

A start rests on two or three views, and all that follows inherits what is wrong with it. Later the map knows better,
and the frames of the start are still buffered. So the younger half of the map alone, without anything that only the
start has seen, tracks in reverse over these frames as a new map does over a lost one; and the two are compared frame by
frame. Where they agree the start is confirmed. Where they part for good, and the walk is the one that holds its scale
and explains no less of the images, the start is cut off: it becomes a submap of its own, and its frames take the walk's
poses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from dualslam.core.geometry import se3, sim3
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.map.split import take_out
from dualslam.map.submap import Submap
from dualslam.map.submap_change import change_of_frame
from dualslam.map.trajectory import FramePose
from dualslam.recovery.job import RecoveryJob, RecoveryResult
from dualslam.recovery.linking.scale_observability import scale_sigma_between

AUDIT_KEYFRAMES = 30
"""Of a map whose start is audited: the half that audits has then come a second and more from it, and has landmarks
that the start never saw."""
MIN_KEYFRAMES = 10
"""The same where the buffer is about to let go of the start."""
BUFFER_SHARE = 0.7
"""Of the buffer's duration, after which it is."""
MAX_TURN_RAD = np.radians(3.0)
MAX_WAY_SHARE, MAX_DEPTH_SHARE = 0.1, 0.05
"""How far two maps may differ that are both right: a turn that counts as wrong for a link; a tenth of the way from
where they hang together (a link's 5 % of scale, twice) and a twentieth of the depth."""
MIN_POSED = 0.8
"""Share of the start's frames that the walk must pose to be heard."""
MAX_SCALE_SIGMA = 0.05
"""Of the walk, from its beginning to its end: one that has lost the scale itself says nothing."""
MIN_SUPPORT = 0.8
"""Of the features that agree with the map as it was, where the two part: so many must agree with the walk."""
MIN_PARTED = 5
"""Frames in a row, up to the first one, in which they must part."""
PIXEL_CHI2 = 9.210
CHANGED = "the map has changed meanwhile"


class Verdict(StrEnum):
    """What an audit has come to."""

    CONFIRMED = "confirmed"
    CUT = "cut"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class AuditReport:
    """A verdict on the start of a map, and the numbers that it stands on.

    Attributes
    ----------
    verdict : Verdict
    detail : str
        Why there is none.
    parted_until : int or None
        The newest frame of the start from which on, back to the first, the two part.
    numbers : dict
        For the event log.
    """

    verdict: Verdict
    detail: str
    parted_until: int | None
    numbers: dict[str, float]


def split_for_audit(submap: Submap) -> int:
    """Return the keyframe from which on the map is the half that asks."""
    ids = sorted(submap.keyframes)
    return ids[len(ids) // 2]


def without_start(submap: Submap, first: int) -> Submap:
    """Return a copy of a map without the keyframes before `first`, and without what only they have seen twice.

    Landmark ids and observation rows stay what they are; keyframes that are gone are anchored to `first`.
    """
    rest = submap.copy()
    cut_start(rest, first)
    return rest


def cut_start(submap: Submap, first: int) -> None:
    """Take the keyframes before `first` out of a map: they are anchored to it, and what they alone hold dies."""
    take_out(submap, [k for k in submap.keyframes if k < first], first)


def judge_start(
    live: Submap, poses: Mapping[int, FramePose], n_inliers: Mapping[int, int], job: RecoveryJob, result: RecoveryResult
) -> AuditReport:
    """Compare the start of a map with what reverse tracking has found.

    Parameters
    ----------
    live : Submap
        As it is now, its start included.
    poses : mapping of int to FramePose
        Of frames, by their number.
    n_inliers : mapping of int to int
        Features that agreed with each frame's pose when it was tracked.
    job, result
        The walk.
    """
    first = min(job.submap.keyframes)
    if first not in live.keyframes:
        return AuditReport(Verdict.UNDECIDED, CHANGED, None, {})
    start = [i for i, pose in poses.items() if pose.submap_id == live.id and i < first]
    walked = {frame.pose.index: frame for frame in result.frames if frame.pose.index < first}
    both = np.array(sorted(set(start) & walked.keys()), np.int64)
    posed = len(both) / max(len(start), 1)
    numbers = {"frames": float(len(start)), "posed": posed}
    if posed < MIN_POSED or len(both) < MIN_PARTED:
        return AuditReport(Verdict.UNDECIDED, f"the walk has posed {posed:.0%} of the start", None, numbers)
    sigma = scale_sigma_between(result.submap, *_ends(result.submap, job.submap), PIXEL_CHI2)
    numbers["sigma_scale"] = sigma
    S = change_of_frame(result.submap, live, job.submap.keyframes, len(job.submap.landmarks))
    T_live = np.array([live.resolve_anchor(poses[i].keyframe_id, poses[i].T_kf_cam) for i in both.tolist()])
    T_walk = np.array(
        [
            sim3.act_on_pose(S, result.submap.resolve_anchor(walked[i].pose.keyframe_id, walked[i].pose.T_kf_cam))
            for i in both.tolist()
        ]
    )
    T_first = live.T_submap_kf[first]
    depth = float(np.median(live.depths(_seen(live, first), se3.inverse(T_first))))
    parts = _parts(T_live, T_walk, T_first, depth)
    agrees = np.flatnonzero(~parts)
    numbers["parted"] = float(parts.sum())
    n_parted = int(agrees[0]) if len(agrees) else len(both)  # from the first frame on
    if n_parted < MIN_PARTED:
        if parts.sum() < MIN_PARTED:
            return AuditReport(Verdict.CONFIRMED, "", None, numbers)
        return AuditReport(Verdict.UNDECIDED, "the two part and meet again", None, numbers)
    parted = both[:n_parted]
    if not sigma <= MAX_SCALE_SIGMA:
        detail = f"the walk itself knows its scale to {sigma:.1%}"
        return AuditReport(Verdict.UNDECIDED, detail, int(parted[-1]), numbers)
    explained = sum(n_inliers[i] for i in parted.tolist())
    numbers["support"] = sum(walked[i].n_inliers for i in parted.tolist()) / max(explained, 1)
    if numbers["support"] < MIN_SUPPORT:
        detail = f"the walk explains {numbers['support']:.0%} of what the map did"
        return AuditReport(Verdict.UNDECIDED, detail, int(parted[-1]), numbers)
    return AuditReport(Verdict.CUT, "", int(parted[-1]), numbers)


def _parts(T_live: FloatArray, T_walk: FloatArray, T_first: FloatArray, depth: float) -> BoolArray:
    """Return where two paths (F, 4, 4), oldest first, that end at `T_first` differ by more than both right ones do."""
    steps = np.concatenate([T_walk, T_first[None]])[:, :3, 3]
    way = np.cumsum(np.linalg.norm(np.diff(steps, axis=0), axis=1)[::-1])[::-1]
    apart = np.linalg.norm(T_live[:, :3, 3] - T_walk[:, :3, 3], axis=1)
    turn = np.arccos(np.clip((np.einsum("nij,nij->n", T_live[:, :3, :3], T_walk[:, :3, :3]) - 1) / 2, -1, 1))
    # Of the longer of the two ways: one that has shrunk to nothing must not look like one that was short.
    own = np.concatenate([T_live, T_first[None]])[:, :3, 3]
    way = np.maximum(way, np.cumsum(np.linalg.norm(np.diff(own, axis=0), axis=1)[::-1])[::-1])
    return np.asarray((turn > MAX_TURN_RAD) | (apart > MAX_WAY_SHARE * way + MAX_DEPTH_SHARE * depth))


def _ends(grown: Submap, base: Submap) -> tuple[IntArray, IntArray]:
    """Return the keyframes that a walk has come to last, and the newest of those that it set out from."""
    ids, n = sorted(grown.keyframes), max(len(base.keyframes) // 2, 1)
    return np.array(ids[:n], np.int64), np.array(sorted(base.keyframes)[-n:], np.int64)


def _seen(submap: Submap, keyframe_id: int) -> IntArray:
    ids = submap.landmark_of[keyframe_id]
    return ids[ids >= 0]


def frames_before(poses: Iterable[FramePose], submap_id: int, first: int) -> list[int]:
    """Return the frames of a submap that came before frame `first`, ascending."""
    return sorted(pose.index for pose in poses if pose.submap_id == submap_id and pose.index < first)
