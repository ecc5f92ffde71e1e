"""Tests of a pose across a gap: it holds the scale, and no other pose explains nearly as much."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.geometry import se3
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Failure, FailureReason, Track
from dualslam.frontends.gap.second_pose import Sight, refuse_look_alike
from dualslam.frontends.gap.uncertainty import SMALL_STEP, track_uncertainty
from dualslam.map.submap import Submap


def refuse_lost_scale(submap: Submap, track: Track, last: Track, max_scale_sigma: float) -> Failure | None:
    """Refuse a track across a gap that does not hold the scale, which all that is mapped beyond the gap will inherit.

    A step from the last track that is small against the depth of what is seen leaves the scale where it is.
    """
    ids = track.landmark_ids[track.landmark_ids >= 0]
    step = se3.inverse(track.T_cam_submap)[:3, 3] - se3.inverse(last.T_cam_submap)[:3, 3]
    if np.linalg.norm(step) < SMALL_STEP * np.median(submap.depths(ids, track.T_cam_submap)):
        return None
    known = track_uncertainty(submap, track)
    scale_sigma = np.inf if known is None else known[1]
    if scale_sigma <= max_scale_sigma:
        return None
    detail = f"the scale beyond the gap is known to {scale_sigma:.1%}"
    return Failure(FailureReason.SCALE, detail, {"gap_scale_sigma": scale_sigma})


def refuse_second_pose(
    submap: Submap, track: Track, keyframe_ids: Sequence[int], frontend: Frontend, camera: Camera, seed: int
) -> Failure | None:
    """Refuse a track if another pose explains nearly as much of what some keyframes see, by their own descriptors."""
    features, ids, known = [], [], np.zeros(len(submap.landmarks), bool)
    for k in keyframe_ids:
        row = np.flatnonzero(submap.landmark_of[k] >= 0)
        row = row[~known[submap.landmark_of[k][row]]]
        ids.append(submap.landmark_of[k][row])
        features.append(submap.keyframes[k].features.descriptors[row])
        known[ids[-1]] = True
    xyz = submap.landmarks["xyz_mu"][np.concatenate(ids)]
    sight = Sight(frontend, np.concatenate(features), xyz, track.view.features, submap.K, camera)
    return refuse_look_alike(sight, track.T_cam_submap, seed)
