"""Frames posed anew at the end of a run, by the landmarks that they were tracked by, as these are then.

A frame is tracked by landmarks as they are when it comes. Where these are young, they may be far off: as a near bench
leaves the image, what holds the camera's position is a wall that a few centimetres of motion have shown. Keyframes are
mended with the landmarks. The frames between them keep their place relative to one, off by up to a tenth of a metre
(docs/notes/2026-11-27-frames-posed-anew-at-the-end.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualslam.atlas.record import Record
from dualslam.core.bundle import FrameRows
from dualslam.core.geometry import se3
from dualslam.map.submap import Submap


def rows_of_frames(record: Record, submap: Submap, at_most: int, min_inliers: int) -> FrameRows:
    """Return what the frames of a submap that are no keyframes of it have seen.

    - `at_most`: so many frames, spread evenly over those that are kept.
    - `min_inliers`: frames that have seen fewer of its landmarks are left out.
    """
    own = np.array(sorted(_frames_of(record, submap)), np.int64)
    chosen = own[np.linspace(0, len(own) - 1, min(at_most, len(own))).round().astype(np.int64)]
    rows = [(record.poses[i], *record.observations[i].seen_now(submap)) for i in chosen.tolist()]
    rows = [row for row in rows if len(row[1]) >= min_inliers]
    n_seen = np.array([len(ids) for _, ids, _, _ in rows], np.int64)
    return FrameRows(
        np.array([submap.resolve_anchor(p.keyframe_id, p.T_kf_cam) for p, *_ in rows]).reshape(-1, 4, 4),
        np.repeat(np.arange(len(rows)), n_seen),
        np.concatenate([np.zeros(0, np.int64), *(ids for _, ids, _, _ in rows)]),
        np.concatenate([np.zeros((0, 2)), *(uv_px for _, _, uv_px, _ in rows)]),
        np.concatenate([np.zeros(0), *(sigma_px for _, _, _, sigma_px in rows)]),
    )


def pose_frames_anew(record: Record, submap: Submap, shape: float, min_inliers: int) -> int:
    """Pose the frames of a submap that are no keyframes of it by its landmarks; return how many were.

    - `submap`: as it stays.
    - `shape`: of the loss under which it was refined, in the pixels' sigmas.
    - `min_inliers`: a frame of which fewer landmarks agree stays where it is.
    """
    n_posed = 0
    for i in _frames_of(record, submap):
        pose = record.poses[i]
        T_submap_cam = submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
        T_submap_cam_now = record.observations[i].pose(submap, T_submap_cam, shape, min_inliers)
        if T_submap_cam_now is not None:
            k = submap.keyframe_for(pose.keyframe_id)
            T_kf_cam = se3.inverse(submap.T_submap_kf[k]) @ T_submap_cam_now
            record.poses[i] = replace(pose, keyframe_id=k, T_kf_cam=T_kf_cam)
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
