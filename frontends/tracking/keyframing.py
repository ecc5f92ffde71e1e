"""When a tracked frame becomes a keyframe."""

from __future__ import annotations

import numpy as np

from dualslam.config.settings import KeyframeConfig
from dualslam.core.geometry import se3
from dualslam.core.types import Track
from dualslam.map.submap import Submap

MIN_PARALLAX_DEG = 0.5
"""...and the camera has moved enough to see the scene's median depth under this angle (or tracking is weak)."""

ESTABLISHED = 3  # views of a landmark from which on its loss says that the scene has changed


def keyframe_due(track: Track, submap: Submap, reference_id: int, config: KeyframeConfig) -> bool:
    """Decide by what is still tracked of the last keyframe and by how far the camera has moved since.

    Parameters
    ----------
    track : Track
    submap : Submap
    reference_id : int
        The last keyframe, in the direction in which the frames come.
    config : KeyframeConfig
    """
    if track.view.index in submap.keyframes:
        return False
    if track.n_inliers < config.weak_landmarks:
        return True
    tracked_ratio = tracked_share(track, submap, reference_id)
    parallax = parallax_deg(track, submap, reference_id)
    if parallax > config.max_parallax_deg:
        return True
    if parallax < MIN_PARALLAX_DEG:
        # A turn in place reveals nothing that could be triangulated, until half of what was known is out of view.
        return tracked_ratio < 0.5 * config.max_tracked_ratio
    return tracked_ratio < config.max_tracked_ratio or abs(track.view.index - reference_id) >= config.max_frames


def tracked_share(track: Track, submap: Submap, reference_id: int) -> float:
    """Share of a keyframe's established landmarks that the frame still sees."""
    reference = submap.landmark_of[reference_id]
    reference = reference[reference >= 0]
    established = submap.n_observations(reference) >= min(ESTABLISHED, len(submap.keyframes))
    reference = reference[established]
    return float(np.isin(reference, track.landmark_ids).mean()) if len(reference) else 0.0


def parallax_deg(track: Track, submap: Submap, reference_id: int) -> float:
    """Angle under which the baseline to a keyframe is seen from the scene's median depth, degrees; 0 of no scene."""
    ids = track.landmark_ids[track.landmark_ids >= 0]
    if not len(ids):
        return 0.0
    T_cam_submap = track.T_cam_submap
    depth = submap.depths(ids, T_cam_submap)
    centre = se3.inverse(T_cam_submap)[:3, 3]
    baseline = float(np.linalg.norm(centre - submap.T_submap_kf[reference_id][:3, 3]))
    return float(np.degrees(np.arctan2(baseline, max(float(np.median(depth)), 1e-12))))
