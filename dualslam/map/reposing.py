"""Frames posed anew at the end of a run, by the landmarks that they were tracked by, as these are then.

A frame is tracked by landmarks as they are when it comes. Where these are young, they may be far off: as a near bench
leaves the image, what holds the camera's position is a wall that a few centimetres of motion have shown. Keyframes mend
with the landmarks; the frames between them keep how they lay to one, off by up to a tenth of a metre
(docs/notes/2026-11-27-frames-posed-anew-at-the-end.md).
"""

from __future__ import annotations

from dataclasses import replace

from dualslam.core.geometry import se3
from dualslam.map.record import Record
from dualslam.map.submap import Submap


def pose_frames_anew(record: Record, submap: Submap, shape: float, min_inliers: int) -> int:
    """Pose the frames of a submap that are no keyframes of it by its landmarks; return how many were.

    Parameters
    ----------
    record : Record
    submap : Submap
        As it stays.
    shape : float
        Of the loss under which it was refined, in the pixels' sigmas.
    min_inliers : int
        A frame of which fewer landmarks agree stays where it is.
    """
    n_posed = 0
    for i, seen in record.observations.items():
        pose = record.poses.get(i)
        if pose is None or i in submap.keyframes or not pose.submap_id == seen.submap_id == submap.id:
            continue
        T_submap_cam = seen.pose(submap, submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam), shape, min_inliers)
        if T_submap_cam is not None:
            k = submap.keyframe_for(pose.keyframe_id)
            T_kf_cam = se3.inverse(submap.T_submap_kf[k]) @ T_submap_cam
            record.poses[i] = replace(pose, keyframe_id=k, T_kf_cam=T_kf_cam)
            n_posed += 1
    return n_posed
