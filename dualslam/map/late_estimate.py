"""An estimate that was made from an earlier state of a submap, put into the submap as it has become meanwhile.

What the estimate knows takes its values. What has come since follows what stands next to it: keyframes their nearest
ones in time, landmarks the keyframe that described them first. These are initial values for the next solution, and the
tracking goes on from them.
"""

from __future__ import annotations

import numpy as np

from dualslam.core.geometry import se3, sim3
from dualslam.core.noise_model import GROUP
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap
from dualslam.map.submap_change import change_of_frame

N_NEAREST = 3
"""Keyframes that a newer one follows: one alone may have been moved by its own noise."""


def apply_late(
    submap: Submap,
    keyframe_ids: IntArray,
    T_submap_kf: FloatArray,
    landmark_ids: IntArray,
    xyz_mu: FloatArray,
) -> Submap:
    """Apply an estimate of a part of a submap, and let the rest follow; return a copy of the submap as it was.

    `keyframe_ids`, `T_submap_kf`, `landmark_ids`, `xyz_mu`: as for `Submap.apply_estimate`; in the frame and about the
    unit of the submap.
    """
    before = submap.copy()
    known = np.array([k for k in keyframe_ids.tolist() if k in submap.keyframes], np.int64)
    submap.apply_estimate(keyframe_ids, T_submap_kf, landmark_ids, xyz_mu)
    if not len(known):
        return before
    estimated = set(known.tolist())
    newer = [k for k in submap.keyframes if k not in estimated]
    changes = {k: change_of_frame(before, submap, _nearest(known, k)) for k in newer}
    for k, S in changes.items():
        submap.T_submap_kf[k] = sim3.act_on_pose(S, before.T_submap_kf[k])
    _move_points(submap, before, known, landmark_ids)
    return before


def _nearest(known: IntArray, k: int) -> list[int]:
    return [int(near) for near in known[np.argsort(np.abs(known - k), kind="stable")[:N_NEAREST]]]


def _move_points(submap: Submap, before: Submap, known: IntArray, landmark_ids: IntArray) -> None:
    """Let the landmarks that the estimate does not know keep their places relative to a keyframe, in its new unit."""
    lm = submap.landmarks
    rest = lm["alive"].copy()
    rest[landmark_ids] = False
    ids = np.flatnonzero(rest)
    if not len(ids):
        return
    scale = float(sim3.scale(change_of_frame(before, submap, known[-GROUP:].tolist())))
    all_ids = np.array(sorted(submap.keyframes), np.int64)
    place = np.searchsorted(all_ids, lm["first_kf"][ids]).clip(0, len(all_ids) - 1)
    S_cam = np.diag([scale, scale, scale, 1.0])
    moves = submap.keyframe_poses(all_ids) @ S_cam @ se3.inverse(before.keyframe_poses(all_ids))
    of_each = moves[place]
    xyz = before.landmarks["xyz_mu"][ids]
    lm["xyz_mu"][ids] = np.einsum("nij,nj->ni", se3.rotation(of_each), xyz) + se3.translation(of_each)
    lm["distance_mu"][ids] *= scale
