"""How a camera turns, by the poses of its frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from operator import attrgetter

import numpy as np

from dualslam.atlas.trajectory import FramePose
from dualslam.core.camera.base import Camera
from dualslam.core.geometry import so3
from dualslam.core.interfaces import Shutter
from dualslam.core.types import FloatArray, Track
from dualslam.map.submap import Submap

MAX_GAP_S = 0.2
"""Between two frames whose poses tell how the camera turns."""


def turn_rates(submap: Submap, poses: Iterable[FramePose]) -> dict[int, FloatArray]:
    """Return how the camera turns at the frames that a submap has posed (rad/s, in its own axes), by their index.

    `poses`: in any order; those of other submaps are left out.
    """
    posed = sorted((p for p in poses if p.submap_id == submap.id), key=attrgetter("index"))
    if len(posed) < 2:
        return {}
    t = np.array([p.timestamp_s for p in posed])
    R = np.array([_orientation(submap, p) for p in posed])
    n = np.arange(len(posed))
    apart = np.abs(np.diff(t)) > MAX_GAP_S
    first = n - ~np.concatenate([[True], apart])
    last = n + ~np.concatenate([apart, [True]])
    told = n[t[first] != t[last]]
    first, last = first[told], last[told]
    rates = _rate(R[first], R[last], (t[last] - t[first])[:, None])
    return {posed[i].index: rate for i, rate in zip(told.tolist(), rates, strict=True)}


def with_turn_of_poses(
    track: Track, submap: Submap, before: FramePose | None, shutter: Shutter, camera: Camera
) -> Track:
    """Return a frame that is to become a keyframe with the turn taken out of its pixels that its pose tells.

    Matches to the frame before tell it before there is a pose, and take a part of what the camera has moved for a turn.

    - `submap`: in which the frame is posed.
    - `before`: of the frame before it.
    - `camera`: that rectified the frame's pixels.
    """
    view = track.view
    if view.turn_rad is None or before is None or before.submap_id != submap.id:
        return track
    gap_s = view.timestamp_s - before.timestamp_s
    if not 0 < abs(gap_s) <= MAX_GAP_S:
        return track
    turn_rad = shutter.readout_s * _rate(_orientation(submap, before), track.T_cam_submap[:3, :3].T, gap_s)
    features = shutter.moved(view.features, camera, turn_rad - view.turn_rad)
    return replace(track, view=replace(view, features=features, turn_rad=turn_rad))


def _orientation(submap: Submap, pose: FramePose) -> FloatArray:
    return submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam)[:3, :3]


def _rate(R_before: FloatArray, R_after: FloatArray, gap_s: FloatArray | float) -> FloatArray:
    """Return the turn from one orientation to another, for each second, in the axes of the first."""
    rate: FloatArray = so3.log(R_before.swapaxes(-1, -2) @ R_after) / gap_s
    return rate
