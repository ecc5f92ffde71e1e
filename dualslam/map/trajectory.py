"""Per-frame poses: measured relative to a keyframe, composed when asked for, never stored."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import sim3
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import FloatArray
from dualslam.map.atlas import Atlas


@dataclass(frozen=True, slots=True, eq=False)
class FramePose:
    """Where a frame was measured to be: relative to a keyframe of a submap."""

    index: int
    timestamp_s: float
    submap_id: int
    keyframe_id: int
    T_kf_cam: FloatArray


def compose(poses: Iterable[FramePose], atlas: Atlas, S_world_submap: dict[int, FloatArray]) -> Trajectory:
    """Compose the poses of the frames that stand in the given submaps, in their common frame.

    Parameters
    ----------
    poses : iterable of FramePose
    atlas : Atlas
    S_world_submap : dict of int to (4, 4) float64
        The submaps to take in; frames of others are left out.
    """
    kept = sorted((p for p in poses if p.submap_id in S_world_submap), key=lambda p: p.index)
    T_world_cam = np.empty((len(kept), 4, 4))
    for i, pose in enumerate(kept):
        T_submap_cam = atlas.submaps[pose.submap_id].resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
        T_world_cam[i] = sim3.act_on_pose(S_world_submap[pose.submap_id], T_submap_cam)
    timestamps_s = np.array([p.timestamp_s for p in kept], float)
    return Trajectory(timestamps_s, T_world_cam, np.array([p.index for p in kept], np.int64))
