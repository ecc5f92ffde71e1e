"""Propagation of a moved submap: to its other frames, its culled keyframes, its links."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from dualslam.atlas.atlas import Atlas, Link
from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose
from dualslam.core.bundle import FrameRows
from dualslam.core.geometry import se3, sim3
from dualslam.core.geometry.projection import settle_poses
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.anchors import Anchor
from dualslam.map.frame_observations import seen_now
from dualslam.map.submap import Submap
from dualslam.map.submap_change import change_of_frame

FRAMES_AT_ONCE = 64
"""That are posed anew: what some 10,000 observations need stays in a core's cache."""


def propagate_poses(poses: Iterable[FramePose], before: Submap, after: Submap) -> list[FramePose]:
    """Move the frames of a submap with it: a solution or a change of calibration bends the whole map.

    Each frame is carried by the keyframes before and after it in time, in proportion to its distance from them.

    - `poses`: those of other submaps are passed over.
    - `before`, `after`: two states of the submap, in about the same frame.

    Returns list of FramePose: posed against keyframes of `after`; those that are keyframes there are left out.
    """
    own = [pose for pose in poses if pose.submap_id == after.id and pose.index not in after.keyframes]
    if not own:
        return []
    T_submap_cam = np.array([before.resolve_anchor(pose.keyframe_id, pose.T_kf_cam) for pose in own])
    ids, T_kf_cam = _propagate([pose.index for pose in own], T_submap_cam, before, after)
    return [replace(pose, keyframe_id=k, T_kf_cam=T) for pose, k, T in zip(own, ids.tolist(), T_kf_cam, strict=True)]


def propagate_anchors(before: Submap, after: Submap) -> None:
    """Move the culled keyframes of `after` in the same way."""
    # The others came with the change.
    known = [k for k in after.anchors if k in before.anchors or k in before.keyframes]
    if not known:
        return
    ids, T_kf_cam = _propagate(known, np.array([before.resolve_anchor(k, se3.IDENTITY) for k in known]), before, after)
    for k, reference, T in zip(known, ids.tolist(), T_kf_cam, strict=True):
        after.anchors[k] = Anchor(reference, T)


def _propagate(
    index: Sequence[int], T_submap_cam: FloatArray, before: Submap, after: Submap
) -> tuple[IntArray, FloatArray]:
    """Return keyframes (N,) and the poses against them (N, 4, 4) of frames that were at `T_submap_cam`."""
    keyframe_ids = np.array(sorted(before.keyframes.keys() & after.keyframes.keys()), np.int64)
    was, now = (np.array([s.T_submap_kf[k] for k in keyframe_ids.tolist()]) for s in (before, after))
    here = np.searchsorted(keyframe_ids, np.asarray(index, np.int64))
    a, b = np.maximum(here - 1, 0), np.minimum(here, len(keyframe_ids) - 1)
    T_a, T_b = (se3.inverse(was[at]) @ T_submap_cam for at in (a, b))
    from_a, from_b = (np.linalg.norm(se3.translation(T), axis=1) for T in (T_a, T_b))
    share = np.divide(from_a, from_a + from_b, out=np.zeros(len(a)), where=from_a + from_b > 0)
    share[a == b] = 0.0
    T_a_b = se3.inverse(now[a]) @ now[b]
    gap = se3.log(se3.inverse(T_a) @ T_a_b @ T_b)
    return keyframe_ids[a], T_a @ se3.exp(share[:, None] * gap)


