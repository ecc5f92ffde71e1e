"""What follows a submap that has moved: its frames that are no keyframes, its culled keyframes, its links."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from dualslam.core.geometry import se3, sim3
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.atlas import Atlas, Link
from dualslam.map.submap import Anchor, Submap
from dualslam.map.submap_change import change_of_frame
from dualslam.map.trajectory import FramePose


def propagate_poses(poses: Iterable[FramePose], before: Submap, after: Submap) -> list[FramePose]:
    """Move the frames of a submap with it: a solution or a change of calibration bends the whole map.

    A pose relative to one keyframe would follow that keyframe rigidly, though lengths and turns have changed as well.
    Each frame is therefore carried by the keyframes before and after it in time, in proportion to its distance from
    them.

    Parameters
    ----------
    poses : iterable of FramePose
        Those of other submaps are passed over.
    before, after : Submap
        Two states of the submap, in about the same frame.

    Returns
    -------
    list of FramePose
        Posed against keyframes of `after`; those that are keyframes there are left out.
    """
    keyframe_ids = _in_both(before, after)
    carried = []
    for pose in poses:
        if pose.submap_id != after.id or pose.index in after.keyframes:
            continue
        T_submap_cam = before.resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
        k, T_kf_cam = _propagate(pose.index, T_submap_cam, keyframe_ids, before, after)
        carried.append(replace(pose, keyframe_id=k, T_kf_cam=T_kf_cam))
    return carried


def propagate_anchors(before: Submap, after: Submap) -> None:
    """Move the culled keyframes of `after` in the same way."""
    keyframe_ids = _in_both(before, after)
    for k in list(after.anchors):
        if k not in before.anchors and k not in before.keyframes:
            continue  # it came with the change
        after.anchors[k] = Anchor(*_propagate(k, before.resolve_anchor(k, np.eye(4)), keyframe_ids, before, after))


def _in_both(before: Submap, after: Submap) -> IntArray:
    return np.array(sorted(before.keyframes.keys() & after.keyframes.keys()), np.int64)


def _propagate(
    index: int, T_submap_cam: FloatArray, keyframe_ids: IntArray, before: Submap, after: Submap
) -> tuple[int, FloatArray]:
    """Return the keyframe and the pose against it of a frame that was at `T_submap_cam`."""
    here = int(np.searchsorted(keyframe_ids, index))
    last = len(keyframe_ids) - 1
    a, b = int(keyframe_ids[max(here - 1, 0)]), int(keyframe_ids[min(here, last)])
    T_a, T_b = (se3.inverse(before.T_submap_kf[k]) @ T_submap_cam for k in (a, b))
    if a == b:
        return a, T_a
    from_a, from_b = float(np.linalg.norm(T_a[:3, 3])), float(np.linalg.norm(T_b[:3, 3]))
    share = from_a / (from_a + from_b) if from_a + from_b > 0 else 0.0
    T_a_b = se3.inverse(after.T_submap_kf[a]) @ after.T_submap_kf[b]
    gap = se3.log(se3.inverse(T_a) @ T_a_b @ T_b)
    return a, T_a @ se3.exp(share * gap)


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
