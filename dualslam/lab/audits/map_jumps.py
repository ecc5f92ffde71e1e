"""How often does a map go wrong without being lost? Jumps of its scale and turn against the truth, from frame to frame.

The first limitation of the paper: a corruption that never breaks tracking starts no recovery. It can at least be
counted: a healthy map drifts slowly, a corrupted one has a place at which it no longer lies upon the truth as before.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.trajectory import FramePose
from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import sim3, so3
from dualslam.core.types import FloatArray, IntArray
from dualslam.lab.audits.link_audit import Side, align_cameras

WINDOW = 15
"""Frames on either side of a place that are laid upon the truth: enough for noise, few enough for drift."""
LOG_SCALE, ROTATION_DEG = 0.2, 3.0
"""A change beyond either, between the window before and the one after, is no drift."""
SIGMAS = 4.0
"""...if it is beyond so many standard deviations of what the windows can tell."""


@dataclass(frozen=True, slots=True)
class MapJump:
    """A place at which a submap stops lying upon the truth as it did.

    Attributes
    ----------
    submap : int
    frame : int
        First frame after it.
    log_scale : float
        Log of the scale after over that before.
    rotation_deg : float
    noticed : bool
        Whether the submap was declared lost within a window after it.
    """

    submap: int
    frame: int
    log_scale: float
    rotation_deg: float
    noticed: bool


def find_map_jumps(
    atlas: Atlas, poses: Iterable[FramePose], truth: Mapping[int, FloatArray], events: Iterable[Event] = ()
) -> list[MapJump]:
    """Find the jumps of all submaps, each judged in itself, in order of submap and frame.

    Parameters
    ----------
    atlas : Atlas
    poses : iterable of FramePose
    truth : mapping of int to (4, 4)
        True ``T_world_cam`` by frame index.
    events : iterable of Event
        Of the run: what was declared lost is a failure that was noticed.
    """
    lost = [(e.submap, e.frame) for e in events if e.event is EventKind.FAILED]
    by_submap: dict[int, dict[int, FloatArray]] = {}
    for pose in poses:
        if pose.index in truth:
            T = atlas.submaps[pose.submap_id].resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
            by_submap.setdefault(pose.submap_id, {})[pose.index] = T
    jumps = []
    for m, frames in sorted(by_submap.items()):
        index = np.array(sorted(frames), np.int64)
        est, true = (np.array([source[int(i)] for i in index]).reshape(-1, 4, 4) for source in (frames, truth))
        for frame, log_scale, rotation_deg in _jumps(index, est, true):
            later = int(np.searchsorted(index, frame)) + WINDOW
            until = index[later] if later < len(index) else math.inf
            noticed = any(submap == m and frame <= at <= until for submap, at in lost)
            jumps.append(MapJump(m, frame, log_scale, rotation_deg, noticed))
    return jumps


def _jumps(index: IntArray, est: FloatArray, true: FloatArray) -> list[tuple[int, float, float]]:
    """Return the clearest place of each run of places at which the windows before and after differ."""
    places = range(WINDOW, len(index) - WINDOW + 1)
    windows = {
        start: align_cameras(index[start : start + WINDOW], est[start : start + WINDOW], true[start : start + WINDOW])
        for start in range(len(index) - WINDOW + 1)
    }
    found: list[tuple[int, float, float]] = []
    clearest, last = 0.0, -1
    for i in places:
        log_scale, rotation_deg, excess = _difference(windows[i - WINDOW], windows[i])
        if excess <= 1:
            continue
        if last >= 0 and i - last < WINDOW:
            if excess > clearest:
                found[-1] = (int(index[i]), log_scale, rotation_deg)
        else:
            clearest = 0.0
            found.append((int(index[i]), log_scale, rotation_deg))
        clearest, last = max(clearest, excess), i
    return found


def _difference(before: Side, after: Side) -> tuple[float, float, float]:
    """Return log-scale, degrees, and by how much the larger of the two exceeds what drift and noise explain."""
    log_scale = float(np.log(sim3.scale(after.S_world_submap) / sim3.scale(before.S_world_submap)))
    turn = sim3.rotation(before.S_world_submap).T @ sim3.rotation(after.S_world_submap)
    rotation_deg = math.degrees(float(so3.rotation_angle(turn)))
    sigma_scale = math.hypot(before.scale_sigma, after.scale_sigma)
    sigma_deg = math.degrees(math.hypot(before.rotation_sigma_rad, after.rotation_sigma_rad))
    excess = max(
        abs(log_scale) / max(LOG_SCALE, SIGMAS * sigma_scale), rotation_deg / max(ROTATION_DEG, SIGMAS * sigma_deg)
    )
    return log_scale, rotation_deg, excess