def follow_keyframes(
    S_a_b: FloatArray, covariance: FloatArray, then: tuple[FloatArray, FloatArray], now: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return a similarity between two submaps, and its covariance, as a keyframe of each has moved: what holds is how
    the two keyframes lie to each other.

    - `S_a_b` (4, 4).
    - `covariance` (7, 7): in the frame of b.
    - `then`, `now` ((4, 4), (4, 4)): poses of the keyframes, that of a first, in their submaps.
    """
    (a_then, b_then), (a_now, b_now) = then, now
    S = a_now @ se3.inverse(a_then) @ S_a_b @ b_then @ se3.inverse(b_now)
    Ad = sim3.adjoint(b_now @ se3.inverse(b_then))
    return S, Ad @ covariance @ Ad.T


def propagate_links(atlas: Atlas, before: Submap, after: Submap) -> None:
    """Let the links of a submap follow a change of it, each as the keyframes moved that it stands on there."""
    for i, link in enumerate(atlas.links):
        S_a_b, covariance = link.S_a_b, link.covariance
        if link.a == after.id:
            S_a_b = _change_at(before, after, link, link.keyframe_a) @ S_a_b
        if link.b == after.id:
            S_after_before = _change_at(before, after, link, link.keyframe_b)
            Ad = sim3.adjoint(S_after_before)
            S_a_b = S_a_b @ sim3.inverse(S_after_before)
            covariance = Ad @ covariance @ Ad.T
        atlas.links[i] = replace(link, S_a_b=S_a_b, covariance=covariance)


def _change_at(before: Submap, after: Submap, link: Link, attached: int) -> FloatArray:
    """Return how a submap has changed about the keyframes that a link stands on there."""
    stands_on = [k for k in (*link.keyframes, attached) if k in before.keyframes and k in after.keyframes]
    return change_of_frame(before, after, stands_on or before.keyframes)


def rows_of_frames(record: Record, submap: Submap, at_most: int, min_inliers: int) -> FrameRows:
    """Return what the frames of a submap that are no keyframes of it have seen.

    - `at_most`: so many frames, spread evenly over those that are kept.
    - `min_inliers`: frames that have seen fewer of its landmarks are left out.
    """
    own = np.array(sorted(_frames_of(record, submap)), np.int64)
    chosen = own[np.linspace(0, len(own) - 1, min(at_most, len(own))).round().astype(np.int64)]
    return _rows_of(record, submap, chosen.tolist(), min_inliers)[1]


def _rows_of(record: Record, submap: Submap, frames: list[int], min_inliers: int) -> tuple[list[int], FrameRows]:
    """Return which of some frames have seen enough, and what."""
    frame, ids, uv_px, sigma_px = seen_now([record.observations[i] for i in frames], submap)
    enough = np.bincount(frame, minlength=len(frames)) >= min_inliers
    known, number = enough[frame], np.cumsum(enough) - 1
    kept = [i for i, is_kept in zip(frames, enough.tolist(), strict=True) if is_kept]
    poses = [record.poses[i] for i in kept]
    T_submap_cam = se3.stack([submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam) for pose in poses])
    return kept, FrameRows(T_submap_cam, number[frame[known]], ids[known], uv_px[known], sigma_px[known])


def pose_frames_anew(record: Record, submap: Submap, shape: float, min_inliers: int) -> int:
    """Pose the frames of a submap that are no keyframes of it by its landmarks; return how many were.

    A frame was tracked by landmarks as they were then (docs/notes/2026-11-27-frames-posed-anew-at-the-end.md).

    - `submap`: as it stays.
    - `shape`: of the loss under which it was refined, in the pixels' sigmas.
    - `min_inliers`: a frame of which fewer landmarks agree stays where it is.
    """
    own, n_posed = _frames_of(record, submap), 0
    for begin in range(0, len(own), FRAMES_AT_ONCE):
        frames, seen = _rows_of(record, submap, own[begin : begin + FRAMES_AT_ONCE], min_inliers)
        xyz_mu, T_cam_submap = submap.landmarks["xyz_mu"][seen.landmark_ids], se3.inverse(seen.T_submap_cam)
        what = seen.frame, xyz_mu, seen.uv_px, seen.sigma_px
        settled = settle_poses(submap.K, T_cam_submap, *what, shape=shape, min_inliers=min_inliers)
        for i, T in zip(frames, settled, strict=True):
            if np.isfinite(T).all():
                pose = record.poses[i]
                record.poses[i] = pose.at(submap.anchored(pose.keyframe_id, se3.inverse(T)))
                n_posed += 1
    return n_posed


def _frames_of(record: Record, submap: Submap) -> list[int]:
    """Return the frames that are posed in a submap, have kept what they saw of it, and are no keyframes."""
    return [
        i
        for i, seen in record.observations.items()
        if seen.submap_id == submap.id and i in record.poses and i not in submap.keyframes
        if record.poses[i].submap_id == submap.id
    ]
