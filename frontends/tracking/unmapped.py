"""Unmapped image content, and whether the camera has moved past it so that a keyframe would map it.

Known content gives the parallax. A bench that comes into view beside a far wall has nothing mapped on it yet. It moves
by a quarter of the image while the wall hardly does. When the wall asks for a keyframe, the bench has gone or is too
close.
"""

from __future__ import annotations

import numpy as np

from dualslam.core.interfaces import Frontend
from dualslam.core.types import BoolArray, Features, Track
from dualslam.frontends.tracking.turning import unit_rays
from dualslam.map.submap import NO_LANDMARK, Submap

MIN_SHARE = 0.4
"""Of the image that must be unmapped before it is looked at, as that takes a matching: more than in any of 400 frames
of a road and 300 of a room. From a quarter on, the room has a tenth more keyframes."""
CELLS_ACROSS, MIN_IN_CELL = 8, 5  # the image's cells, and how many features make one that shows something


def passes_unmapped(
    track: Track, submap: Submap, keyframe_id: int, frontend: Frontend, parallax_deg: float, n: int
) -> bool:
    """Whether unmapped content has moved between frame and keyframe by more than a turn does.

    - `track`: of a frame.
    - `keyframe_id`: of the submap: the last keyframe.
    - `parallax_deg`: at which a keyframe is due if what is mapped shows it. At the angle from which on a match could be
      a landmark, 1 degree, keyframes came in turns on the spot as well, and broke maps of `tum_fr1_rpy`.
    - `n`: so many matches must show it.
    """
    features, keyframe = track.view.features, submap.keyframes[keyframe_id].features
    rows = np.flatnonzero(_unmapped(features, track.landmark_ids >= 0))
    if len(rows) == 0:
        return False
    free = np.flatnonzero(submap.landmark_of[keyframe_id] == NO_LANDMARK)
    matches = frontend.match_wide(features.take(rows), keyframe.take(free)).index
    if len(matches) < n:
        return False
    uv_px, uv_kf_px = features.uv_rect_px[rows[matches[:, 0]]], keyframe.uv_rect_px[free[matches[:, 1]]]
    here = track.T_cam_submap[:3, :3].T @ unit_rays(submap.K, uv_px)
    there = submap.T_submap_kf[keyframe_id][:3, :3] @ unit_rays(submap.K, uv_kf_px)
    sine = np.linalg.norm(np.cross(here, there, axis=0), axis=0)
    return int((sine > np.sin(np.radians(parallax_deg))).sum()) >= n


def _unmapped(features: Features, has_landmark: BoolArray) -> BoolArray:
    """Return which features lie in cells without a landmark; none where these are a small share of the image."""
    u, v = features.uv_rect_px.T
    cell_px = max(float(np.ptp(u)), 1.0) / CELLS_ACROSS
    column, row = (np.floor(x / cell_px).astype(np.int64) for x in (u, v))
    cell = (row - row.min()) * (CELLS_ACROSS + 2) + column - column.min()
    shows = np.bincount(cell) >= MIN_IN_CELL
    bare = shows & (np.bincount(cell, has_landmark) == 0)
    return np.asarray(bare[cell] & (bare.sum() > MIN_SHARE * shows.sum()))
