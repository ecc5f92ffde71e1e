"""Removal of dead rows and culled keyframes, which accumulate, from a map that a run continues."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.trajectory import FramePose
from dualslam.map.submap import NO_LANDMARK, Submap

MAX_EARLIER_FRAMES = 100_000
"""Frames of earlier runs whose poses a map keeps, the newest: an hour of 30 Hz, 16 MB. All are in the run folders."""


def tidy(atlas: Atlas, poses: Mapping[int, FramePose]) -> dict[int, FramePose]:
    """Take out of all submaps what is dead; return the frames' poses, relative to keyframes that are there.

    No pose and no landmark moves; landmarks have other ids afterwards.

    `atlas`: between two runs: no graph and no front end knows its rows.
    """
    newest = sorted(poses)[-MAX_EARLIER_FRAMES:]
    kept = {i: _re_anchored(poses[i], atlas.submaps[poses[i].submap_id]) for i in newest}
    for m, submap in atlas.submaps.items():
        _renumber(submap)
        joints = [link for link in atlas.links if m in (link.a, link.b)]
        named = {k for link in joints for k in (*link.keyframes, link.keyframe_a, link.keyframe_b)}
        _drop_anchors(submap, {*named, *submap.gauge})
    return kept


def _re_anchored(pose: FramePose, submap: Submap) -> FramePose:
    if pose.keyframe_id in submap.keyframes:
        return pose
    return pose.at(submap.anchored(pose.keyframe_id, submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam)))


def _renumber(submap: Submap) -> None:
    """Leave only the rows that live, in their order."""
    alive = submap.landmarks["alive"]
    new_id = np.where(alive, np.cumsum(alive) - 1, NO_LANDMARK)
    submap.keep_observations(np.flatnonzero(submap.observations["alive"]))
    submap.observations["landmark"][:] = new_id[submap.observations["landmark"]]
    for k, ids in submap.landmark_of.items():
        submap.landmark_of[k] = np.where(ids >= 0, new_id[ids], NO_LANDMARK)
    submap.landmarks = submap.landmarks.taken(np.flatnonzero(alive))


def _drop_anchors(submap: Submap, wanted: Collection[int]) -> None:
    """Forget the culled keyframes that nothing asks for; the others stand on keyframes that are there."""
    for k, anchor in list(submap.anchors.items()):
        if k in wanted:
            submap.anchors[k] = submap.anchored(k, submap.resolve_anchor(anchor.keyframe_id, anchor.T_kf_cam))
        else:
            del submap.anchors[k]
