"""How well what frames have seen fits the maps at the end of a run."""

from __future__ import annotations

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.map.frame_observations import seen_now
from dualslam.system.system import System


def residuals_px(system: System) -> dict[int, float]:
    """Return how far nine tenths of the pixels are from their landmarks at most, of each frame that keeps what it saw.

    Where ids, pixels, camera or pose are those of another state of the map, it is many pixels.
    """
    found = {}
    for i, seen in system._state.record.observations.items():
        pose = system.poses.get(i)
        if pose is None or pose.submap_id != seen.submap_id:
            continue
        submap = system.atlas.submaps[pose.submap_id]
        _, ids, seen_px, _ = seen_now([seen], submap)
        if not len(ids):  # posed by other features than those of the map
            continue
        T_cam_submap = se3.inverse(submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam))
        uv_px, _ = project_points(submap.K, T_cam_submap, submap.landmarks["xyz_mu"][ids])
        found[i] = float(np.nanquantile(np.linalg.norm(uv_px - seen_px, axis=1), 0.9))
    return found
